"""How much light comes from where, told by the model itself: the amounts of many directions, and how unsure they are.

A photograph under a sum of lights has a likelihood that the whole-face code is integrated out of, as under one light.
Amounts are non-negative and real light varies smoothly over the sphere, so their logarithms have a Gaussian process as
prior: ``a_j = exp(b + z_j)``, ``z ~ N(0, K)``. The most probable amounts are found by Newton's method with Fisher's
information in the place of the curvature, and that information gives samples.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from facerelight.geometry.sums import LightSum
from facerelight.light.estimator import LightEstimator, shared_errors
from facerelight.light.evidence import ImageEvidence, MixtureModel
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian
from facerelight.numerics.checks import check_radiance
from facerelight.numerics.luminance import BLACK
from facerelight.numerics.sampling import quasi_normal

__all__ = ["AmountsBelief", "SoftLightEstimator"]

SPREAD, REACH, ROUGH = 2.0, 0.5, 0.05
"""Prior of the logarithms of amounts: standard deviation, distance over which they go together on the unit sphere, and
the share of the variance that every direction has to itself."""
TEMPER = 16.0  # pixels are not independent given the code
LEVEL = 1e3  # standard deviation of the logarithm of the whole amount; it is then read off the average face
START = 1e-2  # of the largest amount: none starts lower
STEPS, HALVINGS = 30, 6
SETTLED = 1e-3  # of the log posterior
IMAGES_AT_ONCE = 8


class SoftLightEstimator(LightEstimator):
    """The amounts of many directions of light in a photograph, with samples.

    Args:
        statistics: what the bootstrap taught; the directions are the bootstrap's lights.
        pixels: about how many pixels to look at.

    Buffers: those of ``model``; ``prior (n, n)``, a Cholesky factor of the covariance of the amounts' logarithms.

    Example:
        >>> lights = torch.nn.functional.normalize(torch.randn(6, 3) + torch.tensor([0, 0, 2.0]), dim=1)
        >>> statistics = FaceStatistics.fit(torch.rand(5, 6, 24, 21), lights, rank=2, face_rank=2)
        >>> SoftLightEstimator(statistics).amounts(torch.rand(2, 1, 24, 21)).amounts.shape
        torch.Size([2, 1, 6])
    """

    prior: Tensor

    def __init__(self, statistics: FaceStatistics, pixels: int = 500) -> None:
        super().__init__()
        self.model = MixtureModel(statistics, pixels)
        squared = torch.cdist(statistics.lights.double(), statistics.lights.double()).square()
        smooth = torch.exp(-0.5 * squared / REACH**2) * (1 - ROUGH)
        covariance = SPREAD**2 * (smooth + ROUGH * torch.eye(len(squared)).to(smooth))
        self.register_buffer("prior", gaussian.safe_cholesky(covariance).to(statistics.lights))

    def amounts(self, images: Tensor, mask: Tensor | None = None) -> LightSum:
        """The most probable light of each of ``images (B, K, H, W)``, amounts ``(B, K, n)`` of shared directions; zero
        for an image without any light.

        Args:
            images: linear radiance.
            mask: ``(B, H, W)``, 0 where they do not show the face; None: everywhere they do.
        """
        return self._located(images, mask).light  # type: ignore[attr-defined]

    def locate(self, images: Tensor, mask: Tensor | None = None) -> AmountsBelief:
        """See :meth:`LightEstimator.locate`."""
        count, inputs = images.shape[:2]
        check_radiance(images, "images", "B K H W", self.model.size)
        flat = images.flatten(0, 1)
        weight = torch.ones_like(images) if mask is None else mask[:, None].expand_as(images)
        lit = flat.flatten(1).abs().amax(1) > BLACK  # (B K,)
        seen = self.model.look(flat, weight.flatten(0, 1))
        level = self.model.level(seen)  # (B K,): in the dark, amounts are told as well as in the light
        seen = seen._replace(seen=seen.seen / level[:, None])
        parts = [self._most_probable(part) for part in seen.split(IMAGES_AT_ONCE)]
        size = len(self.model.directions)
        if not parts:
            amounts, factor = self.prior.new_zeros(0, size), self.prior.new_zeros(0, size, size)
        else:
            amounts, factor = (torch.cat(each) for each in zip(*parts, strict=True))
        amounts = torch.where(lit[:, None], amounts * level[:, None], 0.0).unflatten(0, (count, inputs)).to(self.prior)
        return AmountsBelief(LightSum(self.model.directions, amounts), factor.unflatten(0, (count, inputs)))

    def sample_sums(
        self,
        images: Tensor,
        count: int,
        generator: torch.Generator | None = None,
        independent: bool = False,
        mask: Tensor | None = None,
    ) -> LightSum:
        """See :meth:`LightEstimator.sample_sums`; of shared directions."""
        drawn = self._located(images, mask).draw_sums(count, generator, independent)  # type: ignore[attr-defined]
        return drawn.to(images)

    def _most_probable(self, image: ImageEvidence) -> tuple[Tensor, Tensor]:
        """Amounts ``(B, n)`` of the photographs, and a factor ``(B, n, n)`` of the covariance of their logarithms."""
        prior = self.prior.double()
        turn = torch.cat((prior, torch.ones_like(prior[:, :1])), 1)  # (n, n + 1): from what is sought to logarithms
        precision = torch.ones_like(turn[0])
        precision[-1] = LEVEL**-2
        found = _coordinates(self.model.start(image).clamp_min(1e-12), prior)  # (B, n + 1)
        best = self._log_posterior(image, found, turn, precision)
        moving = torch.ones_like(best, dtype=torch.bool)  # photograph by photograph: none disturbs another
        for _ in range(STEPS):
            amounts = (found @ turn.T).exp()
            slope, information = self.model.slope(image, amounts)
            slope = (amounts * slope) @ turn / TEMPER - precision * found
            rows = amounts[..., None] * turn  # (B, n, n + 1)
            curvature = gaussian.safe_cholesky(rows.mT @ information @ rows / TEMPER + torch.diag(precision))
            step = torch.cholesky_solve(slope[..., None], curvature)[..., 0] * moving[:, None]
            found, better = self._climb(image, found, step, best, turn, precision)
            moving, best = moving & (better - best >= SETTLED), better
            if not moving.any():
                break
        amounts = (found @ turn.T).exp()
        _, information = self.model.slope(image, amounts)
        rows = amounts[..., None] * turn
        curvature = gaussian.safe_cholesky(rows.mT @ information @ rows / TEMPER + torch.diag(precision))
        amounts = amounts * self.model.gain(image, amounts)[:, None]
        return amounts, gaussian.solve_lower(curvature, turn.T.expand(len(found), -1, -1)).mT  # (B, n, n + 1)

    def _climb(
        self, image: ImageEvidence, found: Tensor, step: Tensor, best: Tensor, turn: Tensor, precision: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The first of the whole step, its half and so on that does not go down, photograph by photograph."""
        share = torch.ones_like(best)
        for _ in range(HALVINGS):
            tried = self._log_posterior(image, found + share[:, None] * step, turn, precision)
            down = ~(tried >= best)
            if not down.any():
                break
            share = torch.where(down, share / 2, share)
        share = torch.where(down, 0.0, share)
        return found + share[:, None] * step, torch.where(down, best, tried)

    def _log_posterior(self, image: ImageEvidence, found: Tensor, turn: Tensor, precision: Tensor) -> Tensor:
        likelihood = self.model.log_likelihood(image, (found @ turn.T).exp())
        return likelihood / TEMPER - 0.5 * (precision * found.square()).sum(-1)


