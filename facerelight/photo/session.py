"""A photograph under new light, whole: conditioned once, rendered under as many lights as wanted, at its own
resolution.

The order: the face is found and its window cut out; the statistical model is conditioned on the face; a matte and the
mean bust say where the person is and what shape; a light becomes a log ratio over the whole bust; and that is put on
the photograph's own pixels, which stay as they are wherever the person is not.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import chain
from numbers import Real
from typing import Literal, NamedTuple, TypeVar

import cv2
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from facerelight.geometry.alignment import fit_similarity
from facerelight.geometry.lights import angles_from_light, light_from_angles
from facerelight.geometry.sources import Lamp, LightMixture, lights_behind, scene_light
from facerelight.inference.methods import Method
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo.bust.frame import BUST, FINE, LARGEST_SIDE, Window, compose, crop_to_bust, working_window
from facerelight.photo.bust.shading import BustShading
from facerelight.photo.bust.surface import fit_bust, head_rotation, make_bust
from facerelight.photo.colour import to_scene
from facerelight.photo.compose import Changes, change_pixels
from facerelight.photo.face_model import FaceModel, Quality, crop_frame, load_relighter
from facerelight.photo.faces.given import Landmarks, check_landmarks, locate_face
from facerelight.photo.faces.head_pose import HeadPose
from facerelight.photo.faces.landmarks import Face
from facerelight.photo.files.pixels import as_rgb, like, small_copy
from facerelight.photo.layers.decomposition import Decomposition, decompose_person
from facerelight.photo.person import Person
from facerelight.photo.ratio import FaceEvidence, LightRatio
from facerelight.photo.stages import Stage, StageLog

__all__ = ["PhotoRelighter", "load_relighter", "relight"]

POSE_LIMIT = 20.0  # degrees of yaw or pitch beyond which the statistics, which are of frontal faces, do not reach
NECK_BENDS = np.deg2rad(35.0)

Source = Lamp | LightMixture
Picture = TypeVar("Picture", np.ndarray, Image.Image)


def relight(
    photo: Picture,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    landmarks: Landmarks | None = None,
    relighter: StatisticalRelighter | None = None,
    quality: Quality = "standard",
    *,
    lights: Sequence[Source] | None = None,
    size: float = 5.0,
    fill: float = 0.1,
    strength: float = 1.0,
    device: str | torch.device = "cpu",
) -> Picture:
    """Relight the person in a photo: face, hair, neck and shoulders; the background stays as it is.

    Args:
        photo: a Pillow image of any usual mode, or an array ``(H, W)``, ``(H, W, 3)`` or ``(H, W, 4)`` of uint8, uint16
            or float in 0..1, sRGB.
        azimuth: degrees, where the new lamp stands; positive at image-left.
        elevation: degrees; positive above.
        landmarks: three (x, y) pixel pairs: eye centre at image-left, eye centre at image-right, mouth centre; None
            finds the largest face.
        relighter: default: the one with the statistics of ``quality``, see :func:`load_relighter`.
        quality: "draft", "standard" or "reference": coarser statistics of fewer heads, or finer ones of more.
        lights: several lamps, or other mixtures of lights, instead of one at ``azimuth``, ``elevation``.
        size: angular radius of the lamp in degrees: 1 a bare bulb, 5 a small reflector, 15 a soft box, 40 a window.
        fill: share of light from all around, 0 to 1; 0.06 is dramatic, 0.15 a studio.
        strength: 0 the photo, 1 the relit picture, between them a mixture.
        device: where the statistical model computes; a ``relighter`` given is moved there.

    Returns:
        The relit photo, of the type, mode, depth and size that came in; a Pillow image is turned upright by its EXIF
        orientation. For many lights, use :class:`PhotoRelighter`.

    Raises:
        ValueError: a photo, landmarks, angles or lights that cannot be used.
        RuntimeError: no statistics yet, or no face found.

    Warns:
        UserWarning: what a user should know before trusting the picture, such as a face turned too far, one of several,
            or a lamp behind the face.

    Example:
        >>> from skimage.data import astronaut  # doctest: +SKIP
        >>> relight(astronaut(), azimuth=-60, elevation=20).shape  # doctest: +SKIP
        (512, 512, 3)
    """
    if lights is not None and (azimuth or elevation):
        raise ValueError(f"lights: expected them or azimuth and elevation, got both ({azimuth:g}, {elevation:g})")
    wanted = [Lamp(azimuth, elevation, size)] if lights is None else _as_sources(lights)
    scene_light(wanted, fill)  # said before the work what is wrong with them
    _check_share("strength", strength)
    if isinstance(photo, Image.Image):
        from facerelight.photo.files.photograph import from_pillow, to_pillow

        opened = from_pillow(photo)
        session = PhotoRelighter(opened.pixels, landmarks, relighter, quality=quality, device=device)
        _warn(lights_behind(wanted), session.warnings)
        return to_pillow(opened, session.render(wanted, fill=fill, strength=strength))
    session = PhotoRelighter(photo, landmarks, relighter, quality=quality, device=device)
    _warn(lights_behind(wanted), session.warnings)
    return session.render(wanted, fill=fill, strength=strength)


class _Aligned(NamedTuple):
    """A face's ``window``, its ``copy (h, w, 3)`` and ``scene (h, w, 3)`` radiance, and ``crop (3, h', w')``, the
    model's part of that."""

    window: Window
    copy: np.ndarray
    scene: np.ndarray
    crop: Tensor


