"""Relit crops: a camera's curve undone, the light multiplied, the curve redone, as in :mod:`facerelight.photo.colour`.

What is shown is ``y = (1 + a) e^g / (1 + a e^g)`` of the scene's radiance ``e``, and so a ratio of light multiplies
``e^g`` by its own power g: that is kept instead of ``e``, which saves two powers of every pixel.
"""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo.colour import KNEE, SHOULDER, TOE, WHITEST

__all__ = ["linear_luminance", "raised_radiance", "scene_luminance", "to_display"]


def raised_radiance(coded: Tensor) -> Tensor:
    """``e^g`` of the scene's radiance, of sRGB-coded values in 0..1."""
    linear = torch.where(coded <= 0.04045, coded / 12.92, _power((coded + 0.055) / 1.055, 2.4))
    return linear / (1 + SHOULDER - SHOULDER * linear)


def scene_luminance(raised: Tensor) -> Tensor:
    """Radiance of grey or linear RGB crops ``(B, 1 or 3, H, W)``, ``(B, 1, H, W)``, of :func:`raised_radiance`."""
    return _power(linear_luminance(raised).clamp_min(1e-7), 1 / TOE)


def linear_luminance(linear: Tensor) -> Tensor:
    """Of grey or linear RGB crops ``(B, 1 or 3, H, W)``, ``(B, 1, H, W)``."""
    if linear.shape[1] == 1:
        return linear
    return (linear * torch.tensor(LUMINANCE).to(linear)[:, None, None]).sum(1, keepdim=True)


def to_display(raised: Tensor, ratio: Tensor) -> Tensor:
    """sRGB codes in 0..1 of crops ``raised (B, C, H, W)`` whose light is multiplied by ``ratio (B, 1, H, W)``; what
    becomes brighter spends the room that is left below white, and so never clips."""
    before = raised.amax(1, keepdim=True)
    factor = _power(ratio, TOE)
    most, own = _developed(before * factor), _developed(before)
    base = own.clamp_min(KNEE)
    room = (WHITEST - base).clamp_min(1e-3)
    rolled = torch.minimum(base + room * (1 - torch.exp(-(most - base).clamp_min(0) / room)), own.clamp_min(WHITEST))
    linear = _developed(raised * factor) * torch.where(most > base, rolled / most.clamp_min(1e-6), 1)
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * _power(linear.clamp_min(0.003), 1 / 2.4) - 0.055)


def _developed(raised: Tensor) -> Tensor:
    return (1 + SHOULDER) * raised / (1 + SHOULDER * raised)


def _power(values: Tensor, exponent: float) -> Tensor:
    """Of positive ``values``; twice as fast as a power."""
    return torch.exp(torch.log(values) * exponent)
