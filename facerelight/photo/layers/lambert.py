"""Normals and albedo behind n.

n is the Lambertian surface that fits a face's images best, in least squares over the bootstrap's lights. Where the
surface turns away from some of them its images are black there, and the fit leans towards the camera and grows darker:
by how much, a sphere tells.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.bootstrap.domain import lamp_strength

__all__ = ["LambertSphere"]

STEPS = 181
PAST_EDGE = math.radians(15)  # beyond 90 degrees from the camera: an average over people reaches a little further


class LambertSphere:
    """What least squares over ``lights (J, 3)`` makes of a white sphere with attached shadows, and the way back.

    Args:
        lights: of the statistics.
        side_light: a lamp at the side is brighter by this share than one at the camera, see
            :class:`facerelight.bootstrap.domain.Domain`.

    Example:
        >>> from facerelight.geometry.lights import even_hemisphere
        >>> normal, albedo = LambertSphere(even_hemisphere(64)).undo(torch.tensor([[0.0], [0.0], [0.4]]))
        >>> normal[:, 0].tolist()
        [0.0, 0.0, 1.0]
    """

    def __init__(self, lights: Tensor, side_light: float = 0.0) -> None:
        lights = lights.detach().double().cpu()
        turn = torch.arange(0, 2 * math.pi - 1e-6, math.pi / 8, dtype=torch.float64)
        self._polar = torch.linspace(0, math.pi / 2 + PAST_EDGE, STEPS, dtype=torch.float64)
        sin, cos = torch.sin(self._polar)[:, None], torch.cos(self._polar)[:, None]
        outward = torch.stack(
            (turn.cos().expand(STEPS, -1), turn.sin().expand(STEPS, -1), 0 * turn.expand(STEPS, -1)), -1
        )
        normal = sin[..., None] * outward + cos[..., None] * torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
        lamp = lamp_strength(lights[:, 1], lights[:, 2], side_light)
        fitted = ((normal @ lights.T).clamp_min(0) * lamp) @ torch.linalg.pinv(lights).T  # (STEPS, 16, 3)
        aside, ahead = (fitted * outward).sum(-1).mean(1), fitted[..., 2].mean(1)
        self._fitted = torch.atan2(aside, ahead).cummax(0).values  # leans to the camera, and never turns back
        self._length = torch.hypot(aside, ahead)

    def undo(self, n: Tensor) -> tuple[Tensor, Tensor]:
        """Unit normals ``(3, ...)`` and albedo ``(...)`` of ``n (3, ...)``; zero where n is zero."""
        vector = n.double()
        aside = torch.linalg.vector_norm(vector[:2], dim=0)
        polar = torch.atan2(aside, vector[2]).clamp(0, float(self._fitted[-1]))
        after = torch.searchsorted(self._fitted, polar.contiguous()).clamp(1, STEPS - 1)
        low, high = self._fitted[after - 1], self._fitted[after]
        share = ((polar - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
        angle = torch.lerp(self._polar[after - 1], self._polar[after], share)
        length = torch.lerp(self._length[after - 1], self._length[after], share)
        outward = normalize(vector[:2], dim=0, eps=1e-12)
        size = torch.linalg.vector_norm(vector, dim=0)
        normal = torch.cat((outward * torch.sin(angle), torch.cos(angle)[None])) * (size > 0)
        return normal.to(n), (size / length).to(n)
