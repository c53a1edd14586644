"""What is known of a batch of persons after their images are seen: condition once, render any light at the cost of
linear algebra."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.lights import unit_lights
from facerelight.inference.person import PersonPosterior
from facerelight.model.registration import undeform

__all__ = ["Posterior", "Relit"]


class Relit(NamedTuple):
    """Relit images: ``mean`` and ``variance`` of every pixel, ``(B, Q, H, W)`` each, radiance and radiance squared.

    A mean is never negative; the variance is that of the Gaussian before it is clamped, of an image as noisy as the
    inputs.
    """

    mean: Tensor
    variance: Tensor


class Posterior:
    """Posteriors of a batch of B persons, ready to be rendered under as many lights as wanted.

    ``deformations (B, 6)`` say where the persons' faces lie beside the model's; None: in the same place.
    """

    def __init__(
        self, people: list[PersonPosterior], size: tuple[int, int], deformations: Tensor | None = None
    ) -> None:
        self.people = people
        self.size = size
        self.deformations = deformations

    def mean(self, target_lights: Tensor) -> Tensor:
        """Relit images, the conditional mean (3.17), ``(B, Q, H, W)``; ``target_lights`` is ``(Q, 3)`` or
        ``(B, Q, 3)``.

        Gaussians know no black: what they put below zero, as behind the face, is rendered as 0.
        """
        return self._render("mean", target_lights)

    def mode(self, target_lights: Tensor) -> Tensor:
        """The most probable image (Algorithm 1) instead of the expected one, ``(B, Q, H, W)``; the same where the
        lights are known."""
        return self._render("mode", target_lights)

    def variance(self, target_lights: Tensor) -> Tensor:
        """The variance of every relit pixel (3.17), ``(B, Q, H, W)``: of the person, the gain, the light where it was
        estimated (Algorithm 2), and noise."""
        return self._render("variance", target_lights)

    def render(self, target_lights: Tensor) -> Relit:
        """Mean and variance under ``target_lights``."""
        return Relit(self.mean(target_lights), self.variance(target_lights))

    def code(self) -> Tensor:
        """The whole-face code, a compact description of the person, ``(B, k)``; zero where nothing was observed."""
        first = self.people[0]
        if first.face is None:
            raise RuntimeError("code: expected a relighter with covariance='face'; the per-pixel model has none")
        zero = torch.zeros(len(first.face.n))
        return torch.stack(
            [torch.stack([c[:, 0] for c, _ in p.codes]).mean(0).to(zero) if p.codes else zero for p in self.people]
        )

    def _render(self, what: str, target_lights: Tensor) -> Tensor:
        reference = self.people[0].n_map
        targets = unit_lights(target_lights.to(reference))
        if targets.dim() == 2:
            targets = targets.expand(len(self.people), -1, -1)
        if targets.dim() != 3 or len(targets) != len(self.people):
            raise ValueError(
                f"target lights: expected (Q, 3) or ({len(self.people)}, Q, 3), got {tuple(target_lights.shape)}"
            )
        images = torch.stack(
            [getattr(person, what)(lights) for person, lights in zip(self.people, targets, strict=True)]
        )
        images = images.unflatten(-1, self.size)
        if self.deformations is not None:
            images = torch.stack([undeform(i, theta) for i, theta in zip(images, self.deformations, strict=True)])
        return images.clamp_min(0)
