"""Photometric normalisation: take most of the light out of a picture before comparing it. Composes with any classifier of this folder."""

from __future__ import annotations

import torch
from kornia.filters import get_gaussian_kernel1d
from torch import Tensor, nn

__all__ = ["TanTriggs", "UnitLength", "WeberFaces", "make_normalizer"]


def _blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur with replicated borders, as two matrix products: far faster for many small images than a convolution."""
    for axis in (-1, -2):
        size = images.shape[axis]
        reach = int(3 * sigma + 0.5)
        kernel = get_gaussian_kernel1d(2 * reach + 1, sigma)[0].to(images)
        source = (torch.arange(size)[:, None] + torch.arange(-reach, reach + 1)).clamp(0, size - 1)
        matrix = torch.zeros(size, size).to(images).scatter_add_(1, source.to(images.device), kernel.expand(size, -1))
        images = images @ matrix.T if axis == -1 else matrix @ images
    return images


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

    def __init__(self, gamma: float = 0.2, inner: float = 1.0, outer: float = 2.0, alpha: float = 0.1, tau: float = 10.0) -> None:
        super().__init__()
        self.gamma, self.inner, self.outer, self.alpha, self.tau = gamma, inner, outer, alpha, tau

    def forward(self, images: Tensor) -> Tensor:
        toned = (images.clamp_min(0) * 255 + 1) ** self.gamma
        band = _blur(toned, self.inner) - _blur(toned, self.outer)
        for limit in (float("inf"), self.tau):
            mean = band.abs().clamp_max(limit).pow(self.alpha).mean((1, 2), keepdim=True).clamp_min(1e-12) ** (1 / self.alpha)
            band = band / mean.clamp_min(1e-12)
        band = self.tau * torch.tanh(band / self.tau)
        return band / torch.linalg.vector_norm(band, dim=(1, 2), keepdim=True).clamp_min(1e-12)


class WeberFaces(nn.Module):
    """Weber local descriptor as an image (Wang et al. 2011): relative contrast of each pixel to its neighbours, squashed.

    Shape: ``(M, H, W)`` to ``(M, H, W)``, each image then of unit length.
    """

    def __init__(self, sigma: float = 1.0, gain: float = 2.0) -> None:
        super().__init__()
        self.sigma, self.gain = sigma, gain

    def forward(self, images: Tensor) -> Tensor:
        smooth = _blur(images.clamp_min(0), self.sigma) + 2 / 255
        around = nn.functional.avg_pool2d(nn.functional.pad(smooth[:, None], (1, 1, 1, 1), mode="replicate"), 3, 1)[:, 0]
        contrast = torch.atan(self.gain * 9 * (smooth - around) / smooth)
        return contrast / torch.linalg.vector_norm(contrast, dim=(1, 2), keepdim=True).clamp_min(1e-12)


class UnitLength(nn.Module):
    """Takes away exposure alone: each image ``(M, H, W)`` is brought to unit length."""

    def forward(self, images: Tensor) -> Tensor:
        images = images.clamp_min(0)
        return images / torch.linalg.vector_norm(images, dim=(1, 2), keepdim=True).clamp_min(1e-12)


def make_normalizer(name: str | None) -> nn.Module:
    """ "tan_triggs", "weber", "unit" or None (leave the images as they are)."""
    choices = {None: nn.Identity, "none": nn.Identity, "tan_triggs": TanTriggs, "weber": WeberFaces, "unit": UnitLength}
    if name not in choices:
        raise ValueError(f"photometric: expected one of {[c for c in choices if c]}, got {name!r}")
    return choices[name]()
