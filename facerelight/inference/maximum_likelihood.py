"""The special case of a fixed, unknown n (3.5.1): at least three inputs under known, independent lights tell it without
a prior."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sums import LightSum, edges, is_behind
from facerelight.inference.posterior import Relit
from facerelight.model.brightness import read_gain, reading_errors, reading_weight
from facerelight.model.covariance import deviation_covariance, observed, same_light
from facerelight.model.light_terms import LightTerms, gain_noise, light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian

__all__ = ["MaximumLikelihood"]

LARGEST_CONDITION = 1e4  # of the input lights' matrix


class MaximumLikelihood:
    """n by maximum likelihood (3.19), the deviation by kriging (3.20); condition once, render often.

    Args:
        statistics: only the deviation's are used: n has no prior here.
        images: ``(K, H, W)`` of one person, K >= 3.
        lights: ``(K, 3)``, or sums with amounts ``(K, n)``, of rank 3.
        noise: standard deviation of the images' noise in radiance, ``(K, 1)`` or ``(K, P)``; None: none, and the images
            are returned exactly.
        mask: ``(H, W)``, 0 where the images do not show the face and so say nothing about its brightness.
        new_noise: standard deviation of the noise of the images that are rendered, which their variance counts.

    Raises:
        ValueError: fewer than three lights, or lights (nearly) in one plane; says how many and the condition number.
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        images: Tensor,
        lights: Tensor | LightSum,
        noise: Tensor | None = None,
        mask: Tensor | None = None,
        new_noise: float = 0.0,
    ) -> None:
        assert statistics.pixel is not None
        self.statistics, self._pixel = statistics, statistics.pixel
        self.terms = light_terms(statistics, statistics.pixel, _lights(lights))
        self.lights = self.terms.light
        singular = torch.linalg.svdvals(normalize(self.lights.double(), dim=1))
        condition = float(singular[0] / singular[-1]) if len(self.lights) >= 3 and singular[-1] > 0 else float("inf")
        if condition > LARGEST_CONDITION:
            raise ValueError(
                "method='mle': expected at least 3 input images under lights that do not lie in one plane, "
                f"got {len(self.lights)} with condition number {condition:.3g};"
                " give more lights or use method='expected'"
            )
        covariance = deviation_covariance(statistics, statistics.pixel, self.terms, self.terms)  # (P, K, K)
        pixels = images.flatten(1).to(statistics.n_mean)  # (K, P)
        sigma = pixels.new_zeros(len(images), 1) if noise is None else noise
        sigma = sigma.to(device=pixels.device, dtype=torch.float64)
        self.noise_variance = new_noise**2  # of a new image
        expected = self.terms.mean
        counted = reading_weight(expected, sigma, None if mask is None else mask.flatten().to(pixels))
        errors = reading_errors(gain_noise(statistics, self.terms), normalize(self.lights, dim=1), expected, counted)
        self.gain = read_gain(pixels, expected, float(statistics.gain_spread), errors, counted, sigma)
        self.factor = gaussian.safe_cholesky(observed(covariance, sigma.T / self.gain.value))
        average = self.terms.weights @ statistics.v_mean.flatten(1)  # (K, P)
        # y - mu_v of the images, and of black ones: (P, K, 2)
        residual = torch.stack((pixels / self.gain.value - average, -average), -1).double().transpose(0, 1)
        design = self.lights.double().expand(len(residual), -1, -1)  # S^T, (P, K, 3)
        self._design = gaussian.solve_lower(self.factor, design)
        white = gaussian.solve_lower(self.factor, residual)
        self._precision = gaussian.safe_cholesky(self._design.mT @ self._design)  # of n, (P, 3, 3)
        self.normal = torch.cholesky_solve(self._design.mT @ white, self._precision)  # n_MLE, (P, 3, 2)
        self._left = white - self._design @ self.normal

    def render(self, target: Tensor | LightSum) -> tuple[Tensor, Tensor]:
        """Mean and variance ``(P,)`` under one light, ``(3,)`` or amounts ``(n,)``, noise and what is not known of the
        gain counted; behind the face the variance is not below that at the edges.

        The thesis's (3.23) for the variance drops a correlation; this is the kriging form, zero where the target is an
        input light: ``d^T (S Sigma_v^-1 S^T)^-1 d + sigma_0^2 - r^T Sigma_v^-1 r`` with ``d = s_0 - S Sigma_v^-1 r``.
        """
        light = _lights(target).insert(0)
        terms = light_terms(self.statistics, self._pixel, light)
        mean, variance = self._render(terms)
        if is_behind(light):
            new = 1 - same_light(self.statistics, terms, self.terms).amax()
            for edge in edges(light):
                at_edge = self._render(light_terms(self.statistics, self._pixel, edge))[1]
                variance = torch.maximum(variance, new * at_edge)
        return mean, variance

    def _render(self, terms: LightTerms) -> tuple[Tensor, Tensor]:
        statistics, pixel = self.statistics, self._pixel
        shared = deviation_covariance(statistics, pixel, self.terms, terms)  # r, (P, K, 1)
        cross = gaussian.solve_lower(self.factor, shared)  # L^-1 r
        average = (terms.weights @ statistics.v_mean.flatten(1)).double()[0]
        mean = terms.light.double() @ self.normal + average[:, None, None] + cross.mT @ self._left  # (P, 1, 2)
        mean, black = mean[:, 0].unbind(1)
        missing = terms.light[0].double()[:, None] - self._design.mT @ cross  # d, (P, 3, 1)
        of_normal = gaussian.solve_lower(self._precision, missing).square().sum((1, 2))
        own = deviation_covariance(statistics, pixel, terms, terms)[:, 0, 0]
        variance = of_normal + gaussian.positive_variance(own - cross.square().sum((1, 2)), own)
        gain, spread = self.gain  # the mean under gain g is g black + (what is linear in the images)
        return gain * mean, gain**2 * (variance + spread**2 * black.square()) + self.noise_variance

    def relight(self, targets: Tensor | LightSum) -> Relit:
        """Mean, never negative, and variance ``(Q, H, W)`` under ``targets``, ``(Q, 3)`` or sums with amounts
        ``(Q, n)``, in the statistics' dtype."""
        lights = _lights(targets)
        if not len(lights.amounts):
            empty = self.lights.new_zeros(0, *self.statistics.size)
            return Relit(empty, empty)
        mean, variance = (
            torch.stack(parts)
            for parts in zip(*(self.render(lights[q]) for q in range(len(lights.amounts))), strict=True)
        )
        size = self.statistics.size
        return Relit(mean.clamp_min(0).unflatten(1, size).to(self.lights), variance.unflatten(1, size).to(self.lights))

    def normal_covariance(self) -> Tensor:
        """``Var[n_MLE] = (S Sigma_v^-1 S^T)^-1`` of every pixel, ``(P, 3, 3)``."""
        eye = torch.eye(3, dtype=torch.float64, device=self._precision.device).expand_as(self._precision)
        return torch.cholesky_solve(eye, self._precision)


def _lights(lights: Tensor | LightSum) -> LightSum:
    return LightSum.single(unit_lights(lights)) if isinstance(lights, Tensor) else lights
