"""Standard normal points, spread evenly or drawn independently, and pixels spread over an image."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["quasi_normal", "spread_pixels"]


def quasi_normal(
    count: int, dimensions: int, generator: torch.Generator | None = None, independent: bool = False
) -> Tensor:
    """``count`` standard normal points ``(count, dimensions)``: scrambled Sobol by default, or independent draws.

    Quasi-random points fill space evenly, so means over them converge almost as ``1 / count`` instead of
    ``1 / sqrt(count)``.
    """
    if independent:
        return torch.randn(count, dimensions, generator=generator)
    seed = int(torch.randint(2**31, (1,), generator=generator)) if generator is not None else 0
    points = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    return torch.special.ndtri(points.clamp(1e-9, 1 - 1e-9)).float()


def spread_pixels(size: tuple[int, int], count: int) -> Tensor:
    """About ``count`` pixels, evenly over images of ``size`` (height, width): their indices, ``(P,)``."""
    height, width = size
    stride = max(1, round((height * width / count) ** 0.5))
    return torch.arange(height * width).view(height, width)[stride // 2 :: stride, stride // 2 :: stride].flatten()
