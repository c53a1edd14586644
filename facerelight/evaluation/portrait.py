"""Protocol **portrait-A**: whole heads relit in colour, against ray-traced truth.

A scanned head of several skin tones is photographed under three set-ups, by a camera whose curve the methods do not
know, and relit by four lamps and by three bare ones. A gain is fitted to every output: the protocol asks for light and
colour, not for exposure.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.evaluation.scan import HEIGHT, WIDTH, ScannedHead, decode_srgb, encode_srgb, lamp_points
from facerelight.geometry.sources import Lamp
from facerelight.numerics.luminance import LOGARITHM_FLOOR, LUMINANCE

__all__ = [
    "BARE",
    "MEASURES",
    "SOURCES",
    "TARGETS",
    "Case",
    "Make",
    "PortraitTruth",
    "Regions",
    "Render",
    "edge_errors",
    "film",
    "fit_gain",
    "mean_scores",
    "portrait_errors",
    "run_portraits",
]

Render = Callable[[Sequence[Lamp], float], np.ndarray]  # lamps, fill -> (H, W, 3) uint8
Make = Callable[[np.ndarray, np.ndarray], Render]  # photo (H, W, 3) uint8, landmarks (3, 2) -> what renders it

FILL = 0.06
SOURCES: dict[str, tuple[list[Lamp], float]] = {
    "front": ([Lamp(0, 15, 12)], 0.35),
    "window": ([Lamp(38, 20, 18)], 0.35),
    "studio": ([Lamp(35, 30, 12), Lamp(-35, 10, 15, power=0.5)], 0.25),
}
"""Lamps and fill of the photograph, by the name of the set-up."""
TARGETS = {"left": Lamp(60, 0), "right": Lamp(-60, 0), "top": Lamp(0, 55), "three-quarter": Lamp(-45, 30)}
"""Lamps of 5 degrees that it is relit by, with a fill of 0.06."""
BARE = {"bare left": Lamp(60, 0, 1), "bare three-quarter": Lamp(-45, 30, 1), "bare top": Lamp(0, 55, 1)}
"""Points of light, for the sharpness of shadow edges."""
EXPOSURE = {"fair": 0.30, "tan": 0.16, "deep": 0.09}  # the face's mean luminance in the photograph's scene
SHADE, EDGES = ("shade_C", "shade_dC", "shade_log"), ("edge99", "edge_log")
MEASURES = ("person", "face", "rest", "ssim", *SHADE, *EDGES, "seam", "background")
"""Names of all measures, in the order in which they are shown; see :func:`portrait_errors` and :func:`edge_errors`."""
ROWS = 610  # of the picture that are kept: the scan ends below
EDGE_REACH = 0.06  # eye distances around a shadow's edge
LUMA = np.array(LUMINANCE, np.float32)


class Regions(NamedTuple):
    """Where things are, ``(H, W)`` bool each: ``person``; ``face``, its skin inside the oval; ``rest`` of the person;
    ``band`` around the face's outline; ``background``. ``unit``: the eye distance in pixels."""

    person: np.ndarray
    face: np.ndarray
    rest: np.ndarray
    band: np.ndarray
    background: np.ndarray
    unit: float


class Case(NamedTuple):
    """``photo`` and ``truth (H, W, 3)`` uint8 sRGB, and ``edges (H, W)`` bool: near the new lamp's shadow edges on the
    face, exact for bare lamps."""

    photo: np.ndarray
    truth: np.ndarray
    edges: np.ndarray


def film(scene: np.ndarray) -> np.ndarray:
    """A camera: Hable's filmic curve (white at 2) and sRGB; linear radiance ``(..., 3)`` to uint8."""

    def curve(x: np.ndarray | float) -> np.ndarray | float:
        a, b, c, d, e, f = 0.22, 0.30, 0.10, 0.20, 0.01, 0.30
        return (x * (a * x + c * b) + d * e) / (x * (a * x + b) + d * f) - e / f

    linear = np.clip(curve(scene * 2.0) / curve(4.0), 0, 1)
    coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return (coded * 255 + 0.5).astype(np.uint8)


