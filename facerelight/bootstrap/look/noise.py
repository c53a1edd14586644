"""Smooth noise and soft edges, of which paint is made."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["bump", "smooth_noise", "step"]


def smooth_noise(points: Tensor, cells: int, seed: int) -> Tensor:
    """Smooth noise of unit variance at ``points (P, 3)`` of the average head, about ``cells`` bumps across it,
    ``(P,)``."""
    generator = torch.Generator().manual_seed(seed % 2**31)
    lattice = torch.randn(1, 1, cells, cells, cells, generator=generator)
    grid = (points / 2.2).clamp(-1, 1).view(1, 1, 1, -1, 3)
    return 1.9 * torch.nn.functional.grid_sample(lattice, grid, align_corners=True)[0, 0, 0, 0]


def bump(x: Tensor, width: Tensor | float) -> Tensor:
    """1 at 0, a Gaussian's fall to both sides."""
    return torch.exp(-0.5 * (x / width) ** 2)


def step(x: Tensor, edge: float, softness: float) -> Tensor:
    """0 below the edge, 1 above, over ``softness`` each way."""
    return torch.sigmoid((x - edge) / (softness / 3))
