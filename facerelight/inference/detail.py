"""Fine detail: what a photograph shows at scales finer than shading is kept in its relit images.

The conditional mean of a pixel leans on its prior where the input is dark, and pores, lashes and stubble fade with it.
But detail this fine is mostly pigment, which multiplies whatever light there is. So a relit image is split into a base
and a detail layer (Durand and Dorsey 2002), and its detail is exchanged for the photograph's. An image relit to its own
light stays as it is.
"""

from __future__ import annotations

from torch import Tensor

from facerelight.numerics.blur import gaussian_blur
from facerelight.numerics.checks import check_finite, check_radiance
from facerelight.numerics.luminance import NOISE_FLOOR

__all__ = ["keep_detail"]

SCALE = 2 / 84  # image widths; shadow edges are coarser


def keep_detail(relit: Tensor, photo: Tensor, strength: float = 0.5) -> Tensor:
    """Give relit images the photograph's own detail: ``base(relit) detail(relit)^(1 - a) detail(photo)^a``.

    Args:
        relit: ``(..., Q, H, W)`` linear radiance.
        photo: ``(..., H, W)``, what they were relit from, in the same place.
        strength: a, from 0 (leave the images alone) to 1 (all detail is the photograph's). A half has the smallest
            error, since some of the detail is shading; recognition wants all of it.

    Returns:
        Images like ``relit``, without negative radiance.

    Raises:
        ValueError: shapes that do not fit, or a strength out of range.

    Example:
        >>> import torch
        >>> photo = torch.rand(2, 48, 42)
        >>> keep_detail(torch.rand(2, 5, 48, 42), photo).shape
        torch.Size([2, 5, 48, 42])
    """
    for name, images in (("relit", relit), ("photo", photo)):
        if not isinstance(images, Tensor):
            raise ValueError(f"{name}: expected a tensor, got {type(images).__name__}; try torch.as_tensor")
    if relit.dim() < 3 or photo.shape != (*relit.shape[:-3], *relit.shape[-2:]):
        raise ValueError(
            f"photo: expected (..., H, W) for relit (..., Q, H, W), got {tuple(photo.shape)} for {tuple(relit.shape)}"
        )
    check_radiance(photo, "photo", " ".join("." * (photo.dim() - 2)) + " H W")
    check_finite(relit, "relit", "radiance")
    if not 0 <= strength <= 1:
        raise ValueError(f"strength: expected 0 to 1, got {strength}")
    exchange = _detail(photo).unsqueeze(-3) / _detail(relit)
    return ((relit.clamp_min(0) + NOISE_FLOOR) * exchange.pow(strength) - NOISE_FLOOR).clamp_min(0)


def _detail(images: Tensor) -> Tensor:
    """``images / blurred images``, 1 where there is nothing to see."""
    lifted = images.clamp_min(0) + NOISE_FLOOR
    return lifted / gaussian_blur(lifted, SCALE * images.shape[-1])
