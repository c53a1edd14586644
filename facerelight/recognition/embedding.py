"""A face as a unit vector: what an embedding promises, and the aligned crop that it is given."""

from __future__ import annotations

from typing import NamedTuple, Protocol, runtime_checkable

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.geometry.alignment import fit_similarity
from facerelight.photo.faces.landmarks import Face

__all__ = ["CropPoints", "Embedding", "aligned_crop", "five_points", "srgb_bytes"]

NOSE_TIP, MOUTH_CORNERS = 4, (61, 291)  # of the 468 points


class CropPoints(NamedTuple):
    """The crop that an embedding was trained on: ``side`` in pixels, and in them the ``points (5, 2)`` (x, y): eye at
    image-left, other eye, nose, mouth corner at image-left, other corner."""

    side: int
    points: tuple[tuple[float, float], ...]


@runtime_checkable
class Embedding(Protocol):
    """Aligned sRGB crops to unit vectors, which are compared by cosine. Whatever has these can be plugged into a
    gallery.

    ``name``: says the network, its weights and its version; vectors of another name are never compared.
    ``crop``: how faces are aligned.
    """

    @property
    def name(self) -> str: ...

    @property
    def crop(self) -> CropPoints: ...

    def __call__(self, crops: np.ndarray) -> Tensor:
        """``(M, side, side, 3)`` uint8 sRGB to ``(M, D)`` float32 of unit length."""
        ...


def five_points(face: Face) -> np.ndarray:
    """Eyes, nose tip and mouth corners of a face, ``(5, 2)`` pixels (x, y); where its dense points are missing, the
    eyes and the middle of the mouth alone, ``(3, 2)``."""
    if face.points is None:
        return np.asarray(face.landmarks, np.float64)
    flat = face.points[:, :2]
    return np.vstack((face.landmarks[:2], flat[NOSE_TIP], flat[list(MOUTH_CORNERS)]))


def aligned_crop(photo: np.ndarray, face: Face, crop: CropPoints) -> np.ndarray:
    """The face as an embedding wants it, ``(side, side, 3)`` uint8; beyond the picture its border is repeated.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        face: found in it.
        crop: the embedding's.

    Raises:
        ValueError: a photo of another kind.
    """
    if photo.ndim != 3 or photo.shape[2] != 3 or photo.dtype != np.uint8:
        raise ValueError(f"photo: expected (H, W, 3) uint8 sRGB, got {photo.dtype} of shape {photo.shape}")
    source, target = five_points(face), np.array(crop.points)
    if len(source) == 3:
        target = np.vstack((target[:2], target[3:].mean(0)))
    return warp(photo, fit_similarity(torch.from_numpy(source), torch.from_numpy(target)).numpy(), crop.side)


def warp(picture: np.ndarray, matrix: np.ndarray, side: int) -> np.ndarray:
    """A square crop by the similarity ``matrix (2, 3)``; large faces are averaged down first, so that nothing
    aliases."""
    shrink = float(np.sqrt(np.linalg.det(matrix[:, :2])))
    if shrink < 0.5:
        height, width = picture.shape[:2]
        size = max(1, round(width * shrink * 1.5)), max(1, round(height * shrink * 1.5))
        factor = np.array((width / size[0], height / size[1]))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        # photo = (small + 0.5) * factor - 0.5
        shift = matrix[:, :2] @ (0.5 * factor - 0.5) + matrix[:, 2]
        matrix = np.column_stack((matrix[:, :2] * factor, shift))
    return cv2.warpAffine(picture, matrix, (side, side), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def srgb_bytes(radiance: Tensor) -> np.ndarray:
    """Linear radiance ``(..., H, W)`` in 0..1 as the uint8 sRGB codes that a photograph on disk holds.

    Example:
        >>> srgb_bytes(torch.tensor([[0.0, 0.2140, 1.0]])).tolist()
        [[0, 127, 255]]
    """
    linear = radiance.detach().clamp(0, 1).double()
    coded = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-9) ** (1 / 2.4) - 0.055)
    return (coded * 255).round().byte().cpu().numpy()
