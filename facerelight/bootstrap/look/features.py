"""Brows, lips and the skin around the eyes: where they lie on the average head and what they leave of the skin's
albedo.

Positions are in the units of :mod:`heads`: eyes at (-0.5, 0) and (0.5, 0), mouth near (0, -1.07).
"""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.bootstrap.look.noise import bump, step

__all__ = ["brow_arc", "brows", "lips", "rings", "stubble"]

BROW = (0.13, 0.95)  # where it ends, and where it is highest, in eye distances from the midline
PEAK = 0.48
MOUTH = 0.40  # half the width of the vermilion


def brow_arc(side: Tensor, height: float) -> Tensor:
    """Height of a brow's middle line at ``side (P,)``, the distance from the midline: a bow that bends down outside."""
    return height - 0.45 * (side - PEAK).square() - 0.5 * (side - 0.8).clamp_min(0)


def brows(reference: Tensor, height: float, width: float) -> Tensor:
    """Cover of the brows at points ``(P, 3)``, 0 to 1, narrower and thinner towards the temple, ``(P,)``."""
    x, y, _ = reference.unbind(-1)
    side = x.abs()
    narrow = width * (1 - 0.55 * ((side - PEAK) / 0.4).clamp(0, 1))
    thin = 1 - 0.8 * ((side - 0.65) / 0.25).clamp(0, 1)
    return bump(y - brow_arc(side, height), narrow) * step(side, BROW[0], 0.06) * step(BROW[1] - side, 0, 0.1) * thin


def lips(reference: Tensor) -> tuple[Tensor, Tensor]:
    """Cover of the vermilion, of which the lower lip, which catches more light, counts half; and the line between the
    lips; both ``(P,)``, 0 to 1."""
    x, y, z = reference.unbind(-1)
    along = x.abs() / MOUTH
    upper, lower = -0.90 - 0.16 * along.clamp_max(1.2) ** 1.6, -1.205 + 0.14 * along.clamp_max(1.2) ** 2
    line = -1.045 - 0.012 * along.square()
    inside = step(upper - y, 0, 0.03) * step(y - lower, 0, 0.03) * step(MOUTH + 0.01 - x.abs(), 0, 0.04)
    cover = inside * step(z, 0, 0.05) * (0.5 + 0.5 * step(y - line, 0, 0.02))
    return cover, bump(y - line, 0.018) * step(MOUTH + 0.02 - x.abs(), 0, 0.06) * (z > 0)


def rings(reference: Tensor) -> tuple[Tensor, Tensor]:
    """Thin, dark skin: all around the eyes, and under them; both ``(P,)``, 0 to 1."""
    x, y, z = reference.unbind(-1)
    side = x.abs()
    around = (((side - 0.48) / 0.26).square() + ((y - 0.04) / 0.16).square()).square()
    under = ((side - 0.45) / 0.22).square() + ((y + 0.14) / 0.09).square()
    return torch.exp(-0.5 * around) * (z > -0.4), torch.exp(-0.5 * under) * (z > -0.4)


def stubble(reference: Tensor, mouth: Tensor) -> Tensor:
    """Where a shaven beard shows through the skin, 0 to 1, ``(P,)``; ``mouth (P,)`` is the lips' cover."""
    x, y, z = reference.unbind(-1)
    side = x.abs()
    beard = step(-0.62 - y, 0, 0.12) * step(1.25 - side, 0, 0.1) * step(z + 0.9, 0, 0.2)
    beard = beard * (1 - bump(torch.hypot(side / 0.5, (y + 1.08) / 0.22), 0.6))
    moustache = bump(y + 0.86, 0.09) * step(0.5 - side, 0, 0.12)
    return torch.maximum(beard, moustache) * (1 - mouth.clamp(0, 1))
