"""What is known of one person's face after their images are seen: condition once, render any light by linear algebra.

K input images, k whole-face loadings, J bootstrap lights, P pixels, Q target lights, M hypotheses about the input
lights, r columns of the correlation factor.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sums import LightSum, edges, is_behind
from facerelight.model.brightness import Gain, read_gain, reading_errors, reading_weight
from facerelight.model.covariance import image_covariance, observed, same_light
from facerelight.model.light_terms import (
    DirectionTerms,
    LightTerms,
    direction_terms,
    gain_noise,
    left_alone,
    light_terms,
    loadings_at,
    narrow_terms,
    pull_of,
    summed_terms,
)
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian
from facerelight.numerics.mixture import mixture_mode

__all__ = ["Components", "PersonPosterior"]

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


class _Near(NamedTuple):
    """What input ``directions (N, 3)`` do to lights near them: ``narrow`` and ``lost`` times what was solved, times the
    share of their hypothesis, ``(N, P)`` float64."""

    directions: Tensor
    narrow: Tensor
    lost: Tensor


class PersonPosterior:
    """The posterior of one person; averaged over ``M`` hypotheses about the input lights.

    Args:
        statistics: what the bootstrap taught.
        images: ``(K, H, W)``.
        hypotheses: input lights, ``(M, K, 3)`` or sums with amounts ``(M, K, n)``; a light of zero takes its image out
            of the evidence.
        covariance: "pixel" or "face".
        mask: ``(H, W)``, 0 where the images do not show the face (hair, a hat) and so say nothing about the whole-face
            code.
        noise: standard deviation of the inputs' noise in radiance, ``(K, 1)`` or ``(K, P)``. None: none, and inputs are
            returned exactly.
        new_noise: that of the images that are rendered, which their variance counts.
        shared: terms of the directions that all hypotheses share, where they are known already.
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        images: Tensor,
        hypotheses: Tensor | LightSum,
        covariance: str,
        mask: Tensor | None = None,
        noise: Tensor | None = None,
        new_noise: float = 0.0,
        shared: DirectionTerms | None = None,
    ) -> None:
        self.statistics = statistics
        self.face = statistics.face if covariance == "face" else None
        pixel = statistics.pixel if self.face is None else self.face.residual
        assert pixel is not None
        self.pixel = pixel
        self.visible = None if mask is None else mask.flatten().double()
        pixels = images.flatten(1)
        sigma = images.new_zeros(len(images), 1, dtype=torch.float64) if noise is None else noise.double()
        self.noise_variance = new_noise**2  # of a new image
        self.n_map = torch.zeros_like(statistics.n_mean.flatten(1))
        self.v_map = torch.zeros_like(statistics.v_mean.flatten(1))
        self.pull = torch.zeros_like(self.v_map)
        self.v_variance = pixel.v_std.flatten(1).square()
        self.near: list[_Near] = []
        self.codes: list[tuple[Tensor, Tensor]] = []
        self.evidence: list[_Evidence] = []
        self._left: Tensor | None = None
        lights = LightSum.single(hypotheses) if isinstance(hypotheses, Tensor) else hypotheses
        seen = lights.amounts.sum(-1) > 0  # (M, K)
        if lights.shared and len(seen) > 1 and shared is None:
            shared = direction_terms(statistics, pixel, lights.directions, self.face)
        for index, kept in enumerate(seen):
            if kept.any():
                self._add(pixels[kept], self._terms(lights[index][kept], shared), sigma[kept], 1 / len(seen))
        self.prior_share = 1 - len(self.evidence) / len(seen)
        self.n_map += self.prior_share * statistics.n_mean.flatten(1)
        self.v_map += self.prior_share * statistics.v_mean.flatten(1)

    def _terms(self, lights: LightSum, shared: DirectionTerms | None) -> LightTerms:
        """Of the input ``lights``, amounts ``(K, n)``; ``shared``: of directions that all hypotheses have."""
        if shared is not None:
            return summed_terms(shared, lights.amounts)
        lights = LightSum(unit_lights(lights.directions), lights.amounts)
        return light_terms(self.statistics, self.pixel, lights, self.face)

    def _add(self, images: Tensor, terms: LightTerms, noise: Tensor, of_all: float) -> None:
        statistics, pixel = self.statistics, self.pixel
        covariance = image_covariance(statistics, pixel, terms, terms)  # (P, K, K)
        loadings = None if self.face is None else loadings_at(self.face, terms)  # (K, k, P)
        counted = reading_weight(terms.mean, noise, self.visible)  # (K, P)
        errors = reading_errors(
            gain_noise(statistics, terms), normalize(terms.light, dim=1), terms.mean, counted, loadings
        )  # (K, K)
        known = read_gain(images, terms.mean, float(statistics.gain_spread), errors, counted, noise)
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
        facing = (terms.light.double().T @ solved).to(images)  # S g, (3, P)
        self.n_map += share * torch.einsum("dcp,ecp,ep->dp", root, root, facing)
        learned = pixel.v_factor.flatten(2)  # (J, r, P)
        unique = self._unique()
        shared = (terms.factor * solved[:, None]).sum(0).to(images)  # (r, P)
        own = pull_of(terms, solved).to(images)  # (J, P)
        pull = unique * own
        for row in range(len(shared)):  # one after the other: no product of their size is held
            pull.addcmul_(learned[:, row], shared[row])
        self.pull += share * pull
        narrow, lost = ((share * part * solved[:, None]).flatten(0, 1) for part in (terms.narrow, terms.lost))
        directions = terms.directions.flatten(0, 1)  # (K n, 3)
        if self.near and self.near[-1].directions.shape == directions.shape:
            before = self.near[-1]
            if torch.equal(before.directions, directions):
                self.near.pop()
                narrow, lost = before.narrow + narrow, before.lost + lost
        self.near.append(_Near(directions, narrow, lost))

    def _unique(self) -> Tensor:
        """What of the deviation at each bootstrap light the correlation factor leaves to that light alone, ``(J, P)``;
        worked out once."""
        if self._left is None:
            self._left = left_alone(self.pixel.v_factor.flatten(2), 1)
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

    def mean(self, targets: Tensor | LightSum) -> Tensor:
        """Conditional mean under ``targets``, directions ``(Q, 3)`` or sums with amounts ``(Q, n)``, ``(Q, P)``: light
        adds up, and so does the mean."""
        if isinstance(targets, Tensor):
            return self._mean(targets)
        if targets.shared:
            return targets.amounts @ self._mean(targets.directions)
        rows = zip(targets.directions, targets.amounts, strict=True)
        return torch.stack([amounts @ self._mean(directions) for directions, amounts in rows])

    def _mean(self, targets: Tensor) -> Tensor:
        """Under directions ``(Q, 3)``: four matrix products, and a narrow term near the input lights.

        By blocks of pixels: what a block needs stays in the cache, which makes this as fast as the bare products.
        """
        weights = self.statistics.weights(targets)  # (Q, J)
        mixed, maps = torch.cat((weights, targets), 1), torch.cat((self.v_map, self.n_map))  # (Q, J + 3), (J + 3, P)
        near = [self._reach(targets, near) for near in self.near]
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
            for (rows, kernel), part in zip(near, self.near, strict=True):
                if len(rows):
                    block[rows] += self._narrow(weights[rows], kernel, part, here)
            image[:, here] = block
        return image

    def _graph_mean(self, mixed: Tensor, maps: Tensor, near: list[tuple[Tensor, Tensor]]) -> Tensor:
        """:meth:`mean` for back-propagation, which allows no buffer to be used twice; ``mixed (Q, J + 3)``."""
        weights = mixed[:, :-3]
        image = torch.addmm((weights @ self.v_variance).sqrt() * (weights @ self.pull), mixed, maps)
        for (rows, kernel), part in zip(near, self.near, strict=True):
            if len(rows):
                narrow = self._narrow(weights[rows], kernel, part, slice(None))
                image = image.index_add(0, rows, narrow)
        return image

    def _reach(self, targets: Tensor, near: _Near) -> tuple[Tensor, Tensor]:
        """Which targets lie near the input lights, and their kernel values ``(Q', N)`` float64."""
        kernel = self.statistics.nugget(targets, near.directions)  # (Q, N)
        rows = (kernel.amax(1) > NEAR).nonzero()[:, 0]
        return rows, kernel[rows].double()

    def _narrow(self, weights: Tensor, kernel: Tensor, near: _Near, pixels: slice) -> Tensor:
        """``sigma(s) tau(s) sum_k k(s, s_k) tau(s_k) sigma_v(s_k) g_k`` (4.3), and the like for the loadings' lost
        variance."""
        narrow, lost = narrow_terms(self.pixel, weights, self.face, pixels)  # (Q', P') each
        term = narrow * (kernel @ near.narrow[:, pixels])
        if self.face is not None:
            term += lost * (kernel @ near.lost[:, pixels])
        return term.to(self.n_map)

    def variance(self, targets: Tensor | LightSum) -> Tensor:
        """Variance under ``targets``, as for :meth:`mean`, ``(Q, P)``: the mean of the hypotheses' variances plus the
        variance of their means."""
        return torch.stack([self._variance(target).to(target.amounts) for target in _one_by_one(targets)])

    def _variance(self, target: LightSum) -> Tensor:
        """Under one light, amounts ``(n,)``, ``(P,)``; behind the face not below that at the edges, hypotheses
        together."""
        mean, variance, weight = self.components(target)
        if len(weight) == 1:
            return variance[0]
        variance = weight @ variance + weight @ (mean - weight @ mean).square()
        light = target.insert(0)
        if is_behind(light):
            new = 1 - weight @ self._meeting(light_terms(self.statistics, self.pixel, light, self.face))
            for edge in edges(light):
                variance = torch.maximum(variance, new * self._variance(edge[0]))
        return variance

    def mode(self, targets: Tensor | LightSum) -> Tensor:
        """The most probable grey level under ``targets``, as for :meth:`mean` (Algorithm 1, evaluated exactly),
        ``(Q, P)``; one hypothesis: the mean."""
        if len(self.evidence) + (self.prior_share > 0) == 1:
            return self.mean(targets)
        return torch.stack([mixture_mode(*self.components(t)).to(t.amounts) for t in _one_by_one(targets)])

    def components(self, target: Tensor | LightSum) -> Components:
        """The mixture of Gaussians that a pixel under ``target``, ``(3,)`` or amounts ``(n,)``, follows: one component
        a light hypothesis (3.6).

        Its variances count noise and what is not known of the gain. Behind the face, where nothing was learned, they
        are raised to those at the edge.
        """
        light = (LightSum.single(target) if isinstance(target, Tensor) else target).insert(0)
        terms = light_terms(self.statistics, self.pixel, light, self.face)
        found = self._components(terms)
        if not is_behind(light):
            return found
        new = 1 - self._meeting(terms)  # (M,)
        variance = found.variance
        for edge in edges(light):
            at_edge = light_terms(self.statistics, self.pixel, edge, self.face)
            variance = torch.maximum(variance, new[:, None] * self._components(at_edge).variance)
        return found._replace(variance=variance)

    def _components(self, terms: LightTerms) -> Components:
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
            variances.append(variance)
        weight = [(1 - self.prior_share) / len(means)] * len(means) if means else []
        if self.prior_share > 0:
            means.append(average)
            variances.append(prior)
            weight.append(self.prior_share)
        return Components(
            torch.stack(means), torch.stack(variances), torch.tensor(weight, dtype=prior.dtype).to(prior.device)
        )

    def _meeting(self, target: LightTerms) -> Tensor:
        """How nearly the light ``target`` is an input light, component by component, 0 to 1, ``(M,)``."""
        meeting = target.light.new_zeros(len(self.evidence) + (self.prior_share > 0), dtype=torch.float64)
        for index, evidence in enumerate(self.evidence):
            meeting[index] = same_light(self.statistics, target, evidence.terms).amax()
        return meeting


def _one_by_one(targets: Tensor | LightSum) -> list[LightSum]:
    """Each of the targets, amounts ``(n,)``."""
    lights = LightSum.single(targets) if isinstance(targets, Tensor) else targets
    return [lights[index] for index in range(len(lights.amounts))]