class PhotoRelighter:
    """One photo, conditioned once and rendered under as many lights as wanted.

    Args:
        photo: an array as for :func:`relight`; grey ones are seen as grey RGB, alpha is kept.
        landmarks: as for :func:`relight`.
        relighter: as for :func:`relight`.
        source_light: ``(3,)`` unit vector where the photo's light is known; None estimates it.
        more: further photos of the same person, as evidence; their landmarks and lights are found.
        method: "expected": the mean under the estimated lights; "map": the most probable image, the lights' own
            uncertainty counted in; "mle": n without a prior, from three photos or more under different lights.
        quality: as for :func:`relight`.
        face: which face, as :func:`facerelight.photo.faces.landmarks.find_faces` found it; ``landmarks`` are then its
            own.
        stages: "auto" simulates what each scene calls for, "all" everything; the pictures are the same.
        device: where the statistical model computes; a ``relighter`` given is moved there.

    Raises:
        ValueError: a photo or landmarks that cannot be used, or too few photos for the method.
        LandmarksNotFoundError: no face was found.
    """

    _person = Person
    _largest_side = LARGEST_SIDE

    def __init__(
        self,
        photo: np.ndarray,
        landmarks: Landmarks | None = None,
        relighter: StatisticalRelighter | None = None,
        source_light: Tensor | None = None,
        more: Sequence[np.ndarray] = (),
        method: Method = "expected",
        quality: Quality = "standard",
        *,
        face: Face | None = None,
        stages: Literal["auto", "all"] = "auto",
        device: str | torch.device = "cpu",
    ) -> None:
        if stages not in ("auto", "all"):
            raise ValueError(f"stages: expected 'auto' or 'all', got {stages!r}")
        self._log, self._exhaustive = StageLog(), stages == "all"
        self.photo, self._pixels = photo, as_rgb(photo)
        self.relighter = (relighter or load_relighter(quality)).to(device)
        self.frame = crop_frame(self.relighter)
        with self._log.measure("face", "marked by hand" if landmarks is not None else "found in the picture"):
            self.face, self._faces = locate_face(self._pixels, landmarks, face)
        aligned = self._align(self._pixels, self.face.landmarks)
        self.window = aligned.window
        with self._log.measure("model", "the face's statistics"):
            others = ((as_rgb(other), locate_face(as_rgb(other), None, None)[0]) for other in more)
            crops = [aligned.crop, *(self._align(pixels, found.landmarks).crop for pixels, found in others)]
            self.model = self._conditioned(crops, source_light, method)
        shown, mask = (aligned.copy, aligned.scene, self.window), self.model.mask.numpy()
        self.person = self._person(*shown, self.face.points, mask, self._log, self._exhaustive)

    # -- what is known of the photo

    @property
    def landmarks(self) -> Tensor:
        """Eye centre at image-left, eye centre at image-right, mouth centre, ``(3, 2)`` float64 pixels (x, y)."""
        return torch.from_numpy(np.array(self.face.landmarks, np.float64))

    @property
    def pose(self) -> HeadPose | None:
        """How the head is turned, degrees; None where its dense points were not found."""
        return self.face.pose

    @property
    def light(self) -> LightMixture:
        """The photo's own light, as fitted; rendered with ``fill=0`` it gives the photo back."""
        return self.model.light

    @property
    def source_light(self) -> Tensor:
        """The middle of the photo's own light, ``(3,)``; zero for a black photo."""
        return self.model.source_light

    @property
    def source_angles(self) -> tuple[float, float]:
        """Azimuth and elevation in degrees of :attr:`source_light`; 0, 0 for a black photo."""
        if float(self.source_light.square().sum()) == 0:
            return 0.0, 0.0
        azimuth, elevation = angles_from_light(self.source_light)
        return float(azimuth), float(elevation)

    @property
    def luminance(self) -> Tensor:
        """Scene radiance of the aligned face, ``(h, w)``."""
        return self.model.luminance

    @property
    def mask(self) -> Tensor:
        """Where the aligned crop shows the face, ``(h, w)`` in 0..1."""
        return self.model.mask

    @property
    def matte(self) -> np.ndarray:
        """Cover of the person in 0..1, ``(H, W)`` float32; 0 beyond the bust."""
        return self._on_photo(self.person.cover)

    @property
    def stages(self) -> list[Stage]:
        """Which stages ran for the conditioning and for the last picture, why, and what each cost."""
        return list(self._log.stages)

    @property
    def warnings(self) -> list[str]:
        """What a user should know before trusting the result."""
        said = []
        if self.pose is not None and max(abs(self.pose.yaw), abs(self.pose.pitch)) > POSE_LIMIT:
            angles = f"{abs(self.pose.yaw):.0f} degrees to the side and {abs(self.pose.pitch):.0f} up or down"
            said.append(f"pose: the head is turned {angles}; the statistics are of faces within about {POSE_LIMIT:.0f}")
        if not self.face.whole:
            said.append("face: the picture's border cuts it; what is outside is guessed")
        if self._faces > 1:
            said.append(f"face: the largest whole one of {self._faces}; landmarks= or face= take another")
        return said

    def crops(self, lights: Tensor) -> Tensor:
        """The aligned face under unit ``lights (Q, 3)``, scene radiance before exposure, ``(Q, h, w)``."""
        return self.model.crops(lights)

    # -- rendering

    @torch.inference_mode()
    def render(
        self,
        lights: float | Source | Sequence[Source] = 0.0,
        elevation: float | None = None,
        *,
        size: float = 5.0,
        fill: float = 0.1,
        strength: float = 1.0,
    ) -> np.ndarray:
        """The photo under new light, of its own shape and dtype.

        Args:
            lights: a :class:`facerelight.Lamp`, a list of them, a :class:`facerelight.LightMixture`, or a lamp's
                azimuth in degrees.
            elevation: degrees, with an azimuth.
            size, fill, strength: as for :func:`relight`.

        Raises:
            ValueError: lights that cannot be used.
        """
        if isinstance(lights, float | Real):
            sources: list[Source] = [Lamp(float(lights), float(elevation or 0.0), size)]
        elif elevation is not None:
            raise ValueError("elevation: expected with an azimuth in degrees alone; a Lamp has its own")
        else:
            sources = _as_sources(lights)
        _check_share("strength", strength)
        light = scene_light(sources, fill)
        self._log.forget("light", "shadows", "pixels")
        ratio = self._ratio
        marched = ratio.shading.marches
        with self._log.measure("light", f"a new light of {len(light.directions)} points"):
            log_ratio = self.window.back(ratio(light).astype(np.float32), FINE).reshape(*self.window.size, -1)
            exposure, change = self.person.expose(log_ratio)
            log_ratio = self.person.follow(log_ratio, exposure)
        if ratio.shading.marches == marched:
            self._log.skip("shadows", "no lamp whose shadows were not known already, or that the camera could see")
        person = self.person
        changes = Changes(log_ratio, person.skin, person.cover, person.ground, change, float(strength))
        with self._log.measure("pixels", "the person's part of the picture"):
            relit = change_pixels(self._pixels, self.window, changes)
        return like(self.photo, relit)

    @torch.inference_mode()
    def std(self, azimuth: float, elevation: float) -> np.ndarray:
        """How unsure the model is of the face: the standard deviation of scene radiance, ``(H, W)`` float32, 0 outside
        the face."""
        maps = self.model.std(light_from_angles(float(azimuth), float(elevation)).numpy()) * self.mask.numpy()
        return self._on_photo(self.window.from_crop(maps.astype(np.float32), outside=0.0).clip(0))

    @torch.inference_mode()
    def decompose(self) -> Decomposition:
        """What the photo is made of: shading, reflectance, highlights, normals, its own light, and how sure they are.

        Example:
            >>> from skimage.data import astronaut  # doctest: +SKIP
            >>> parts = PhotoRelighter(astronaut()).decompose()  # doctest: +SKIP
            >>> parts.reflectance.shape, parts.normals_std.max() < 90  # doctest: +SKIP
            ((512, 512, 3), True)
        """
        shading, trust = self._shading, self._trust
        return decompose_person(self._pixels, self.window, self.person, self.model, shading, trust)

    def _on_photo(self, image: np.ndarray) -> np.ndarray:
        """A map of the window's copy on the photo, ``(H, W)`` float32; 0 beyond the window."""
        out = np.zeros(self._pixels.shape[:2], np.float32)
        part = out[self.window.rows, self.window.columns]
        part[...] = cv2.resize(image, part.shape[::-1], interpolation=cv2.INTER_LINEAR)
        return out

    def _conditioned(self, crops: list[Tensor], source_light: Tensor | None, method: Method) -> FaceModel:
        """What the model knows of the face in ``crops (3, h, w)``, this photo's first."""
        return FaceModel(self.relighter, crops, source_light, method, self._rotation)

    @cached_property
    def _rotation(self) -> np.ndarray | None:
        """How the head is turned, ``(3, 3)`` in bust coordinates."""
        return None if self._points is None else head_rotation(self._points)

    @cached_property
    def _to_bust(self) -> np.ndarray:
        """``(2, 3)``: pixels of the photo to bust coordinates."""
        to_crop = fit_similarity(self.landmarks, self.frame.landmarks).numpy()
        return compose(crop_to_bust(self.frame), to_crop)

    @cached_property
    def _points(self) -> np.ndarray | None:
        """The face's dense points in bust coordinates, ``(468, 3)``."""
        points = self.face.points
        if points is None:
            return None
        to_bust = self._to_bust
        unit = np.sqrt(abs(np.linalg.det(to_bust[:, :2])))
        return np.column_stack((points[:, :2] @ to_bust[:, :2].T + to_bust[:, 2], -points[:, 2] * unit))

    @cached_property
    def _shading(self) -> BustShading:
        """Built at the first render: a gallery asks for aligned faces alone."""
        cover = self.person.cover
        with self._log.measure("bust", "neck, hair and clothes follow the light"):
            in_picture = self.window.onto(np.ones(self.window.size, np.float32), BUST, cv2.BORDER_CONSTANT) > 0.5
            down = _down(self._to_bust)
            bust = make_bust(self.window.onto(cover, BUST), in_picture, fit_bust(self._points, down), down)
            return BustShading(bust, self._exhaustive)

    @cached_property
    def _trust(self) -> np.ndarray:
        """Where the crop is skin that the model understands, ``(h, w)``."""
        return self.model.trust(self.window.onto_crop(self.person.features.not_skin))

    @cached_property
    def _ratio(self) -> LightRatio:
        shading = self._shading
        with self._log.measure("source", f"the photo's own light, {len(self.light.directions)} points"):
            evidence = FaceEvidence(self.luminance.numpy(), self.mask.numpy(), self._trust, self.model.radiance)
            return LightRatio(evidence, self.frame, shading, self.light)

    def _align(self, pixels: np.ndarray, landmarks: np.ndarray) -> _Aligned:
        """The window around a face, its copy, and the model's crop of it."""
        matrix = fit_similarity(check_landmarks(landmarks, pixels.shape), self.frame.landmarks).numpy()
        window = working_window(pixels.shape, matrix, self.frame, self._largest_side)
        copy = small_copy(pixels, window)
        scene = to_scene(copy)
        crop = torch.from_numpy(np.ascontiguousarray(window.onto_crop(scene).transpose(2, 0, 1)))
        return _Aligned(window, copy, scene, crop)


def _as_sources(lights: object) -> list[Source]:
    """A list of sources, from one or several."""
    given = list(lights) if isinstance(lights, Iterable) and not isinstance(lights, LightMixture) else [lights]
    sources = [source for source in given if isinstance(source, Lamp | LightMixture)]
    if len(sources) < len(given):
        raise ValueError(f"lights: expected a Lamp, a list of them, or an azimuth in degrees, got {lights!r}")
    return sources


def _warn(*lines: list[str]) -> None:
    """Warnings of the caller's line."""
    for line in chain(*lines):
        warnings.warn(line, stacklevel=3)


def _check_share(name: str, value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"{name}: expected a share from 0 to 1, got {value}")


def _down(to_bust: np.ndarray) -> tuple[float, float]:
    """Which way a body hangs in bust coordinates: the picture's own down, as far as a neck bends; beyond that the
    camera was turned."""
    x, y = to_bust[:, :2] @ (0.0, 1.0)
    tilt = float(np.clip(np.arctan2(x, -y), -NECK_BENDS, NECK_BENDS))
    return float(np.sin(tilt)), float(-np.cos(tilt))