def _coordinates(amounts: Tensor, prior: Tensor) -> Tensor:
    """Where ``amounts (B, n)`` are: ``z = L x + b``, ``(x, b)`` in ``(B, n + 1)``."""
    logarithms = amounts.clamp_min(START * amounts.amax(1, keepdim=True)).log()
    level = logarithms.mean(1, keepdim=True)
    return torch.cat((gaussian.solve_lower(prior, (logarithms - level).T).T, level), 1)


class AmountsBelief(NamedTuple):
    """Amounts of ``light``, ``(B, K, n)``, whose logarithms vary as ``factor (B, K, n, m)`` times m standard normal
    numbers."""

    light: LightSum
    factor: Tensor

    @property
    def direction(self) -> Tensor:
        """The middle of the light, ``(B, K, 3)``; zero for an image without any."""
        return nn.functional.normalize(self.light.vector, dim=-1)

    def draw(self, count: int, generator: torch.Generator | None, independent: bool) -> Tensor:
        """Middles of :meth:`draw_sums`, see :meth:`LightBelief.draw`."""
        return self.draw_sums(count, generator, independent).vector

    def draw_sums(self, count: int, generator: torch.Generator | None, independent: bool) -> LightSum:
        """``count`` lights, amounts ``(B, count, K, n)``, whose mean is the most probable one."""
        inputs, size = self.factor.shape[1], self.factor.shape[-1]
        noise = quasi_normal(count, inputs * size, generator, independent).reshape(count, inputs, size)
        noise = noise.to(self.factor)
        noise = torch.einsum("bjk,mkc->bmjc", shared_errors(self.direction).to(noise), noise)  # (B, count, K, m)
        away = torch.einsum("bknm,bckm->bckn", self.factor, noise)
        away = away - 0.5 * self.factor.square().sum(-1)[:, None]  # the mean of a log-normal
        return LightSum(self.light.directions, self.light.amounts[:, None] * away.exp().to(self.light.amounts))
