"""Three landmarks to a similarity to the canonical crop, and back.

Pixel coordinates are ``(x, y)`` with the centre of the top-left pixel at ``(0, 0)``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

__all__ = [
    "CANONICAL_LANDMARKS",
    "CANONICAL_SIZE",
    "CropFrame",
    "fit_similarity",
    "invert_similarity",
    "warp_from_crop",
    "warp_to_crop",
]

CANONICAL_SIZE = (192, 168)
"""Height and width of the canonical crop, that of Extended Yale B."""
CANONICAL_LANDMARKS = ((35.0, 46.0), (131.0, 46.0), (84.0, 150.0))
"""Eye centre at image-left, eye centre at image-right, mouth centre, in pixels (x, y) of the canonical crop."""


@dataclass(frozen=True)
class CropFrame:
    """A crop of ``height`` x ``width`` pixels around the canonical one, with ``margin`` (a fraction of its size) more
    on every side.

    Example:
        >>> CropFrame(96, 84).landmarks.tolist()[0]
        [17.25, 22.75]
    """

    height: int
    width: int
    margin: float = 0.0

    def __post_init__(self) -> None:
        if self.height < 8 or self.width < 8:
            raise ValueError(f"crop: expected at least 8 x 8 pixels, got {self.height} x {self.width}")
        if not 0 <= self.margin <= 2:
            raise ValueError(f"margin: expected a fraction in [0, 2], got {self.margin}")

    @property
    def scale(self) -> float:
        """Pixels of this crop for one pixel of the canonical 192 x 168 crop."""
        height, width = CANONICAL_SIZE
        return min(self.height / height, self.width / width) / (1 + 2 * self.margin)

    @property
    def landmarks(self) -> Tensor:
        """The three landmarks in this crop's pixels, ``(3, 2)`` float64."""
        height, width = CANONICAL_SIZE
        centre = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
        own_centre = torch.tensor([(self.width - 1) / 2, (self.height - 1) / 2], dtype=torch.float64)
        return (torch.tensor(CANONICAL_LANDMARKS, dtype=torch.float64) - centre) * self.scale + own_centre

    def oval(self) -> Tensor:
        """Distance from the middle of the face in units of its outline, ``(height, width)``: 1 runs from hairline to
        chin."""
        eyes = self.landmarks[:2]
        middle, unit = eyes.mean(0), float(eyes[1, 0] - eyes[0, 0])
        y, x = torch.meshgrid(torch.arange(self.height), torch.arange(self.width), indexing="ij")
        across, up = (x - middle[0]) / unit, (middle[1] - y) / unit
        half_width = 1.0 - 0.06 * (-0.4 - up).clamp_min(0)  # narrower towards the chin
        return torch.hypot(across / half_width, (up + 0.42) / 1.42).float()


def fit_similarity(source: Tensor, target: Tensor) -> Tensor:
    """The least-squares similarity that takes ``source`` points to ``target`` points, in closed form (Umeyama 1991), no
    reflection.

    Args:
        source: ``(..., N, 2)`` points, N >= 2.
        target: points of the same shape.

    Returns:
        ``(..., 2, 3)`` matrices ``[s R | t]`` in float64.

    Raises:
        ValueError: points that are not finite, coincide, or (three and more) lie on one line.

    Example:
        >>> points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]])
        >>> fit_similarity(points, 2 * points + 1).tolist()
        [[2.0, -0.0, 1.0], [0.0, 2.0, 1.0]]
    """
    if source.shape != target.shape or source.shape[-1] != 2 or source.shape[-2] < 2:
        raise ValueError(
            f"landmarks: expected two (N, 2) sets with N >= 2, got {tuple(source.shape)} and {tuple(target.shape)}"
        )
    source, target = source.double(), target.double()
    if not (torch.isfinite(source).all() and torch.isfinite(target).all()):
        raise ValueError("landmarks: expected finite pixel coordinates, got NaN or infinity")
    mean_source, mean_target = source.mean(-2, keepdim=True), target.mean(-2, keepdim=True)
    a, b = source - mean_source, target - mean_target
    spread = a.square().sum((-2, -1))
    thin = torch.linalg.svdvals(a)[..., -1].square()
    if (spread <= 1e-12 * (1 + mean_source.square().sum((-2, -1)))).any():
        raise ValueError("landmarks: expected distinct points, got coincident ones")
    if source.shape[-2] > 2 and (thin < 1e-4 * spread).any():
        raise ValueError(
            "landmarks: expected three points off one line (two eye centres and the mouth), got collinear ones"
        )
    # In the plane, a similarity is z -> c z + t with complex c: least squares gives c = sum(conj(a) b) / sum |a|^2.
    real = (a * b).sum((-2, -1)) / spread
    imaginary = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]).sum(-1) / spread
    linear = torch.stack((torch.stack((real, -imaginary), -1), torch.stack((imaginary, real), -1)), -2)
    shift = mean_target.mT - linear @ mean_source.mT
    return torch.cat((linear, shift), dim=-1)


def invert_similarity(matrix: Tensor) -> Tensor:
    """The inverse of ``(..., 2, 3)`` similarities, in closed form."""
    linear = matrix[..., :2]
    inverse = linear.mT / torch.linalg.det(linear)[..., None, None]
    return torch.cat((inverse, -inverse @ matrix[..., 2:]), dim=-1)


def warp_to_crop(image: Tensor, matrix: Tensor, frame: CropFrame) -> Tensor:
    """Sample ``image`` into the crop; photos much larger than the crop are averaged down first, so nothing aliases.

    Args:
        image: ``(B, C, H, W)`` floating.
        matrix: ``(B, 2, 3)``, from image pixels to crop pixels.
        frame: the crop.

    Returns:
        ``(B, C, frame.height, frame.width)``; places outside the image repeat its border.
    """
    matrix = matrix.double()
    shrink = float(torch.linalg.det(matrix[..., :2]).sqrt().min())
    factor = int(1 / shrink) if shrink < 0.5 else 1
    if factor > 1:  # box-average by a whole factor; what is left shrinks by less than 2
        image = torch.nn.functional.avg_pool2d(image, factor, ceil_mode=False)
        centre = (factor - 1) / 2
        matrix = torch.cat(
            (matrix[..., :2] * factor, matrix[..., 2:] + matrix[..., :2].sum(-1, keepdim=True) * centre), -1
        )
    from kornia.geometry.transform import warp_affine  # half a second that a photo's relighting does not need

    return warp_affine(
        image, matrix.to(image), (frame.height, frame.width), mode="bilinear", padding_mode="border", align_corners=True
    )


def warp_from_crop(crop: Tensor, matrix: Tensor, size: tuple[int, int]) -> Tensor:
    """The way back: ``crop`` ``(B, C, h, w)`` resampled to an image of ``size`` (H, W); zero outside the crop."""
    from kornia.geometry.transform import warp_affine

    return warp_affine(
        crop,
        invert_similarity(matrix.double()).to(crop),
        size,
        mode="bilinear",
        padding_mode="zeros",
        align_corners=True,
    )
