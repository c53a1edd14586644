"""Skin: procedural albedo painted on the average head.

No photograph is involved. Positions are in the units of :mod:`heads`: eyes at (-0.5, 0) and (0.5, 0), mouth near (0,
-1.07).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.eyes import Gaze, lashes, paint_eyes

__all__ = ["Look", "paint"]


@dataclass(frozen=True)
class Look:
    """One person's paint, all fractions: ``tone`` albedo of the cheek; darkness of ``brows``, ``lips``, ``sockets``,
    ``iris``, ``stubble``, ``hair``."""

    tone: float
    brows: float
    brow_height: float
    brow_width: float
    lips: float
    sockets: float
    iris: float
    stubble: float
    hair: float
    hairline: float
    pigment: float
    grain: float
    seed: int
    material: Material

    @classmethod
    def random(cls, rng: np.random.Generator, domain: Domain) -> Look:
        """Draw a person's paint."""
        tone = float(np.exp(rng.uniform(np.log(domain.tone_low), np.log(domain.tone_high))))
        return cls(
            tone=tone,
            brows=float(rng.uniform(0.3, 0.9)),
            brow_height=float(rng.normal(0.21, 0.035)),
            brow_width=float(rng.uniform(0.05, 0.09)),
            lips=float(rng.uniform(0.1, 0.45)),
            sockets=float(rng.uniform(0.1, 0.5)),
            iris=float(rng.uniform(0.5, 0.95)),
            stubble=float(max(0.0, rng.normal(0.15, 0.25))),
            hair=float(rng.uniform(0.2, 0.95)),
            hairline=float(rng.normal(1.0, 0.12)),
            pigment=float(domain.texture * rng.uniform(0.5, 1.5)),
            grain=float(domain.texture * rng.uniform(0.3, 1.2)),
            seed=int(rng.integers(2**31)),
            material=Material(
                specular=float(domain.specular * rng.uniform(0.5, 1.5)),
                roughness=domain.roughness,
                fill=float(domain.fill * rng.uniform(0.5, 1.5)),
                side_light=domain.side_light,
            ),
        )


def paint(reference: Tensor, is_eye: Tensor, look: Look) -> Tensor:
    """Albedo in 0..1 at points of the average head: ``reference (P, 3)``, ``is_eye (P,)`` -> ``(P,)``."""
    x, y, z = reference.unbind(-1)
    side = x.abs()
    skin = (
        torch.log(torch.tensor(look.tone))
        + look.pigment * _noise(reference, 6, look.seed)
        + look.grain * _noise(reference, 40, look.seed + 1)
    )
    # a brow is an arc that rises outward and thins at its end
    arc = look.brow_height + 0.10 * (side - 0.25).clamp(0, 0.35) - 0.5 * (side - 0.62).clamp_min(0)
    thickness = look.brow_width * (1 - 0.6 * ((side - 0.55) / 0.4).clamp(0, 1))
    brow = _bump(y - arc, thickness) * _step(side, 0.14, 0.05) * _step(0.92 - side, 0, 0.08)
    hairs = 1 + 0.15 * _noise(reference, 60, look.seed + 2)
    brow = (look.brows * brow * hairs).clamp(0, 0.95)
    # lips: wider than tall, the upper one with a notch
    upper = _step(-1.07 + 0.13 - 0.05 * (side / 0.2 - 1).square() - y, 0, 0.02)
    lip = _step(1 - ((side / 0.46).square() + ((y + 1.08) / 0.17).square()), 0, 0.15) * upper * _step(z, 0.2, 0.05)
    # thin skin around the eyes is dark
    sockets = torch.exp(-0.5 * (((side - 0.48) / 0.24).square() + ((y - 0.03) / 0.15).square()).square()) * (z > -0.3)
    beard = _step(-0.62 - y, 0, 0.12) * _step(1.25 - side, 0, 0.1) * _step(z + 0.9, 0, 0.2)
    beard = beard * (1 - _bump(torch.hypot(side / 0.5, (y + 1.08) / 0.22), 0.6))
    moustache = _bump(y + 0.92, 0.12) * _step(0.5 - side, 0, 0.12) * (1 - lip)
    beard = torch.maximum(beard, moustache)
    hair = _step(y - look.hairline + 0.25 * (side / 0.9).square(), 0, 0.08) + _step(-0.75 - z + 0.2 * y, 0, 0.1)
    hair = (hair * (1 + 0.3 * _noise(reference, 30, look.seed + 3))).clamp(0, 1)
    shade = (1 - brow) * (1 - look.lips * lip) * (1 - 0.65 * lashes(reference)) * (1 - look.sockets * sockets)
    shade = shade * (1 - (0.7 * look.stubble * beard * hairs.clamp(0, 2)).clamp(0, 0.9))
    surface = torch.exp(skin) * shade * (1 - hair) + hair * (1 - look.hair) * 0.5
    eye = paint_eyes(reference, Gaze.random(np.random.default_rng((look.seed, 4))), look.iris)
    return torch.where(is_eye > 0.5, eye, surface).clamp(0.01, 1.5)


def _noise(points: Tensor, cells: int, seed: int) -> Tensor:
    """Smooth noise of unit variance, about ``cells`` bumps across the head."""
    generator = torch.Generator().manual_seed(seed % 2**31)
    lattice = torch.randn(1, 1, cells, cells, cells, generator=generator)
    grid = (points / 2.2).clamp(-1, 1).view(1, 1, 1, -1, 3)
    return 1.9 * torch.nn.functional.grid_sample(lattice, grid, align_corners=True)[0, 0, 0, 0]


def _bump(x: Tensor, width: Tensor | float) -> Tensor:
    return torch.exp(-0.5 * (x / width) ** 2)


def _step(x: Tensor, edge: float, softness: float) -> Tensor:
    """0 below the edge, 1 above, over ``softness`` each way."""
    return torch.sigmoid((x - edge) / (softness / 3))