def backdrop() -> np.ndarray:
    """A grey wall with a soft spot, which no lamp changes: linear ``(HEIGHT, WIDTH, 3)``."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] / HEIGHT
    grey = 0.22 + 0.10 * np.exp(-((x - 0.45) ** 2 + (y - 0.4) ** 2) / 0.12)
    return (grey[..., None] * np.array([0.95, 1, 1.08])).astype(np.float32)


class PortraitTruth:
    """Photographs and truths of a scanned head in one skin tone."""

    def __init__(self, head: ScannedHead, tone: str) -> None:
        self.head, self.tone = head, tone
        self.albedo = head.albedo(tone)
        self.landmarks = head.landmarks
        there = head.picture(np.ones(len(head.pixels), np.float32))
        self._matte = cv2.GaussianBlur(there, (0, 0), 0.7)[..., None]
        self.regions = self._regions(there)

    def _regions(self, there: np.ndarray) -> Regions:
        eyes, unit = self.landmarks[:2].mean(0), float(self.landmarks[1, 0] - self.landmarks[0, 0])
        person = cv2.erode(there, np.ones((5, 5)))[:ROWS] > 0
        y, x = np.mgrid[:ROWS, :WIDTH]
        above = (eyes[1] - y) / unit  # eye distances
        oval = np.hypot((x - eyes[0]) / unit, (above + 0.42) / 1.42)
        skin = (self.head.picture(self.head.hair)[:ROWS] < 0.1) & (self.head.picture(self.head.shirt)[:ROWS] < 0.1)
        face = person & skin & (oval < 0.95)
        band = person & (np.abs(oval - 1.0) < 0.18) & (above > -1.4)
        background = cv2.dilate(person.astype(np.uint8), np.ones((15, 15))) == 0
        return Regions(person, face, person & ~face, band, background, unit)

    def _face_luminance(self, lamps: Sequence[Lamp], fill: float) -> tuple[np.ndarray, float]:
        scene = self.head.radiance(self.albedo, lamps, fill)
        return scene, float((scene[:ROWS] @ LUMA)[self.regions.face].mean())

    def photograph(self, scene: np.ndarray) -> np.ndarray:
        """What the camera makes of the head's radiance ``(HEIGHT, WIDTH, 3)`` before its backdrop, uint8."""
        return film(scene * self._matte + backdrop() * (1 - self._matte))[:ROWS]

    def case(self, source: str, lamp: Lamp, fill: float = FILL) -> Case:
        """The photograph under a set-up, well exposed, and the truth: the new lamp as strong as keeps the face's
        brightness when it stands at the camera."""
        scene, level = self._face_luminance(*SOURCES[source])
        gain = EXPOSURE[self.tone] / level
        at_camera = self._face_luminance([Lamp(0, 0, lamp.size)], 0.0)[1]
        target = self.head.radiance(self.albedo, [lamp], fill)
        truth = self.photograph(target * gain * level / at_camera)
        return Case(self.photograph(scene * gain), truth, self.shadow_edges(lamp))

    def shadow_edges(self, lamp: Lamp) -> np.ndarray:
        """Pixels of the face within 0.06 eye distances of where the lamp's first point comes into sight, ``(H, W)``.

        Only where that makes a difference: in grazing light, at the end of the lit side, there is no edge to see.
        """
        lit = self.head.picture(self.head.lamp(lamp).lit)[:ROWS]
        facing = self.head.picture(self.head.normal @ lamp_points(lamp)[0])[:ROWS]
        near = np.ones((3, 3))
        step = cv2.dilate(lit.astype(np.uint8), near) != cv2.erode(lit.astype(np.uint8), near)
        step &= cv2.dilate(facing.astype(np.float32), near) > 0.15
        reach = 2 * round(EDGE_REACH * self.regions.unit) + 1
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach, reach))
        return (cv2.dilate((step & self.regions.face).astype(np.uint8), disc) > 0) & self.regions.face


# -- measures -------------------------------------------------------------------------------------------------------
def fit_gain(output: np.ndarray, truth: np.ndarray, person: np.ndarray) -> np.ndarray:
    """``output (H, W, 3)`` uint8 at the truth's exposure: times the median luminance ratio over the person.

    Returns:
        sRGB-coded float32 in 0..1.
    """
    ours, wanted = decode_srgb(output / 255.0), decode_srgb(truth / 255.0)
    usable = person & (ours.max(-1) < 0.97) & (wanted.max(-1) < 0.97)
    if not usable.any():
        return encode_srgb(ours)
    gain = np.exp(
        np.median(np.log((wanted @ LUMA)[usable] + LOGARITHM_FLOOR) - np.log((ours @ LUMA)[usable] + LOGARITHM_FLOOR))
    )
    return encode_srgb(np.clip(ours * gain, 0, 1))


def _luminance(coded: np.ndarray) -> np.ndarray:
    return decode_srgb(coded) @ LUMA


def _gradient(image: np.ndarray) -> np.ndarray:
    """Sobel, a pixel: ``(H, W, 2)``."""
    return np.stack([cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, scale=1 / 8.0) for dx in (1, 0)], -1)


