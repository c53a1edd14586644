"""Lights that are sums of directions: a window, a sky, several lamps. What a model of faces is asked about.

Light adds up, so a face under ``sum_j a_j s_j`` looks like the sum of its images under the single directions, and all
that is linear in the light (a mean, a covariance) is the sum of theirs.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from facerelight.geometry.lights import nearest_lights, unit_lights
from facerelight.geometry.sources import LightMixture
from facerelight.numerics.luminance import LUMINANCE

__all__ = ["LightSum", "check_light_sum", "edges", "is_behind"]

MOST = 512  # directions; more are gathered on as many places, even over the sphere, which moves each by 4 degrees
GATHERED_AT_ONCE = 2048


@dataclass(frozen=True)
class LightSum:
    """Lights, each a weighted sum of n distant points.

    ``directions``: unit vectors, ``(n, 3)`` where all lights share them, else ``(..., n, 3)``; ``amounts (..., n)``,
    non-negative, 1 being the strength of the light that the model's images are of. A single direction is ``n = 1``.

    Example:
        >>> two = LightSum(torch.eye(3), torch.tensor([[0.5, 0.0, 0.5]]))  # one light, of two directions
        >>> two.vector
        tensor([[0.5000, 0.0000, 0.5000]])
    """

    directions: Tensor
    amounts: Tensor

    @staticmethod
    def single(directions: Tensor) -> LightSum:
        """``directions (..., 3)``, a light each, of amount 1; a zero vector is no light."""
        amounts = (directions.detach().square().sum(-1, keepdim=True) > 0).to(directions)
        return LightSum(directions[..., None, :], amounts)

    @staticmethod
    def of(light: LightMixture, channel: int | None = None) -> LightSum:
        """A scene's light as one light, ``amounts (1, P)``: of its luminance, or of one ``channel`` of linear RGB."""
        seen = (
            light.weights @ torch.tensor(LUMINANCE).to(light.weights) if channel is None else light.weights[:, channel]
        )
        return LightSum(light.directions, seen[None])

    @property
    def shared(self) -> bool:
        """Whether all lights are sums of the same directions."""
        return self.directions.dim() == 2

    @property
    def vector(self) -> Tensor:
        """``sum_j a_j s_j``, ``(..., 3)``; zero where there is no light."""
        return (self.amounts[..., None, :] @ self.directions)[..., 0, :]

    def to(self, like: Tensor) -> LightSum:
        """In the dtype and on the device of ``like``."""
        return LightSum(self.directions.to(like), self.amounts.to(like))

    def __getitem__(self, index: int | Tensor) -> LightSum:
        """The lights at ``index`` of the amounts' first dimension."""
        return LightSum(self.directions if self.shared else self.directions[index], self.amounts[index])

    def expand(self, *sizes: int) -> LightSum:
        """Amounts, and directions where they are not shared, expanded to ``(*sizes, n)``; -1 keeps a size."""
        directions = self.directions if self.shared else self.directions.expand(*sizes, -1, -1)
        return LightSum(directions, self.amounts.expand(*sizes, -1))

    def insert(self, dimension: int) -> LightSum:
        """A dimension of size 1 before ``dimension``, counted from the front."""
        directions = self.directions if self.shared else self.directions.unsqueeze(dimension)
        return LightSum(directions, self.amounts.unsqueeze(dimension))


def check_light_sum(lights: LightSum, name: str) -> LightSum:
    """Unit directions, amounts that are none below zero, and few enough of them.

    More than 512 shared directions are gathered on an even sphere of 512, each amount at the nearest.

    Raises:
        ValueError: shapes that do not fit, directions that are none, amounts that are negative, NaN or infinite, or too
            many directions that are not shared.
    """
    directions, amounts = lights.directions, lights.amounts
    for part, tensor in (("directions", directions), ("amounts", amounts)):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            got = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{name}: expected a floating tensor of {part}, got {got}; try torch.as_tensor")
    fits = directions.dim() >= 2 and directions.shape[-1] == 3 and amounts.dim() >= 1 and amounts.shape[-1] >= 1
    fits = fits and directions.shape[:-1] in (amounts.shape, amounts.shape[-1:])
    if not fits:
        raise ValueError(
            f"{name}: expected directions (n, 3) or (..., n, 3) for amounts (..., n), got {tuple(directions.shape)}"
            f" and {tuple(amounts.shape)}"
        )
    seen = amounts.detach()
    if not (torch.isfinite(seen) & (seen >= 0)).all():  # NaN is neither
        raise ValueError(f"{name}: expected finite amounts of 0 or more, got {_worst(seen)}; light adds up, never down")
    directions = unit_lights(directions)
    if amounts.shape[-1] > MOST:
        if not lights.shared:
            raise ValueError(
                f"{name}: expected at most {MOST} directions a light, got {amounts.shape[-1]};"
                " give directions (n, 3) that all lights share"
            )
        return _gathered(directions, amounts)
    return LightSum(directions, amounts)


def _worst(amounts: Tensor) -> str:
    return "NaN or infinity" if not torch.isfinite(amounts).all() else f"{float(amounts.min()):g}"


def _gathered(directions: Tensor, amounts: Tensor) -> LightSum:
    """At most ``MOST`` places of an even sphere, with the amounts of the ``directions (n, 3)`` nearest to each."""
    places = even_sphere(MOST).to(directions)
    parts = [nearest_lights(part, places) for part in directions.detach().split(GATHERED_AT_ONCE)]
    gathered = amounts.new_zeros(*amounts.shape[:-1], MOST).index_add(-1, torch.cat(parts), amounts)
    return LightSum(places, gathered)


def even_sphere(count: int) -> Tensor:
    """``count`` directions spread evenly over the whole sphere, each of the same solid angle, ``(count, 3)``."""
    index = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * index + 1) / count
    turn = index * torch.pi * (3 - 5**0.5)
    radius = torch.sqrt(1 - z**2)
    return torch.stack((radius * torch.cos(turn), radius * torch.sin(turn), z), -1).float()


def is_behind(light: LightSum) -> bool:
    """Whether any of a light's directions that give light is behind the face."""
    return bool((light.amounts * light.directions[..., 2] < 0).any())


def edges(light: LightSum) -> list[LightSum]:
    """A ``light`` with amounts ``(1, n)``, what of it is behind the face brought to the image plane: to the nearest
    side fully, to the others the more, the nearer it is to the axis, where all are alike."""
    behind = light.directions[..., 2] < 0
    away = torch.nn.functional.pad(light.directions[..., :2], (0, 1))
    length = away.norm(dim=-1, keepdim=True)
    away = torch.where(length < 1e-6, away.new_tensor((1.0, 0.0, 0.0)), away / length.clamp_min(1e-6))
    side = torch.stack((-away[..., 1], away[..., 0], away[..., 2]), -1)
    depth = light.directions[..., 2].neg().clamp_min(0).sqrt()
    sides = ((away, torch.ones_like(depth)), (-away, depth), (side, depth), (-side, depth))
    return [
        LightSum(
            torch.where(behind[..., None], edge, light.directions), torch.where(behind, share, 1.0) * light.amounts
        )
        for edge, share in sides
    ]
