"""What is known of one face after its images are seen: condition once, render any light at the cost of linear algebra."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight import gaussian
from facerelight.covariance import LightTerms, image_covariance, light_terms, loadings_at, prior_mean
from facerelight.lights import unit_lights
from facerelight.statistics import FaceStatistics

__all__ = ["Posterior", "Relit"]

NEAR = 1e-7  # kernel values below this cannot change a float32 image


class Relit(NamedTuple):
    """Relit images: ``mean`` and ``variance`` of every pixel, ``(B, Q, H, W)`` each, radiance and radiance squared."""

    mean: Tensor
    variance: Tensor


class _Evidence(NamedTuple):
    """One light hypothesis: input lights' terms, ``g = R_yy^-1 (y - mu_y)`` ``(K, P)`` and the factor of ``R_yy`` ``(P, K, K)``."""

    terms: LightTerms
    solved: Tensor
    cholesky: Tensor
    inputs: Tensor | None  # whitened loadings L^-1 L_y, (P, K, k)
    gain: float  # the person's brightness


class PersonPosterior:
    """The posterior of one person; averaged over ``M`` hypotheses about the input lights.

    Args:
        statistics: what the bootstrap taught.
        images: ``(K, H, W)``.
        hypotheses: ``(M, K, 3)`` input lights; a zero light takes its image out of the evidence.
        covariance: "pixel" or "face".
        mask: ``(H, W)``, 0 where the images do not show the face (hair, a hat) and so say nothing about the whole-face code.
    """

    def __init__(self, statistics: FaceStatistics, images: Tensor, hypotheses: Tensor, covariance: str, mask: Tensor | None = None) -> None:
        self.statistics = statistics
        self.face = statistics.face if covariance == "face" else None
        pixel = statistics.pixel if self.face is None else self.face.residual
        assert pixel is not None
        self.pixel = pixel
        self.visible = None if mask is None else mask.flatten().double()
        observed = images.flatten(1)
        self.n_map = torch.zeros_like(statistics.n_mean.flatten(1))
        self.v_map = torch.zeros_like(statistics.v_mean.flatten(1))
        self.pull = torch.zeros_like(self.v_map)
        self.codes: list[tuple[Tensor, Tensor]] = []
        self.evidence: list[_Evidence] = []
        seen = hypotheses.square().sum(-1) > 0
        for lights, kept in zip(hypotheses, seen, strict=True):
            if kept.any():
                self._add(observed[kept], unit_lights(lights[kept]), 1 / len(hypotheses))
        self.prior_share = 1 - len(self.evidence) / len(hypotheses)
        self.n_map += self.prior_share * statistics.n_mean.flatten(1)
        self.v_map += self.prior_share * statistics.v_mean.flatten(1)

    def _add(self, observed: Tensor, lights: Tensor, share: float) -> None:
        statistics, pixel = self.statistics, self.pixel
        terms = light_terms(statistics, pixel, lights, self.face)
        covariance = image_covariance(statistics, pixel, terms, terms)
        cholesky = gaussian.safe_cholesky(covariance)  # (P, K, K)
        expected = prior_mean(statistics, lights)
        gain = self._gain(observed, expected, terms.weights)
        residual = (observed / gain - expected).double().T[..., None]  # (P, K, 1)
        whitened = gaussian.solve_lower(cholesky, residual)
        inputs = None
        if self.face is not None:
            loadings = loadings_at(statistics, self.face, lights)  # (K, k, P)
            inputs = gaussian.solve_lower(cholesky, loadings.permute(2, 0, 1).double())  # (P, K, k)
            code, spread = _face_code(inputs, whitened, float(self.face.temper), self.visible)
            self.codes.append((code, spread))
            whitened = whitened - inputs @ code
            self._explain(code[:, 0].to(observed), share * gain)
        solved = gaussian.solve_upper(cholesky, whitened)[..., 0].T  # g, (K, P)
        self.evidence.append(_Evidence(terms, solved, cholesky, inputs, gain))
        share *= gain
        self.n_map += share * statistics.n_mean.flatten(1)
        self.v_map += share * statistics.v_mean.flatten(1)
        # n_MAP and the pull of the bootstrap lights, averaged over the hypotheses
        root = pixel.n_factor.flatten(2)
        facing = (lights.double().T @ solved).to(observed)  # S g, (3, P)
        self.n_map += share * torch.einsum("dcp,ecp,ep->dp", root, root, facing)
        learned = pixel.v_factor.flatten(2)
        unique = 1 - learned.square().sum(1)
        shared = (terms.factor * solved[:, None]).sum(0).to(observed)  # (r, P)
        own = (terms.weights.double().T @ (terms.std * solved)).to(observed)  # (J, P)
        self.pull += share * ((learned * shared).sum(1) + unique * own)

    def _gain(self, observed: Tensor, expected: Tensor, weights: Tensor) -> float:
        """How bright the person is next to the average face: the least-squares gain of each input, shrunk towards 1 as its noise demands."""
        spread = float(self.statistics.gain_spread)
        if spread == 0:
            return 1.0
        weight = torch.ones_like(expected[0]) if self.visible is None else self.visible.to(expected)
        read = ((observed * expected) @ weight / (expected.square() @ weight).clamp_min(1e-12)).clamp_min(1e-3).log()
        trust = 1 / (weights @ self.statistics.gain_noise).square()
        return float(torch.exp((read * trust).sum() / (1 / spread**2 + trust.sum())))

    def _explain(self, code: Tensor, share: float) -> None:
        """Move the mean maps by what the whole-face code says."""
        face = self.face
        assert face is not None
        self.n_map += share * torch.tensordot(code, face.n.flatten(2), 1)
        self.v_map += share * (face.basis.T @ torch.tensordot(code, face.v.flatten(2), 1))

    def mean(self, targets: Tensor) -> Tensor:
        """Conditional mean under ``targets (Q, 3)``, ``(Q, P)``: four matrix products, and a narrow term near the input lights."""
        weights = self.statistics.weights(targets)
        std = (weights @ self.pixel.v_std.flatten(1).square()).sqrt()
        image = targets @ self.n_map + weights @ self.v_map + std * (weights @ self.pull)
        for evidence in self.evidence:
            kernel = self.statistics.nugget(targets, evidence.terms.light)  # (Q, K)
            near = kernel.amax(1) > NEAR
            if near.any():
                terms = light_terms(self.statistics, self.pixel, targets[near], self.face)
                narrow = terms.narrow * (kernel[near].double() @ (evidence.terms.narrow * evidence.solved))
                lost = terms.lost * (kernel[near].double() @ (evidence.terms.lost * evidence.solved))
                image[near] += evidence.gain * (1 - self.prior_share) / len(self.evidence) * (narrow + lost).to(image)
        return image

    def variance(self, targets: Tensor) -> Tensor:
        """Variance under ``targets (Q, 3)``, ``(Q, P)``: the mean of the hypotheses' variances plus the variance of their means."""
        return torch.cat([self._variance(target[None]) for target in targets])

    def _variance(self, target: Tensor) -> Tensor:
        terms = light_terms(self.statistics, self.pixel, target, self.face)
        prior = image_covariance(self.statistics, self.pixel, terms, terms)[:, 0]  # (P, 1)
        outputs = None
        if self.face is not None:
            outputs = loadings_at(self.statistics, self.face, target).double()[0].T  # (P, k)
        if not self.evidence:
            prior_face = 0 if outputs is None else outputs.square().sum(-1, keepdim=True)
            return (prior + prior_face).T.to(target)
        average = prior_mean(self.statistics, target)[0].double()
        within = torch.zeros_like(prior[:, 0])
        first, second = torch.zeros_like(within), torch.zeros_like(within)
        for index, evidence in enumerate(self.evidence):
            cross = image_covariance(self.statistics, self.pixel, evidence.terms, terms)  # (P, K, 1)
            whitened = gaussian.solve_lower(evidence.cholesky, cross)
            variance = prior[:, 0] - whitened.square().sum((1, 2))
            shift = average + (cross[..., 0] * evidence.solved.T).sum(-1)
            if outputs is not None and evidence.inputs is not None:
                code, spread = self.codes[index]
                left = outputs - (whitened * evidence.inputs).sum(1)  # D, (P, k)
                variance = variance + (left @ spread).square().sum(-1)
                shift = shift + (outputs @ code)[:, 0]
            shift = evidence.gain * shift
            within += evidence.gain**2 * gaussian.positive_variance(variance)
            first += shift
            second += shift.square()
        count = len(self.evidence)
        between = gaussian.positive_variance(second / count - (first / count).square())
        total = within / count + (between if count > 1 else 0)
        return total[None].to(target)


