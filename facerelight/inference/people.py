"""Many people at once, each seen in one photograph under one known light: conditioned and rendered together.

The same conditional means as :class:`~facerelight.inference.person.PersonPosterior`, person by person, gives. What
lights need is gathered for all people at once, by matrix products that read the statistics once, and a few targets are
rendered from that alone, without any person's maps over all bootstrap lights.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.inference.person import NEAR, PersonPosterior
from facerelight.inference.posterior import Lights, Posterior, check_targets
from facerelight.model.brightness import read_gain, reading_errors, reading_weight
from facerelight.model.covariance import MEASUREMENT
from facerelight.model.light_terms import LightTerms, gain_noise, left_alone, light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian

__all__ = ["PeoplePosterior"]

PEOPLE_AT_ONCE = 12  # their loadings are 28 MB, little enough for memory to be used again
FEW_TARGETS = 8  # lights of one's own; more are cheaper from a person's maps


class _Explained(NamedTuple):
    """What the codes of N people make of ``n (N, 3, P)`` and of ``v (N, m, P)``, in a basis over the lights."""

    n: Tensor
    v: Tensor

    def under(self, lights: Tensor, functions: Tensor) -> Tensor:
        """Under ``lights (N or 1, Q, 3)``, of which the basis makes ``functions (N or 1, Q, m)``: ``(N, Q, P)``."""
        return lights @ self.n + functions @ self.v


class _Seen(NamedTuple):
    """Of N people: the lights' ``terms``; ``root (N, 3, P)``, C_n's factor along the light; ``solved (N, P)``, what is
    left over its covariance; the ``code (N, k)`` and what it explains, None without loadings; ``gain (N,)``."""

    terms: LightTerms
    root: Tensor
    solved: Tensor
    code: Tensor | None
    explained: _Explained | None
    gain: Tensor


class _Target(NamedTuple):
    """Of target lights, ``(A, Q, ...)``: the average face ``mean (..., P)``, ``std (..., P)`` of the deviation, kernel
    ``weights (..., J)``, and ``rows``, factors of what pixels share over lights, ``(A, Q, P)`` each."""

    mean: Tensor
    std: Tensor
    weights: Tensor
    rows: list[Tensor]


class PeoplePosterior(Posterior):
    """Posteriors of B people, each of one image under one known direction of light.

    Means under few lights, and codes, are worked out together; all else person by person, as
    :class:`~facerelight.inference.posterior.Posterior` does, whose ``people`` are made when they are first asked for.

    Args:
        statistics: what the bootstrap taught.
        covariance: "pixel" or "face".
        images: ``(B, H, W)`` in the statistics' dtype.
        lights: ``(B, 3)`` unit vectors.
        noise: standard deviation of the images' noise, radiance, ``(B, 1)`` or ``(B, P)`` float64.
        mask: ``(B, H, W)``, see :meth:`facerelight.inference.relighter.StatisticalRelighter.condition`; or None.
        one_by_one: makes the posteriors of single people.
        dtype: of the images that are rendered.
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        covariance: str,
        images: Tensor,
        lights: Tensor,
        noise: Tensor,
        mask: Tensor | None,
        one_by_one: Callable[[], list[PersonPosterior]],
        dtype: torch.dtype | None = None,
    ) -> None:
        self.statistics = statistics
        self.face = statistics.face if covariance == "face" else None
        pixel = statistics.pixel if self.face is None else self.face.residual
        assert pixel is not None
        self.pixel = pixel
        self._unique = left_alone(pixel.v_factor.flatten(2), 1)  # (J, P)
        self._variance = pixel.v_std.flatten(1).square()
        self._one_by_one = one_by_one
        self._people: list[PersonPosterior] | None = None
        self.size, self.dtype, self.deformations = statistics.size, dtype, None
        visible = None if mask is None else mask.flatten(1).double()
        seen = images.flatten(1)
        self._parts = [
            self._see(seen[part], lights[part], noise[part], None if visible is None else visible[part])
            for part in torch.arange(len(images)).split(PEOPLE_AT_ONCE)
        ]

    @property
    def people(self) -> list[PersonPosterior]:  # type: ignore[override]
        """The posteriors of single people."""
        if self._people is None:
            self._people = self._one_by_one()
        return self._people

    def separately(self) -> Posterior:
        """The same, all of it person by person."""
        return Posterior(self._one_by_one(), self.size, None, self.dtype)

    def code(self) -> Tensor:
        """See :meth:`Posterior.code`."""
        codes = [part.code for part in self._parts]
        if any(code is None for code in codes):
            return super().code()
        return torch.cat([code for code in codes if code is not None])

    def mean(self, target_lights: Lights) -> Tensor:
        """See :meth:`Posterior.mean`."""
        shared = isinstance(target_lights, Tensor) and target_lights.dim() == 2
        if self._people is not None or not isinstance(target_lights, Tensor):
            return super().mean(target_lights)
        if not shared and target_lights.dim() == 3 and target_lights.shape[1] > FEW_TARGETS:
            return super().mean(target_lights)
        count = sum(len(part.gain) for part in self._parts)
        targets = check_targets(target_lights, count).to(self.statistics.n_mean).directions[:, :, 0]  # (B, Q, 3)
        if not targets.shape[1]:
            return super().mean(target_lights)
        if shared:
            target = self._target(targets[:1])
            images = [self._means(part, target, targets[:1]) for part in self._parts]
        else:
            rows = targets.split([len(part.gain) for part in self._parts])
            images = [self._means(part, self._target(row), row) for part, row in zip(self._parts, rows, strict=True)]
        made = torch.cat(images).clamp_min(0).unflatten(-1, self.size)
        return made.to(self.dtype or made.dtype)

    def _see(self, images: Tensor, lights: Tensor, noise: Tensor, visible: Tensor | None) -> _Seen:
        """What ``images (N, P)`` say of their people."""
        terms, loadings = self._source_terms(lights)
        root = torch.einsum("nd,dcp->ncp", lights, self.pixel.n_factor.flatten(2))
        own = self._own_variance(terms, root)  # (N, P)
        gain = self._gains(images, terms, noise, visible, loadings)  # (N,)
        spread = own * (1 + MEASUREMENT) + (noise / gain[:, None]).square()
        root_spread = spread.clamp_min(torch.finfo(spread.dtype).tiny).sqrt()
        left = (images / gain[:, None] - terms.mean).double()  # (N, P)
        if self.face is None or loadings is None:
            return _Seen(terms, root, (left / spread).to(images), None, None, gain.to(images))
        count = loadings.shape[1]
        rows = loadings.new_empty(len(images), count + 1, images.shape[1])  # whitened loadings, and what is left
        scale = root_spread.to(loadings).reciprocal_()
        torch.mul(loadings, scale[:, None], out=rows[:, :count])
        torch.mul(left.to(loadings), scale, out=rows[:, count])
        counted = rows if visible is None else rows * visible.to(rows)[:, None]
        products = (counted @ rows.mT).double() / float(self.face.temper)  # (N, k + 1, k + 1), the inputs' own last
        eye = torch.eye(count, dtype=torch.float64, device=images.device)
        factor = gaussian.safe_cholesky(eye + products[:, :count, :count])
        code = torch.cholesky_solve(products[:, :count, count:], factor)[..., 0].to(images)  # (N, k)
        person = _Explained(*((code @ part.flatten(1)).unflatten(1, part.shape[1:]) for part in self._loadings()))
        solved = (left - person.under(lights[:, None], terms.weights[:, None] @ self.face.basis.T)[:, 0]) / spread
        return _Seen(terms, root, solved.to(images), code, person, gain.to(images))

    def _loadings(self) -> tuple[Tensor, Tensor]:
        """Of n and of v, ``(k, 3, P)`` and ``(k, m, P)``."""
        assert self.face is not None
        return self.face.n.flatten(2), self.face.v.flatten(2)

    def _source_terms(self, lights: Tensor) -> tuple[LightTerms, Tensor | None]:
        """Terms of ``lights (N, 3)``, and the loadings under them, ``(N, k, P)``, which also say what is lost of their
        variance between the bootstrap's lights."""
        terms = light_terms(self.statistics, self.pixel, lights)
        if self.face is None:
            return terms, None
        face = self.face
        of_v = (terms.weights @ face.basis.T) @ face.v.flatten(2)  # (k, N, P)
        power = terms.weights @ face.v_power.flatten(1)  # (N, P)
        for row in of_v:
            power.addcmul_(row, row, value=-1)
        terms = terms._replace(lost=gaussian.positive_root(power)[:, None])
        return terms, of_v.baddbmm_(lights.expand(len(of_v), -1, -1), face.n.flatten(2)).transpose(0, 1)

    def _own_variance(self, terms: LightTerms, root: Tensor) -> Tensor:
        """Variance of an image under each light of ``terms``, ``(N, P)`` float64."""
        assert terms.std is not None
        alone = (terms.weights.square() @ self._unique) * terms.std.square()
        shared = root.square().sum(1) + terms.factor.square().sum(1)
        return (shared + alone + terms.narrow[:, 0].square() + terms.lost[:, 0].square()).double()

    def _gains(
        self, images: Tensor, terms: LightTerms, noise: Tensor, visible: Tensor | None, loadings: Tensor | None
    ) -> Tensor:
        """How bright each person is, ``(N,)`` float64."""
        spread = float(self.statistics.gain_spread)
        if spread == 0:
            return images.new_ones(len(images), dtype=torch.float64)
        noises = gain_noise(self.statistics, terms)
        gains = []
        for index, (image, light) in enumerate(zip(images, terms.light, strict=True)):
            one = slice(index, index + 1)
            expected = terms.mean[one]
            counted = reading_weight(expected, noise[one], None if visible is None else visible[index])
            own = None if loadings is None else loadings[one]
            errors = reading_errors(noises[one], light[None], expected, counted, own)
            gains.append(read_gain(image[None], expected, spread, errors, counted, noise[one]).value)
        return torch.stack(gains)

    def _target(self, lights: Tensor) -> _Target:
        """What target directions ``(A, Q, 3)`` need."""
        statistics, pixel = self.statistics, self.pixel
        weights = statistics.weights(lights).flatten(0, 1)  # (A Q, J)
        towards = lights.flatten(0, 1)
        mean = towards @ statistics.n_mean.flatten(1) + weights @ statistics.v_mean.flatten(1)
        std = (weights @ self._variance).sqrt()
        learned = pixel.v_factor.flatten(2).transpose(0, 1)  # (r, J, P)
        root = torch.einsum("nd,dcp->cnp", towards, pixel.n_factor.flatten(2))
        shape = lights.shape[:2]
        rows = [row.unflatten(0, shape) for row in (*((weights @ each).mul_(std) for each in learned), *root)]
        return _Target(mean.unflatten(0, shape), std.unflatten(0, shape), weights.unflatten(0, shape), rows)

    def _means(self, seen: _Seen, target: _Target, lights: Tensor) -> Tensor:
        """Conditional means ``(N, Q, P)`` under ``lights (N or 1, Q, 3)``, which need what ``target`` holds."""
        people, count = len(seen.gain), lights.shape[1]
        made = target.mean.expand(people, -1, -1).clone()
        if seen.explained is not None and self.face is not None:
            made += seen.explained.under(lights, target.weights @ self.face.basis.T)
        together = (target.weights * seen.terms.weights[:, None]).flatten(0, 1)  # (N Q, J)
        assert seen.terms.std is not None
        covariance = (together @ self._unique).unflatten(0, (people, count))
        covariance.mul_(seen.terms.std[:, None]).mul_(target.std)
        own = (*seen.terms.factor.unbind(1), *seen.root.unbind(1))  # (N, P) each
        for row, other in zip(own, target.rows, strict=True):  # one after the other: no product of all is held
            covariance.addcmul_(row[:, None], other)
        covariance += self._narrow(seen, lights)
        return made.addcmul_(covariance, seen.solved[:, None]) * seen.gain[:, None, None]

    def _narrow(self, seen: _Seen, targets: Tensor) -> Tensor | float:
        """What only nearby lights share, ``(N, Q, P)``; 0 where none are near."""
        sources = seen.terms.directions[:, 0]  # (N, 3)
        squared = (targets.double() - sources.double()[:, None]).square().sum(-1)  # (N, Q)
        kernel = torch.exp(-0.5 * squared / self.statistics.nugget_width.double() ** 2)
        near = kernel > NEAR
        if not near.any():
            return 0.0
        who, which = near.nonzero().unbind(1)
        terms = light_terms(self.statistics, self.pixel, targets.expand(len(sources), -1, -1)[who, which], self.face)
        together = terms.narrow[:, 0] * seen.terms.narrow[who, 0] + terms.lost[:, 0] * seen.terms.lost[who, 0]
        found = together.new_zeros(*near.shape, together.shape[1])
        found[who, which] = together * kernel[near].to(together)[:, None]
        return found
