"""What is known of one person's face after their images are seen: condition once, render any light by linear algebra.

K input images, k whole-face loadings, J bootstrap lights, P pixels, Q target lights, M hypotheses about the input
lights, r columns of the correlation factor.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.lights import unit_lights
from facerelight.model.brightness import Gain, read_gain, reading_noise
from facerelight.model.covariance import (
    LightTerms,
    image_covariance,
    light_terms,
    loadings_at,
    narrow_terms,
    observed,
)
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian
from facerelight.numerics.mixture import mixture_mode

__all__ = ["Components", "PersonPosterior", "edges"]

NEAR = 1e-3  # kernel values below this move a pixel by less than a tenth of a grey level
PIXELS_AT_ONCE = 1024


class Components(NamedTuple):
    """A mixture of Gaussians at every pixel: ``mean``, ``variance`` ``(M, P)`` and ``weight (M,)``, float64."""

    mean: Tensor
    variance: Tensor
    weight: Tensor


class _Evidence(NamedTuple):
    """One light hypothesis: input lights' terms, ``g = R_yy^-1 (y - mu_y)`` ``(K, P)`` and the factor of ``R_yy``
    ``(P, K, K)``; ``solved_black`` and ``code_black`` are those of black inputs, y = 0."""

    terms: LightTerms
    solved: Tensor
    solved_black: Tensor
    cholesky: Tensor
    inputs: Tensor | None  # whitened loadings L^-1 L_y, (P, K, k)
    code_black: Tensor | None  # (k,)
    gain: Gain  # the person's brightness


class PersonPosterior:
    """The posterior of one person; averaged over ``M`` hypotheses about the input lights.

    Args:
        statistics: what the bootstrap taught.
        images: ``(K, H, W)``.
        hypotheses: ``(M, K, 3)`` input lights; a zero light takes its image out of the evidence.
        covariance: "pixel" or "face".
        mask: ``(H, W)``, 0 where the images do not show the face (hair, a hat) and so say nothing about the whole-face
            code.
        noise: standard deviation of the inputs' noise in radiance, ``(K, 1)`` or ``(K, P)``; a new image is taken to be
            as noisy as they are on average. None: none, and inputs are returned exactly.
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        images: Tensor,
        hypotheses: Tensor,
        covariance: str,
        mask: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> None:
        self.statistics = statistics
        self.face = statistics.face if covariance == "face" else None
        pixel = statistics.pixel if self.face is None else self.face.residual
        assert pixel is not None
        self.pixel = pixel
        self.visible = None if mask is None else mask.flatten().double()
        pixels = images.flatten(1)
        sigma = images.new_zeros(len(images), 1, dtype=torch.float64) if noise is None else noise.double()
        self.noise_variance = sigma.square().mean(0)  # of a new image, (1,) or (P,)
        self.n_map = torch.zeros_like(statistics.n_mean.flatten(1))
        self.v_map = torch.zeros_like(statistics.v_mean.flatten(1))
        self.pull = torch.zeros_like(self.v_map)
        self.v_variance = pixel.v_std.flatten(1).square()
        self.codes: list[tuple[Tensor, Tensor]] = []
        self.evidence: list[_Evidence] = []
        self._left: Tensor | None = None
        seen = hypotheses.square().sum(-1) > 0
        for lights, kept in zip(hypotheses, seen, strict=True):
            if kept.any():
                self._add(pixels[kept], unit_lights(lights[kept]), sigma[kept], 1 / len(hypotheses))
        self.prior_share = 1 - len(self.evidence) / len(hypotheses)
        self.n_map += self.prior_share * statistics.n_mean.flatten(1)
        self.v_map += self.prior_share * statistics.v_mean.flatten(1)

    def _add(self, images: Tensor, lights: Tensor, noise: Tensor, of_all: float) -> None:
        statistics, pixel = self.statistics, self.pixel
        terms = light_terms(statistics, pixel, lights, self.face)
        covariance = image_covariance(statistics, pixel, terms, terms)  # (P, K, K)
        loadings = None if self.face is None else loadings_at(self.face, terms)  # (K, k, P)
        unsure = terms.weights @ statistics.gain_noise  # (K,)
        if loadings is not None and self.visible is not None:
            unsure = reading_noise(unsure, terms.mean, loadings, self.visible)
        known = read_gain(images, terms.mean, float(statistics.gain_spread), unsure, self.visible)
        gain = known.value
        cholesky = gaussian.safe_cholesky(observed(covariance, noise.T / gain))  # (P, K, K)
        residual = torch.stack((images / gain - terms.mean, -terms.mean), -1).double().transpose(0, 1)  # (P, K, 2)
        whitened = gaussian.solve_lower(cholesky, residual)  # (P, K, 2): of the inputs, and of black ones
        inputs, code_black = None, None
        if self.face is not None and loadings is not None:
            inputs = gaussian.solve_lower(cholesky, loadings.permute(2, 0, 1).double())  # (P, K, k)
            # (k, 2), (k, k)
            code, spread = gaussian.low_rank_code(inputs, whitened, float(self.face.temper), self.visible)
            self.codes.append((code[:, :1], spread))
            code_black = code[:, 1]
            whitened = whitened - inputs @ code
            self._explain(code[:, 0].to(images), of_all * gain)
        solved, black = gaussian.solve_upper(cholesky, whitened).permute(2, 1, 0)  # g, (K, P)
        self.evidence.append(_Evidence(terms, solved, black, cholesky, inputs, code_black, known))
        share = of_all * gain
        self.n_map += share * statistics.n_mean.flatten(1)
        self.v_map += share * statistics.v_mean.flatten(1)
        # n_MAP and the pull of the bootstrap lights, averaged over the hypotheses
        root = pixel.n_factor.flatten(2)  # (3, 3, P)
        facing = (lights.double().T @ solved).to(images)  # S g, (3, P)
        self.n_map += share * torch.einsum("dcp,ecp,ep->dp", root, root, facing)
        learned = pixel.v_factor.flatten(2)  # (J, r, P)
        unique = self._unique()
        shared = (terms.factor * solved[:, None]).sum(0).to(images)  # (r, P)
        own = (terms.weights.double().T @ (terms.std * solved)).to(images)  # (J, P)
        self.pull += share * ((learned * shared).sum(1) + unique * own)

    def _unique(self) -> Tensor:
        """What of the deviation at each bootstrap light the correlation factor leaves to that light alone, ``(J, P)``;
        worked out once."""
        if self._left is None:
            self._left = 1 - self.pixel.v_factor.flatten(2).square().sum(1)
        return self._left

    def _explain(self, code: Tensor, share: Tensor) -> None:
        """Move the mean maps by what the whole-face code says."""
        face = self.face
        assert face is not None
        self.n_map += share * torch.tensordot(code, face.n.flatten(2), 1)
        self.v_map += share * (face.basis.T @ torch.tensordot(code, face.v.flatten(2), 1))

    def explained(self) -> Tensor:
        """What the average face and the whole-face code make of the inputs, up to brightness, without any pixel's own
        deviation, ``(K, P)``."""
        evidence = self.evidence[0]
        image = evidence.terms.mean
        if self.face is not None:
            image = image + self.codes[0][0][:, 0].to(image) @ loadings_at(self.face, evidence.terms)
        return image

    def mean(self, targets: Tensor) -> Tensor:
        """Conditional mean under ``targets (Q, 3)``, ``(Q, P)``: four matrix products, and a narrow term near the input
        lights.

        By blocks of pixels: what a block needs stays in the cache, which makes this as fast as the bare products.
        """
        weights = self.statistics.weights(targets)  # (Q, J)
        mixed, maps = torch.cat((weights, targets), 1), torch.cat((self.v_map, self.n_map))  # (Q, J + 3), (J + 3, P)
        near = [self._near(targets, evidence) for evidence in self.evidence]
        count, pixels = len(targets), maps.shape[1]
        if torch.is_grad_enabled() and any(part.requires_grad for part in (mixed, maps, self.pull)):
            return self._graph_mean(mixed, maps, near)
        image = maps.new_empty(count, pixels)
        # Fresh memory for every block would cost as much as the products.
        scratch = maps.new_empty(2, count * min(pixels, PIXELS_AT_ONCE))
        for start in range(0, pixels, PIXELS_AT_ONCE):
            here = slice(start, min(start + PIXELS_AT_ONCE, pixels))
            block, pull = (buffer[: count * (here.stop - start)].view(count, -1) for buffer in scratch)
            torch.mm(weights, self.v_variance[:, here], out=block).sqrt_()
            block.mul_(torch.mm(weights, self.pull[:, here], out=pull)).addmm_(mixed, maps[:, here])
            for evidence, (rows, kernel) in zip(self.evidence, near, strict=True):
                if len(rows):
                    block[rows] += self._narrow(weights[rows], kernel, evidence, here)
            image[:, here] = block
        return image

    def _graph_mean(self, mixed: Tensor, maps: Tensor, near: list[tuple[Tensor, Tensor]]) -> Tensor:
        """:meth:`mean` for back-propagation, which allows no buffer to be used twice; ``mixed (Q, J + 3)``."""
        weights = mixed[:, :-3]
        image = torch.addmm((weights @ self.v_variance).sqrt() * (weights @ self.pull), mixed, maps)
        for evidence, (rows, kernel) in zip(self.evidence, near, strict=True):
            if len(rows):
                narrow = self._narrow(weights[rows], kernel, evidence, slice(None))
                image = image.index_add(0, rows, narrow)
        return image

    def _near(self, targets: Tensor, evidence: _Evidence) -> tuple[Tensor, Tensor]:
        """Which targets lie near the input lights, and their kernel values ``(Q', K)`` float64 times this hypothesis's
        share."""
        kernel = self.statistics.nugget(targets, evidence.terms.light)  # (Q, K)
        rows = (kernel.amax(1) > NEAR).nonzero()[:, 0]
        return rows, kernel[rows].double() * (evidence.gain.value * (1 - self.prior_share) / len(self.evidence))

    def _narrow(self, weights: Tensor, kernel: Tensor, evidence: _Evidence, pixels: slice) -> Tensor:
        """``sigma(s) tau(s) sum_k k(s, s_k) tau(s_k) sigma_v(s_k) g_k`` (4.3), and the like for the loadings' lost
        variance."""
        terms = evidence.terms
        narrow, lost = narrow_terms(self.pixel, weights, self.face, pixels)  # (Q', P') each
        term = narrow * (kernel @ (terms.narrow * evidence.solved)[:, pixels])
        if self.face is not None:
            term += lost * (kernel @ (terms.lost * evidence.solved)[:, pixels])
        return term.to(self.n_map)

    def variance(self, targets: Tensor) -> Tensor:
        """Variance under ``targets (Q, 3)``, ``(Q, P)``: the mean of the hypotheses' variances plus the variance of
        their means."""
        return torch.stack([self._variance(target).to(target) for target in targets])

    def _variance(self, target: Tensor) -> Tensor:
        """Under one ``target (3,)``, ``(P,)``; behind the face not below that at the edges, hypotheses together."""
        mean, variance, weight = self.components(target)
        if len(weight) == 1:
            return variance[0]
        variance = weight @ variance + weight @ (mean - weight @ mean).square()
        if target[2] < 0:
            new = 1 - weight @ self._meeting(target)
            for edge, share in edges(target):
                variance = torch.maximum(variance, share * new * self._variance(edge))
        return variance

    def mode(self, targets: Tensor) -> Tensor:
        """The most probable grey level under ``targets (Q, 3)`` (Algorithm 1, evaluated exactly), ``(Q, P)``; one
        hypothesis: the mean."""
        if len(self.evidence) + (self.prior_share > 0) == 1:
            return self.mean(targets)
        return torch.stack([mixture_mode(*self.components(target)).to(target) for target in targets])

    def components(self, target: Tensor) -> Components:
        """The mixture of Gaussians that a pixel under ``target (3,)`` follows: one component a light hypothesis (3.6).

        Its variances count noise and what is not known of the gain, and are never above the prior's. Behind the face,
        where nothing was learned, they are never below those at the edge.
        """
        found = self._components(target)
        if target[2] >= 0:
            return found
        new = 1 - self._meeting(target)  # (M,)
        variance = found.variance
        for edge, share in edges(target):
            variance = torch.maximum(variance, share * new[:, None] * self._components(edge).variance)
        return found._replace(variance=variance)

    def _components(self, target: Tensor) -> Components:
        target = target[None]
        terms = light_terms(self.statistics, self.pixel, target, self.face)
        local = image_covariance(self.statistics, self.pixel, terms, terms)[:, 0, 0]  # (P,)
        average = terms.mean[0].double()  # (P,)
        outputs = None if self.face is None else loadings_at(self.face, terms).double()[0].T  # (P, k)
        prior = local if outputs is None else local + outputs.square().sum(-1)
        prior = prior + float(self.statistics.gain_spread) ** 2 * average.square() + self.noise_variance
        means, variances = [], []
        for index, evidence in enumerate(self.evidence):
            cross = image_covariance(self.statistics, self.pixel, evidence.terms, terms)  # (P, K, 1)
            whitened = gaussian.solve_lower(evidence.cholesky, cross)  # (P, K, 1)
            variance = gaussian.positive_variance(local - whitened.square().sum((1, 2)), local)  # (P,)
            mean = average + (cross[..., 0] * evidence.solved.T).sum(-1)  # (P,)
            black = average + (cross[..., 0] * evidence.solved_black.T).sum(-1)  # (P,)
            if outputs is not None and evidence.inputs is not None and evidence.code_black is not None:
                code, spread = self.codes[index]
                left = outputs - (whitened * evidence.inputs).sum(1)  # D, (P, k)
                variance = variance + (left @ spread).square().sum(-1)
                mean = mean + (outputs @ code)[:, 0]
                black = black + outputs @ evidence.code_black
            # The mean under gain g is g black + (what is linear in the inputs): that is its slope, zero at an input.
            gain = evidence.gain
            variance = gain.value**2 * (variance + gain.spread**2 * black.square()) + self.noise_variance
            means.append(gain.value * mean)
            variances.append(torch.minimum(variance, prior))
        weight = [(1 - self.prior_share) / len(means)] * len(means) if means else []
        if self.prior_share > 0:
            means.append(average)
            variances.append(prior)
            weight.append(self.prior_share)
        return Components(
            torch.stack(means), torch.stack(variances), torch.tensor(weight, dtype=prior.dtype).to(prior.device)
        )

    def _meeting(self, target: Tensor) -> Tensor:
        """How nearly ``target (3,)`` is an input light, component by component, 0 to 1, ``(M,)``."""
        meeting = target.new_zeros(len(self.evidence) + (self.prior_share > 0), dtype=torch.float64)
        for index, evidence in enumerate(self.evidence):
            meeting[index] = self.statistics.nugget(target[None], evidence.terms.light).amax()
        return meeting


def edges(target: Tensor) -> list[tuple[Tensor, float]]:
    """Lights of the image plane about a ``target (3,)`` behind it, and how much each counts: the nearest fully, the
    others the more, the nearer the target is to the axis, where all are alike."""
    away = torch.nn.functional.pad(target[:2], (0, 1))
    if float(away.norm()) < 1e-6:
        away = target.new_tensor((1.0, 0.0, 0.0))
    away = away / away.norm()
    side = torch.stack((-away[1], away[0], away[2]))
    depth = float(-target[2])
    return [(away, 1.0), (-away, depth), (side, depth), (-side, depth)]
