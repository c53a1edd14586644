"""Photometric normalisation: take most of the light out of a picture before comparing it. Composes with any classifier
of this folder."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn

from facerelight.numerics.blur import gaussian_blur
from facerelight.numerics.luminance import NOISE_FLOOR

__all__ = ["NORMALIZERS", "Inside", "TanTriggs", "UnitLength", "WeberFaces", "make_normalizer"]


def _unit_length(images: Tensor) -> Tensor:
    return images / torch.linalg.vector_norm(images, dim=(1, 2), keepdim=True).clamp_min(1e-12)


class TanTriggs(nn.Module):
    """Gamma, difference of Gaussians and robust contrast equalisation (Tan and Triggs 2010).

    Args:
        gamma: exponent of the tone curve.
        inner, outer: widths of the two Gaussians, in pixels.
        alpha, tau: of the contrast equalisation.

    Shape: ``(M, H, W)`` to ``(M, H, W)``, each image then of unit length.

    Example:
        >>> TanTriggs()(torch.rand(2, 48, 42)).shape
        torch.Size([2, 48, 42])
    """

    def __init__(
        self, gamma: float = 0.2, inner: float = 1.0, outer: float = 2.0, alpha: float = 0.1, tau: float = 10.0
    ) -> None:
        super().__init__()
        self.gamma, self.inner, self.outer, self.alpha, self.tau = gamma, inner, outer, alpha, tau

    def forward(self, images: Tensor) -> Tensor:
        toned = (images.clamp_min(0) * 255 + 1) ** self.gamma
        band = gaussian_blur(toned, self.inner) - gaussian_blur(toned, self.outer)
        for limit in (float("inf"), self.tau):
            mean = band.abs().clamp_max(limit).pow(self.alpha).mean((1, 2), keepdim=True).clamp_min(1e-12) ** (
                1 / self.alpha
            )
            band = band / mean.clamp_min(1e-12)
        band = self.tau * torch.tanh(band / self.tau)
        return _unit_length(band)


class WeberFaces(nn.Module):
    """Weber local descriptor as an image (Wang et al. 2011): relative contrast of each pixel to its neighbours,
    squashed.

    Args:
        sigma: width of the blur that goes first, in pixels: the finest contrast that counts. Pores and stubble tell
            people apart best (0.5 pixels of 96 x 84), in sharp photographs that lie within a pixel of each other.
        gain: of the contrast, before it is squashed.

    Shape: ``(M, H, W)`` to ``(M, H, W)``, each image then of unit length.
    """

    def __init__(self, sigma: float = 1.0, gain: float = 2.0) -> None:
        super().__init__()
        self.sigma, self.gain = sigma, gain

    def forward(self, images: Tensor) -> Tensor:
        smooth = gaussian_blur(images.clamp_min(0), self.sigma) + NOISE_FLOOR
        around = nn.functional.avg_pool2d(nn.functional.pad(smooth[:, None], (1, 1, 1, 1), mode="replicate"), 3, 1)[
            :, 0
        ]
        contrast = torch.atan(self.gain * 9 * (smooth - around) / smooth)
        return _unit_length(contrast)


class Inside(nn.Module):
    """Another normalisation, and then only what lies inside a mask: its edge is no feature that all faces share.

    Args:
        normalizer: applied to whole images.
        mask: ``(H, W)``, 1 inside, 0 where hair and background are.

    Shape: ``(M, H, W)`` to ``(M, H, W)``, each image then of unit length.
    """

    mask: Tensor

    def __init__(self, normalizer: nn.Module, mask: Tensor) -> None:
        super().__init__()
        self.normalizer = normalizer
        self.register_buffer("mask", mask)

    def forward(self, images: Tensor) -> Tensor:
        return _unit_length(self.normalizer(images) * self.mask)


class UnitLength(nn.Module):
    """Takes away exposure alone: each image ``(M, H, W)`` is brought to unit length."""

    def forward(self, images: Tensor) -> Tensor:
        return _unit_length(images.clamp_min(0))


NORMALIZERS: dict[str, Callable[[], nn.Module]] = {
    "none": nn.Identity,
    "tan_triggs": TanTriggs,
    "weber": WeberFaces,
    "weber_fine": partial(WeberFaces, sigma=0.5),
    "unit": UnitLength,
}


def make_normalizer(name: str | None) -> nn.Module:
    """One of :data:`NORMALIZERS` by name; None leaves the images as they are."""
    if (name or "none") not in NORMALIZERS:
        raise ValueError(f"photometric: expected one of {', '.join(NORMALIZERS)}, got {name!r}")
    return NORMALIZERS[name or "none"]()
