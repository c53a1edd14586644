"""Amounts of many lights, for photographs that no single lamp made."""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.numerics.checks import check_mask, check_radiance
from facerelight.numerics.luminance import LARGEST_QUOTIENT, QUOTIENT_FLOOR

__all__ = ["fit_soft_light", "one_lamp_quotient"]


def fit_soft_light(mean_images: Tensor, image: Tensor, mask: Tensor, steps: int = 300) -> Tensor:
    """How much each of J lights contributes to a photo, for photos that no single lamp made: non-negative least
    squares.

    Light adds up, so a photo under any distant lights is about a non-negative mixture of the average face's images
    under single lights.

    Args:
        mean_images: ``(J, H, W)`` of the average face under each light.
        image: ``(H, W)`` radiance.
        mask: ``(H, W)``, 0 where the image does not show the face.
        steps: multiplicative updates (Lee and Seung 2000), each of which lowers the error.

    Returns:
        ``(J,)`` non-negative amounts; all zero for a black image.

    Raises:
        ValueError: shapes that do not fit, or values out of range.
    """
    check_radiance(mean_images, "mean_images", "J H W")
    check_radiance(image, "image", "H W", mean_images.shape[1:])
    mask = check_mask(mask, "mask", "H W", mean_images.shape[1:])
    basis, weight = mean_images.clamp_min(0).flatten(1).double(), mask.flatten().double()
    gram = (basis * weight) @ basis.T
    target = (basis * weight) @ image.flatten().clamp_min(0).double()
    amounts = torch.full_like(target, 1.0) * target.sum() / gram.sum().clamp_min(1e-30)
    for _ in range(steps):
        amounts = amounts * target / (gram @ amounts).clamp_min(1e-30)
    return amounts.to(image)


def one_lamp_quotient(single: Tensor, mixture: Tensor) -> Tensor:
    """What a photograph is multiplied by to be as under one lamp: the average face under that over the average face
    under the photograph's own light, no pixel by more than 4 or less than a quarter.

    Args:
        single: radiance of the average face under the one lamp, of any shape.
        mixture: under the photograph's light, of the same strength.
    """
    quotient = (single.clamp_min(0) + QUOTIENT_FLOOR) / (mixture + QUOTIENT_FLOOR)
    return quotient.clamp(1 / LARGEST_QUOTIENT, LARGEST_QUOTIENT)