def _face_code(inputs: Tensor, whitened: Tensor, temper: float, visible: Tensor | None) -> tuple[Tensor, Tensor]:
    """Posterior mean ``(k, 1)`` of the whole-face code and a factor ``(k, k)`` of its covariance, the likelihood tempered."""
    if visible is not None:
        inputs, whitened = inputs * visible[:, None, None].sqrt(), whitened * visible[:, None, None].sqrt()
    design = inputs.flatten(0, 1)  # (P K, k)
    precision = torch.eye(design.shape[1], dtype=design.dtype, device=design.device) + design.T @ design / temper
    factor = gaussian.safe_cholesky(precision)
    code = torch.cholesky_solve(design.T @ whitened.flatten(0, 1) / temper, factor)
    root = torch.linalg.solve_triangular(factor, torch.eye(len(factor), dtype=factor.dtype, device=factor.device), upper=False).T
    return code, root


class Posterior:
    """Posteriors of a batch of B persons, ready to be rendered under as many lights as wanted."""

    def __init__(self, people: list[PersonPosterior], size: tuple[int, int]) -> None:
        self.people = people
        self.size = size

    def mean(self, target_lights: Tensor) -> Tensor:
        """Relit images, the conditional mean (3.17), ``(B, Q, H, W)``; ``target_lights`` is ``(Q, 3)`` or ``(B, Q, 3)``."""
        return self._render("mean", target_lights)

    def variance(self, target_lights: Tensor) -> Tensor:
        """The variance of every relit pixel (3.17), ``(B, Q, H, W)``."""
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
        return torch.stack([torch.stack([c[:, 0] for c, _ in p.codes]).mean(0).to(zero) if p.codes else zero for p in self.people])

    def _render(self, what: str, target_lights: Tensor) -> Tensor:
        reference = self.people[0].n_map
        targets = unit_lights(target_lights.to(reference))
        if targets.dim() == 2:
            targets = targets.expand(len(self.people), -1, -1)
        if targets.dim() != 3 or len(targets) != len(self.people):
            raise ValueError(f"target lights: expected (Q, 3) or ({len(self.people)}, Q, 3), got {tuple(target_lights.shape)}")
        images = [getattr(person, what)(lights) for person, lights in zip(self.people, targets, strict=True)]
        return torch.stack(images).unflatten(-1, self.size)
