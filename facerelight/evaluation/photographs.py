"""What goes wrong on ordinary photographs, in numbers: no truth is needed, only the photograph before and after.

All but the last two measures are taken on the model's crop of both, in linear luminance ``L0`` and ``L1``; ``r`` is
``log2((L1 + .01) / (L0 + .01))``, in stops.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.evaluation.scan import decode_srgb
from facerelight.geometry.alignment import CropFrame, fit_similarity, invert_similarity, warp_to_crop
from facerelight.numerics.luminance import LUMINANCE, MEASURED_FLOOR
from facerelight.photo.face_mask import face_mask

__all__ = ["MEASURES", "photograph_measures"]

MEASURES = ("cut", "step", "lit_half", "pigment", "black", "halo", "clipped")
PAD = 3  # rows of the photo around the crop
FEW = 12  # pixels of the crop, fewer say nothing
NONE = float("nan")


class _Crop(NamedTuple):
    """``before``, ``after``: linear luminance, ``PAD`` pixels more than the crop on every side. On the crop ``(h, w)``:
    ``mask`` of the face, ``radius`` in the oval, ``across`` from its middle in eye distances, ``band`` from brow to
    mouth. ``unit``: the eye distance in pixels; ``whole_top``: whether the photo reaches beyond the crop's top."""

    before: np.ndarray
    after: np.ndarray
    mask: np.ndarray
    radius: np.ndarray
    across: np.ndarray
    band: np.ndarray
    unit: float
    whole_top: bool


def photograph_measures(
    before: np.ndarray,
    after: np.ndarray,
    landmarks: np.ndarray,
    frame: CropFrame,
    matte: np.ndarray | None = None,
    side: int = 0,
) -> dict[str, float]:
    """Measures of a relit photo; NaN where one does not apply.

    Args:
        before: ``(H, W, 3)`` uint8 sRGB.
        after: the same, relit.
        landmarks: ``(3, 2)`` pixels.
        frame: the model's crop.
        matte: ``(H, W)``, 0 where the person is not.
        side: 1 where the lamp stands at image-left, -1 at image-right, 0 elsewhere.

    Returns:
        ``cut``: median abs step of r across the crop's top border, over the middle 0.9 eye distances, less that two
        rows further in; ``step``: from cheek to ear on the side turned from the lamp, |median r at radius .62 to .78 -
        median at 1.12 to 1.25|, of the person's pixels alone; ``lit_half``: median r at radius .3 to .8 on the lamp's
        side; ``pigment``: median L1 / L0 of dark pixels of the face (L0 < .03) over that of the skin around them;
        ``black``: share of the face with L1 < .012 where L0 > .06; ``halo``: largest change, in grey levels, where the
        matte is 0; ``clipped``: share of the person that reaches 255 and did not.
    """
    if before.shape != after.shape or before.dtype != np.uint8 or after.dtype != np.uint8:
        got = f"{before.dtype} {before.shape} and {after.dtype} {after.shape}"
        raise ValueError(f"photos: expected two uint8 (H, W, 3) of one size, got {got}")
    crop = _crops(before, after, landmarks, frame)
    person = np.ones(before.shape[:2], bool) if matte is None else matte > 0.5
    inside_person = _on_crop(person, landmarks, frame)
    padded = np.log2((crop.after + MEASURED_FLOOR) / (crop.before + MEASURED_FLOOR))
    inside = (slice(PAD, -PAD), slice(PAD, -PAD))
    ratio, first, second = padded[inside], crop.before[inside], crop.after[inside]
    face = crop.mask > 0.6
    values = dict.fromkeys(MEASURES, NONE)
    if crop.whole_top:
        middle = np.abs(crop.across[0]) < 0.45
        steps = np.abs(np.diff(padded, axis=0))[:, PAD:-PAD][:, middle]  # (rows - 1, columns): row k to k + 1
        values["cut"] = float(np.median(steps[PAD - 1]) - np.median(steps[PAD + 1]))
    if side:
        shaded, lit = crop.across * side > 0, crop.across * side < 0
        radius = crop.radius
        cheek = _median(ratio, crop.band & shaded & (radius > 0.62) & (radius < 0.78))
        ear = _median(ratio, crop.band & shaded & (radius > 1.12) & (radius < 1.25) & inside_person)
        values["step"] = abs(cheek - ear)
        values["lit_half"] = _median(ratio, crop.band & lit & (radius > 0.3) & (radius < 0.8))
    dark = face & (first < 0.03)
    reach = 2 * round(0.12 * crop.unit) + 1
    around = cv2.dilate(dark.astype(np.uint8), np.ones((reach, reach))) > 0
    quotient = second / np.maximum(first, 1e-4)
    values["pigment"] = _median(quotient, dark) / _median(quotient, around & face & (first > 0.06))
    values["black"] = float((second < 0.012)[face & (first > 0.06)].sum() / max(face.sum(), 1))
    change = np.abs(before.astype(np.int16) - after).max(-1)
    if matte is not None and (matte <= 0).any():
        values["halo"] = float(change[matte <= 0].max())
    clipped = (after.max(-1) == 255) & (before.max(-1) < 255)
    values["clipped"] = float(clipped[person].mean()) if person.any() else NONE
    return values


def _crops(before: np.ndarray, after: np.ndarray, landmarks: np.ndarray, frame: CropFrame) -> _Crop:
    points = torch.as_tensor(np.asarray(landmarks, dtype=np.float64))
    matrix = fit_similarity(points, frame.landmarks)[None]
    top = invert_similarity(matrix)[0] @ torch.tensor([(frame.width - 1) / 2, -float(PAD), 1.0], dtype=torch.float64)
    shifted = matrix + torch.tensor([[0.0, 0.0, PAD], [0.0, 0.0, PAD]])
    wider = CropFrame(frame.height + 2 * PAD, frame.width + 2 * PAD)
    both = torch.from_numpy(np.stack([decode_srgb(image / 255.0) for image in (before, after)])).permute(0, 3, 1, 2)
    crops = torch.cat([warp_to_crop(image[None], shifted, wider) for image in both])
    mask = face_mask(crops[0][:, PAD:-PAD, PAD:-PAD], frame)
    luminance = (crops * torch.tensor(LUMINANCE)[:, None, None]).sum(1).numpy()
    eyes, mouth = frame.landmarks[:2].numpy(), frame.landmarks[2].numpy()
    unit = float(eyes[1, 0] - eyes[0, 0])
    y, x = np.mgrid[: frame.height, : frame.width]
    across, up = (x - eyes[:, 0].mean()) / unit, (eyes[0, 1] - y) / unit
    band = (up <= 0.2) & (y <= mouth[1])
    radius = frame.oval().numpy()
    return _Crop(luminance[0], luminance[1], mask.numpy(), radius, across, band, unit, bool(top[1] >= 0))


def _on_crop(person: np.ndarray, landmarks: np.ndarray, frame: CropFrame) -> np.ndarray:
    """Where the crop shows the person, ``(h, w)`` bool."""
    points = torch.as_tensor(np.asarray(landmarks, dtype=np.float64))
    cover = torch.from_numpy(person.astype(np.float32))[None, None]
    return warp_to_crop(cover, fit_similarity(points, frame.landmarks)[None], frame)[0, 0].numpy() > 0.5


def _median(values: np.ndarray, where: np.ndarray) -> float:
    return float(np.median(values[where])) if where.sum() >= FEW else NONE
