"""Standard normal points, spread evenly or drawn independently."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["quasi_normal"]


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
