"""Where a face lies in an aligned crop, and the way between the crop and the model's own."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from facerelight.geometry.alignment import CropFrame, fit_similarity, invert_similarity

__all__ = ["ARCFACE_POINTS", "FaceWarp", "Frame", "frame_landmarks"]

ARCFACE_SIZE = 112
ARCFACE_POINTS = ((38.2946, 51.6963), (73.5318, 51.5014), (56.0252, 71.7366), (41.5493, 92.3655), (70.7299, 92.2041))
"""The five points of ArcFace's crops of 112 x 112 pixels (x, y): eyes, tip of the nose, corners of the mouth."""

Frame = Literal["yale", "arcface112"] | Tensor | tuple[tuple[float, float], ...]
"""What places the face in a crop: a name, or three landmarks in pixels, eye at image-left, other eye, mouth."""


def frame_landmarks(frame: Frame, height: int, width: int) -> Tensor:
    """Eye centre at image-left, the other one and the mouth's centre in a crop of ``height x width`` pixels, ``(3, 2)``
    float64.

    Args:
        frame: "yale", the crop of Extended Yale B at any size; "arcface112", ArcFace's at any size; or the three
            landmarks themselves.

    Raises:
        ValueError: another name, or landmarks that are none.
    """
    if isinstance(frame, str):
        if frame == "yale":
            return CropFrame(height, width).landmarks
        if frame == "arcface112":
            points = torch.tensor(ARCFACE_POINTS, dtype=torch.float64)
            three = torch.stack((points[0], points[1], points[3:].mean(0)))
            scale = min(height, width) / ARCFACE_SIZE
            middle = torch.tensor(((width - 1) / 2, (height - 1) / 2), dtype=torch.float64)
            return (three - (ARCFACE_SIZE - 1) / 2) * scale + middle
        raise ValueError(f"frame: expected 'yale', 'arcface112' or three landmarks, got {frame!r}")
    points = torch.as_tensor(frame, dtype=torch.float64)
    if points.shape != (3, 2) or not torch.isfinite(points).all():
        raise ValueError(
            f"frame: expected three finite points (x, y), eye at image-left, other eye, mouth, got {frame!r}"
        )
    return points


class FaceWarp:
    """Between crops and the model's own crop.

    Args:
        landmarks: ``(B, 3, 2)`` in the crops' pixels, or ``(1, 3, 2)`` where all crops share them.
        size: height and width of the crops.
        model: the model's crop.

    Raises:
        ValueError: landmarks that are not finite, coincide or lie on one line.
    """

    def __init__(self, landmarks: Tensor, size: tuple[int, int], model: CropFrame) -> None:
        self.size, self.model = size, model
        self.matrix = fit_similarity(landmarks, model.landmarks.to(landmarks.device).expand(len(landmarks), -1, -1))
        self._back = invert_similarity(self.matrix)  # model to crop

    def to_model(self, images: Tensor) -> Tensor:
        """``images (B, C, H, W)`` on the model's crop; beyond their border they go on as there."""
        shrink = torch.linalg.det(self.matrix[..., :2]).sqrt()
        factors = (1 / shrink).int().clamp_min(1)  # whole pixels of the crop to one of the model
        places = self._places(self._back, (self.model.height, self.model.width))
        of_each = factors.unique().tolist()
        if len(of_each) < 2:
            return _reduced(images, places, max(of_each, default=1))
        order = [(factors == factor).nonzero()[:, 0] for factor in of_each]
        parts = [
            _reduced(images[members], places[members], factor) for factor, members in zip(of_each, order, strict=True)
        ]
        return torch.cat(parts)[torch.cat(order).argsort()]

    def shown(self) -> Tensor:
        """Where the crops show the model's crop, ``(B or 1, h, w)`` of 0 and 1 float32."""
        places = self._places(self._back, (self.model.height, self.model.width))
        limit = places.new_tensor((self.size[1] - 0.5, self.size[0] - 0.5))
        return ((places > -0.5) & (places < limit)).all(-1).float()

    def to_crop(self, maps: Tensor) -> Tensor:
        """``maps (B, C, h, w)`` of the model's crop at any resolution on the crops; beyond their border they go on as
        there."""
        places = self._places(self.matrix, self.size)
        scale = places.new_tensor((maps.shape[3] / self.model.width, maps.shape[2] / self.model.height))
        return _sampled(maps, (places + 0.5) * scale - 0.5)

    def _places(self, matrix: Tensor, size: tuple[int, int]) -> Tensor:
        """Where ``matrix`` takes the pixels of an image of ``size``, ``(B or 1, h, w, 2)`` float64."""
        y, x = torch.meshgrid(
            *(torch.arange(side, dtype=torch.float64, device=matrix.device) for side in size), indexing="ij"
        )
        grid = torch.stack((x, y, torch.ones_like(x)), -1)  # (h, w, 3)
        return torch.einsum("hwc,bdc->bhwd", grid, matrix)


def _reduced(images: Tensor, places: Tensor, factor: int) -> Tensor:
    """As :func:`_sampled`, of averages over ``factor`` pixels each way, so that nothing aliases."""
    if factor > 1:
        images = avg_pool2d(images, factor, ceil_mode=True, count_include_pad=False)
        places = (places - (factor - 1) / 2) / factor
    return _sampled(images, places)


def _sampled(images: Tensor, places: Tensor) -> Tensor:
    """``images (B, C, H, W)`` at ``places (B or 1, h, w, 2)`` in pixels, bilinear."""
    size = places.new_tensor((images.shape[3], images.shape[2]))
    grid = ((2 * places + 1) / size - 1).to(images).expand(len(images), -1, -1, -1)
    return grid_sample(images, grid, mode="bilinear", padding_mode="border", align_corners=False)
