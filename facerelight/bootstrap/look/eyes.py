"""Eyes: the paint of eyeballs and lashes, on the average head, and the shade that lids cast on what they cover.

Positions are in the units of :mod:`heads`: eyes at (-0.5, 0) and (0.5, 0).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.heads.rest import HALF_WIDTH, LOWER, UPPER

__all__ = ["Gaze", "lashes", "lid_shade", "paint_eyes"]

IRIS_RADIUS = 0.093  # 5.9 of 63 millimetres


class Gaze(NamedTuple):
    """One person's eyes, in eye distances: the iris lies ``aside`` (both alike) and ``up`` from the eyes' centres;
    radii of ``iris`` and ``pupil``; ``white``, the sclera's albedo."""

    aside: float
    up: float
    iris: float
    pupil: float
    white: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Gaze:
        """Draw a person's."""
        return cls(
            aside=float(rng.normal(0, 0.02)),
            up=float(rng.normal(0.005, 0.012)),
            iris=float(IRIS_RADIUS * (1 + 0.03 * rng.standard_normal())),
            pupil=float(rng.uniform(0.03, 0.05)),
            white=float(rng.uniform(0.35, 0.55)),
        )


def paint_eyes(reference: Tensor, gaze: Gaze, darkness: float) -> Tensor:
    """Albedo of eyeballs in 0..1 at points of the average head: ``reference (P, 3)`` -> ``(P,)``.

    Args:
        reference: where the points lie.
        gaze: the person's.
        darkness: of the iris, 0 an albedo of 0.3, 1 black.
    """
    x, y, _ = reference.unbind(-1)
    side = x.abs()
    along = ((side - 0.5) / HALF_WIDTH).square().clamp_max(1.5)
    duct = torch.exp(-0.5 * ((side - 0.5 + 0.92 * HALF_WIDTH) / 0.025).square())
    white = gaze.white * (1 - 0.35 * along) * (1 - 0.4 * duct)
    from_axis = torch.hypot(side - 0.5 - gaze.aside * x.sign(), y - gaze.up)
    outward = from_axis / gaze.iris
    ring = torch.exp(-0.5 * ((outward - 0.88) / 0.1).square())  # the limbus
    iris = 0.3 * (1 - darkness) * (0.8 + 0.4 * outward.clamp_max(1)) * (1 - 0.45 * ring)
    eye = torch.lerp(white, iris, torch.sigmoid((gaze.iris - from_axis) / 0.003))
    return torch.lerp(eye, torch.full_like(eye, 0.012), torch.sigmoid((gaze.pupil - from_axis) / 0.003))


def lashes(reference: Tensor) -> Tensor:
    """How much lashes darken the skin, 0..1, ``(P, 3)`` -> ``(P,)``: dense on the rim of the upper lid, thin below."""
    x, y, z = reference.unbind(-1)
    u = (x.abs() - 0.5) / (1.05 * HALF_WIDTH)
    arc = 1 - u.square()
    upper = torch.exp(-0.5 * ((y - UPPER * arc - 0.008) / 0.015).square()) * (0.8 + 0.2 * u.clamp(-1, 1))
    lower = 0.3 * torch.exp(-0.5 * ((y - LOWER * arc + 0.008) / 0.012).square())
    return torch.maximum(upper, lower) * torch.sigmoid((1 - u.abs()) / 0.05) * torch.sigmoid((z + 0.3) / 0.03)


def lid_shade(eye: Tensor, eye_distance: float) -> Tensor:
    """What the upper lid and its lashes leave of the light that falls on the eyeball beneath, ``(H, W)``, 1 elsewhere.

    Args:
        eye: ``(H, W)`` bool, where an eyeball is seen.
        eye_distance: in pixels.
    """
    rows = torch.arange(len(eye))[:, None]
    lid = torch.where(eye, -1, rows).cummax(0).values  # the last pixel above that is no eye
    below = (rows - lid - 0.5) / max(eye_distance, 1e-6)
    return torch.where(eye, 1 - 0.4 * torch.exp(-below / 0.03), 1.0)
