"""The one blur that features and details are made with."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["gaussian_blur"]


def gaussian_blur(images: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of ``images (..., H, W)`` with replicated borders, ``sigma`` in pixels.

    Two matrix products: far faster for many small images than a convolution.

    Example:
        >>> gaussian_blur(torch.ones(2, 8, 8), 1.0).allclose(torch.ones(2, 8, 8))
        True
    """
    from kornia.filters import get_gaussian_kernel1d

    for axis in (-1, -2):
        size = images.shape[axis]
        reach = int(3 * sigma + 0.5)
        kernel = get_gaussian_kernel1d(2 * reach + 1, sigma)[0].to(images)
        source = (torch.arange(size)[:, None] + torch.arange(-reach, reach + 1)).clamp(0, size - 1)
        matrix = torch.zeros(size, size).to(images).scatter_add_(1, source.to(images.device), kernel.expand(size, -1))
        images = images @ matrix.T if axis == -1 else matrix @ images
    return images
