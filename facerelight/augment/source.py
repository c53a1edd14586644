"""The light that crops were taken in, a batch at a time, and what the crops would look like under its middle."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.light.soft import one_lamp_quotient

__all__ = ["FRONT", "SourceLights", "find_source_lights", "front_lights"]

FRONT = (0.0, 0.0, 1.0)
STEPS = 100  # multiplicative updates
FAINT = 1e-4  # radiance of all amounts together: a crop with less is black
NOT_A_FACE = 0.45  # of a crop's own power: an average face under the best light misses by less


class SourceLights(NamedTuple):
    """``share (B, J)`` of the bootstrap lights in each crop's light, of sum 1; ``strength (B,)``, their whole amount;
    ``direction (B, 3)``, its middle; ``known (B,)`` bool, whether the crop may be a lit face: it is
    neither black nor of another contrast."""

    share: Tensor
    strength: Tensor
    direction: Tensor
    known: Tensor

    def equivalent(self, average: Tensor, single: Tensor) -> Tensor:
        """By how much the average face is brighter under one light than under the crop's own of the same strength,
        ``(B, P)``: crops times that, over their strength, are crops under the one light.

        Args:
            average: ``(J, P)``, the average face under each bootstrap light.
            single: ``(B, P)``, under the one.
        """
        return one_lamp_quotient(single, self.share @ average.clamp_min(0))


def find_source_lights(average: Tensor, lights: Tensor, luminance: Tensor, mask: Tensor) -> SourceLights:
    """The lights of crops, non-negative least squares on the average face (Lee and Seung 2000).

    Args:
        average: ``(J, P)``, the average face under each bootstrap light.
        lights: ``(J, 3)``.
        luminance: ``(B, P)`` radiance of the crops.
        mask: ``(B, P)``, or ``(1, P)`` where it is everybody's, 0 where they do not show the face.
    """
    basis = average.clamp_min(0)
    gram = (basis * mask[:, None]) @ basis.T  # (B or 1, J, J)
    target = (luminance * mask) @ basis.T  # (B, J)
    amounts = (target.sum(1) / gram.sum((1, 2)).clamp_min(1e-12))[:, None].expand_as(target)
    for _ in range(STEPS):
        through = amounts @ gram[0] if len(gram) == 1 else (gram @ amounts[..., None])[..., 0]
        amounts = amounts * target / through.clamp_min(1e-12)
    return _described(amounts, basis, lights, luminance, mask)


def front_lights(average: Tensor, lights: Tensor, luminance: Tensor, mask: Tensor) -> SourceLights:
    """As :func:`find_source_lights`, taking the light to stand at the camera: its strength alone is found."""
    nearest = int((lights @ lights.new_tensor(FRONT)).argmax())
    expected = average[nearest].clamp_min(0)
    strength = (luminance * mask) @ expected / (mask @ expected.square()).clamp_min(1e-12)
    amounts = torch.nn.functional.one_hot(torch.tensor(nearest), len(lights)).to(average) * strength[:, None]
    found = _described(amounts, average.clamp_min(0), lights, luminance, mask)
    return found._replace(direction=lights.new_tensor(FRONT).expand_as(found.direction))


def _described(amounts: Tensor, basis: Tensor, lights: Tensor, luminance: Tensor, mask: Tensor) -> SourceLights:
    strength = amounts.sum(1)
    share = amounts / strength.clamp_min(FAINT)[:, None]
    direction = torch.nn.functional.normalize(share @ lights, dim=1)
    missed = ((luminance - amounts @ basis).square() * mask).sum(1)
    known = (strength > FAINT) & (missed < NOT_A_FACE**2 * (luminance.square() * mask).sum(1))
    return SourceLights(share, strength, direction, known)
