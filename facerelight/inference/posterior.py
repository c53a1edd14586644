"""What is known of a batch of persons after their images are seen: condition once, render any light at the cost of
linear algebra."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sources import LightMixture
from facerelight.geometry.sums import LightSum, check_light_sum
from facerelight.inference.normals import NormalPosterior, normal_posterior
from facerelight.inference.person import PersonPosterior
from facerelight.model.registration import undeform

__all__ = ["Lights", "Posterior", "Relit", "check_targets"]

Lights = Tensor | LightSum | LightMixture
"""Directions ``(..., 3)``, sums of directions with amounts ``(..., n)``, or one scene's light."""


class Relit(NamedTuple):
    """Relit images: ``mean`` and ``variance`` of every pixel, ``(B, Q, H, W)`` each, radiance and radiance squared.

    A mean is never negative; the variance is that of the Gaussian before it is clamped, of an image as noisy as the
    inputs.
    """

    mean: Tensor
    variance: Tensor


class Posterior:
    """Posteriors of a batch of B persons, ready to be rendered under as many lights as wanted.

    ``deformations (B, 6)`` say where the persons' faces lie beside the model's; None: in the same place. ``dtype`` is
    that of the images that are rendered; None: the statistics'.
    """

    def __init__(
        self,
        people: list[PersonPosterior],
        size: tuple[int, int],
        deformations: Tensor | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        self.people = people
        self.size = size
        self.dtype = dtype
        self.deformations = deformations

    def mean(self, target_lights: Lights) -> Tensor:
        """Relit images, the conditional mean (3.17), ``(B, Q, H, W)``; ``target_lights`` are directions ``(Q, 3)`` or
        ``(B, Q, 3)``, sums of directions with amounts ``(Q, n)`` or ``(B, Q, n)``, or a scene's light, Q = 1.

        Light adds up: the mean under a sum is the sum of the means. Gaussians know no black: what they put below zero,
        as behind the face, is rendered as 0, once all is summed.
        """
        return self._render("mean", target_lights)

    def mode(self, target_lights: Lights) -> Tensor:
        """The most probable image (Algorithm 1) instead of the expected one, ``(B, Q, H, W)``; the same where the
        lights are known."""
        return self._render("mode", target_lights)

    def variance(self, target_lights: Lights) -> Tensor:
        """The variance of every relit pixel (3.17), ``(B, Q, H, W)``: of the person, the gain, the light where it was
        estimated (Algorithm 2), and noise."""
        return self._render("variance", target_lights)

    def render(self, target_lights: Lights) -> Relit:
        """Mean and variance under ``target_lights``."""
        return Relit(self.mean(target_lights), self.variance(target_lights))

    def code(self) -> Tensor:
        """The whole-face code, a compact description of the person, ``(B, k)``; zero where nothing was observed."""
        if not self.people:
            raise ValueError("code: expected one person or more, got none")
        first = self.people[0]
        if first.face is None:
            raise RuntimeError("code: expected a relighter with covariance='face'; the per-pixel model has none")
        zero = first.n_map.new_zeros(len(first.face.n))
        return torch.stack(
            [torch.stack([c[:, 0] for c, _ in p.codes]).mean(0).to(zero) if p.codes else zero for p in self.people]
        )

    def normals(self) -> NormalPosterior:
        """n, the normals times the albedo, of everybody: mean ``(B, 3, H, W)``, covariance ``(B, 3, 3, H, W)`` and what
        the unknown brightness moves, ``(B, 3, H, W)``; radiance, see :class:`NormalPosterior`."""
        if not self.people:
            raise ValueError("normals: expected one person or more, got none")
        parts = zip(*map(normal_posterior, self.people), strict=True)
        mean, covariance, shared = (torch.stack(part).unflatten(-1, self.size) for part in parts)
        if self.deformations is not None:
            mean, covariance, shared = (
                torch.stack([_undeformed(m, theta) for m, theta in zip(maps, self.deformations, strict=True)])
                for maps in (mean, covariance, shared)
            )
        return NormalPosterior(mean, covariance, shared)

    def _render(self, what: str, target_lights: Lights) -> Tensor:
        targets = check_targets(target_lights, len(self.people))
        if self.people:
            targets = targets.to(self.people[0].n_map)
        count = targets.amounts.shape[1]
        if not self.people or not count:
            return targets.amounts.new_zeros(len(self.people), count, *self.size, dtype=self.dtype)
        images = torch.stack(
            [getattr(person, what)(_plain(targets[index])) for index, person in enumerate(self.people)]
        )
        images = images.unflatten(-1, self.size).to(self.dtype or images.dtype)
        if self.deformations is not None:
            images = torch.stack([undeform(i, theta) for i, theta in zip(images, self.deformations, strict=True)])
        return images.clamp_min(0)


def _undeformed(maps: Tensor, theta: Tensor) -> Tensor:
    """``maps (..., H, W)`` where the face lies."""
    flat = maps.flatten(0, -3)
    return undeform(flat.to(theta), theta).to(maps).view_as(maps)


def check_targets(target_lights: Lights, people: int) -> LightSum:
    """Lights of the same Q for everybody, or each person's own; always amounts ``(people, Q, n)`` come back.

    Raises:
        ValueError: shapes that do not fit, directions or amounts that are none.
    """
    if isinstance(target_lights, LightSum | LightMixture):
        lights = LightSum.of(target_lights) if isinstance(target_lights, LightMixture) else target_lights
        lights = check_light_sum(lights, "target lights")
        dimensions = lights.amounts.dim()
        if dimensions not in (2, 3) or (dimensions == 3 and len(lights.amounts) != people):
            raise ValueError(
                f"target lights: expected amounts (Q, n) or ({people}, Q, n), got {tuple(lights.amounts.shape)}"
            )
        return lights if dimensions == 3 else lights.insert(0).expand(people, -1)
    if not isinstance(target_lights, Tensor):
        raise ValueError(f"target lights: expected a tensor, got {type(target_lights).__name__}; try torch.as_tensor")
    shape = tuple(target_lights.shape)
    if shape[-1:] != (3,) or len(shape) not in (2, 3) or (len(shape) == 3 and shape[0] != people):
        raise ValueError(f"target lights: expected (Q, 3) or ({people}, Q, 3), got {shape}")
    lights = LightSum.single(unit_lights(target_lights))
    return lights if len(shape) == 3 else lights.insert(0).expand(people, -1)


def _plain(lights: LightSum) -> Tensor | LightSum:
    """Single lights at full strength as directions ``(Q, 3)``, which is faster."""
    single = not lights.shared and lights.amounts.shape[-1] == 1 and bool((lights.amounts == 1).all())
    return lights.directions[:, 0] if single else lights
