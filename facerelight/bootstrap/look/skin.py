"""Skin: procedural albedo painted on the average head.

No photograph is involved. Positions are in the units of :mod:`heads`: eyes at (-0.5, 0) and (0.5, 0).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.look.eyes import Gaze, lashes, paint_eyes
from facerelight.bootstrap.look.features import brows, lips, rings, stubble
from facerelight.bootstrap.look.hair import BALD, Hairstyle, tint
from facerelight.bootstrap.look.noise import smooth_noise

__all__ = ["Look", "paint"]


@dataclass(frozen=True)
class Look:
    """One person's paint, all fractions: ``tone`` albedo of the cheek; darkness of ``brows``, ``lips``, the ``line``
    between them, ``sockets``, ``under`` the eyes, ``iris``, ``stubble`` and ``hair``; strength of ``pigment``,
    ``blotches`` and ``grain``, standard deviations of log albedo."""

    tone: float
    brows: float
    brow_height: float
    brow_width: float
    lips: float
    line: float
    sockets: float
    under: float
    iris: float
    stubble: float
    hair: float
    pigment: float
    blotches: float
    grain: float
    seed: int
    material: Material
    gaze: Gaze
    style: Hairstyle = BALD

    @classmethod
    def random(cls, rng: np.random.Generator, domain: Domain) -> Look:
        """Draw a person's paint."""
        tone = float(np.exp(rng.uniform(np.log(domain.tone_low), np.log(domain.tone_high))))
        dark = min(1.0, tone / 0.6)  # dark skin, dark hair
        return cls(
            tone=tone,
            brows=float(rng.uniform(0.35, 0.85)),
            brow_height=float(rng.normal(0.30, 0.035)),
            brow_width=float(rng.uniform(0.045, 0.075)),
            lips=float(rng.uniform(0.1, 0.4)),
            line=float(rng.uniform(0.3, 0.7)),
            sockets=float(rng.uniform(0.15, 0.6)),
            under=float(rng.uniform(0.06, 0.34)),
            iris=float(rng.uniform(0.5, 0.95)),
            stubble=float(max(0.0, rng.normal(0.12, 0.13))),
            hair=1 - dark * (1 - float(rng.uniform(0.2, 0.95))),
            pigment=float(domain.texture * rng.uniform(0.5, 1.5)),
            blotches=float(domain.texture * rng.uniform(0.2, 0.8)),
            grain=float(domain.texture * rng.uniform(0.3, 1.2)),
            seed=int(rng.integers(2**31)),
            material=Material(
                specular=float(domain.specular * rng.uniform(0.5, 1.5)),
                roughness=domain.roughness,
                fill=float(domain.fill * rng.uniform(0.5, 1.5)),
                side_light=domain.side_light,
                top_light=domain.top_light,
            ),
            gaze=Gaze.random(rng),
        )


def paint(reference: Tensor, is_eye: Tensor, look: Look) -> Tensor:
    """Albedo in 0..1 of a person at points of the average head.

    Args:
        reference: ``(P, 3)``.
        is_eye: ``(P,)``, 1 on eyeballs, -1 where hair hangs free of the head.
        look: the person's.
    """
    skin = (
        look.pigment * smooth_noise(reference, 6, look.seed)
        + look.blotches * smooth_noise(reference, 16, look.seed + 3)
        + look.grain * smooth_noise(reference, 40, look.seed + 1)
    )
    hairs = 1 + 0.15 * smooth_noise(reference, 60, look.seed + 2)
    brow = (look.brows * hairs * brows(reference, look.brow_height, look.brow_width)).clamp(0, 0.95)
    (mouth, line), (around, under) = lips(reference), rings(reference)
    shaven = 0.7 * look.stubble * hairs * stubble(reference, mouth)
    left = (1 - brow) * (1 - look.lips * mouth) * (1 - look.line * line) * (1 - 0.65 * lashes(reference))
    left = left * (1 - look.sockets * around) * (1 - look.under * under) * (1 - shaven.clamp(0, 0.9))
    surface = tint(look.tone * torch.exp(skin) * left, reference, (-is_eye).clamp_min(0), look.style, look.hair)
    return torch.where(is_eye > 0.5, paint_eyes(reference, look.gaze, look.iris), surface).clamp(0.01, 1.5)