def _log_ratio(light: np.ndarray, photo: np.ndarray, sigma: float) -> np.ndarray:
    """log(light / photo) of luminances ``(H, W)``, each blurred by ``sigma`` pixels in the logarithm."""
    logs = [cv2.GaussianBlur(np.log(image + 0.01).astype(np.float32), (0, 0), sigma) for image in (light, photo)]
    return logs[0] - logs[1]


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def portrait_errors(output: np.ndarray, case: Case, regions: Regions) -> dict[str, float]:
    """Errors of a relit photo, ``(H, W, 3)`` uint8, in colour and light.

    Returns:
        ``person``, ``face``, ``rest``: CIEDE2000; ``ssim`` of L* in the person; in shade, where the truth has less than
        half of the photo's luminance: ``shade_C`` mean abs C* error, ``shade_dC`` signed (negative: grey),
        ``shade_log`` signed error of log luminance (positive: too light); ``seam``: error of the gradient of
        log(out / photo) around the face's outline, an eye distance; ``background``: CIEDE2000 to the photo where
        nothing should change, before the gain.
    """
    from skimage.color import deltaE_ciede2000, rgb2lab
    from skimage.metrics import structural_similarity

    fitted = fit_gain(output, case.truth, regions.person)
    truth, photo = case.truth / 255.0, case.photo / 255.0
    ours, wanted = rgb2lab(fitted), rgb2lab(truth)
    error = np.zeros(regions.person.shape)
    error[regions.person] = deltaE_ciede2000(ours[regions.person], wanted[regions.person])
    chroma = np.hypot(ours[..., 1], ours[..., 2]) - np.hypot(wanted[..., 1], wanted[..., 2])
    light, light_truth, light_photo = _luminance(fitted), _luminance(truth), _luminance(photo)
    shade = regions.face & (light_truth < 0.5 * light_photo)
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    similarity = structural_similarity(ours[..., 0], wanted[..., 0], data_range=100, full=True, **window)[1]
    slope = _gradient(_log_ratio(light, light_photo, 1.2)) - _gradient(_log_ratio(light_truth, light_photo, 1.2))
    around = rgb2lab(output[regions.background] / 255.0), rgb2lab(photo[regions.background])
    return {
        "person": _mean(error[regions.person]),
        "face": _mean(error[regions.face]),
        "rest": _mean(error[regions.rest]),
        "ssim": _mean(similarity[regions.person]),
        "shade_C": _mean(np.abs(chroma)[shade]),
        "shade_dC": _mean(chroma[shade]),
        "shade_log": _mean((np.log(light + LOGARITHM_FLOOR) - np.log(light_truth + LOGARITHM_FLOOR))[shade]),
        "seam": _mean(np.linalg.norm(slope * regions.unit, axis=-1)[regions.band]),
        "background": _mean(deltaE_ciede2000(*around)) if regions.background.any() else float("nan"),
    }


def edge_errors(output: np.ndarray, case: Case, regions: Regions) -> dict[str, float]:
    """How sharp and how right a bare lamp's shadow edges are.

    Returns:
        ``edge99``: 99 % quantile of the gradient of log(out / photo) in the face, over the truth's (1: as sharp);
        ``edge_log``: mean abs error of log luminance near the truth's shadow edges, which noise and sharpening raise.
    """
    fitted = fit_gain(output, case.truth, regions.person)
    light, truth, photo = (_luminance(image) for image in (fitted, case.truth / 255.0, case.photo / 255.0))
    slopes = [np.linalg.norm(_gradient(_log_ratio(image, photo, 0.8)), axis=-1) for image in (light, truth)]
    steep, steep_truth = (float(np.quantile(slope[regions.face], 0.99)) for slope in slopes)
    error = np.abs(np.log(light + LOGARITHM_FLOOR) - np.log(truth + LOGARITHM_FLOOR))
    return {"edge99": steep / max(steep_truth, 1e-6), "edge_log": _mean(error[case.edges])}


# -- the protocol ---------------------------------------------------------------------------------------------------
def run_portraits(
    truths: Iterable[PortraitTruth],
    methods: Mapping[str, Make],
    keep: Callable[[str, str, np.ndarray], None] = lambda case, method, image: None,
) -> dict[str, dict[str, dict[str, float]]]:
    """Errors by method and case ("tone/set-up/lamp").

    Args:
        truths: one a skin tone.
        methods: by name, what conditions on a photo and its landmarks and then renders lamps with a fill.
        keep: is handed every picture, (H, W, 3) uint8; methods "photo" and "truth" are the case's own.
    """
    scores: dict[str, dict[str, dict[str, float]]] = {name: {} for name in methods}
    for truth in truths:
        for source in SOURCES:
            cases = {target: truth.case(source, lamp) for target, lamp in (TARGETS | BARE).items()}
            photo = next(iter(cases.values())).photo
            renders = {name: make(photo, truth.landmarks) for name, make in methods.items()}
            for target, case in cases.items():
                lamp = (TARGETS | BARE)[target]
                errors = portrait_errors if target in TARGETS else edge_errors
                label = f"{truth.tone}/{source}/{target}"
                keep(label, "photo", case.photo)
                keep(label, "truth", case.truth)
                for name, render in renders.items():
                    output = render([lamp], FILL)
                    if output.shape != photo.shape or output.dtype != np.uint8:
                        raise ValueError(f"{name}: expected uint8 {photo.shape}, got {output.dtype} {output.shape}")
                    keep(label, name, output)
                    scores[name][label] = errors(output, case, truth.regions)
    return scores


def mean_scores(cases: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Means over the cases in which a measure was taken."""
    means = {}
    for measure in MEASURES:
        values = np.array([errors[measure] for errors in cases.values() if measure in errors])
        values = values[np.isfinite(values)]
        means[measure] = round(float(values.mean()), 4) if len(values) else float("nan")
    return means
