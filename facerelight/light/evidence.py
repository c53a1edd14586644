"""The likelihood of a photograph under any sum of lights, its slope and its information, at every few pixels.

Under amounts ``a`` of n directions a pixel is ``a^T mu + (a^T Lambda)^T c + e``, ``e ~ N(0, a^T C a + noise^2)`` (3.16,
summed), with ``c`` shared by the whole face and integrated out.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.model.light_terms import direction_terms, loadings_at, summed_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian
from facerelight.numerics.buffers import LearnedModule
from facerelight.numerics.sampling import spread_pixels

__all__ = ["ImageEvidence", "MixtureModel"]

CODE_TEMPER = 100 / 8064  # of the whole-face code, an observed pixel: 100 at 96 x 84
NOISE = 8 / 255  # radiance: what of a face the model does not explain
STEPS = 100  # multiplicative updates of a start


class ImageEvidence(NamedTuple):
    """Pixels ``seen (B, P)`` that count ``weight (B, P)``, float64."""

    seen: Tensor
    weight: Tensor

    def split(self, count: int) -> list[ImageEvidence]:
        """Parts of ``count`` photographs; none where there are none."""
        if not len(self.seen):
            return []
        return [ImageEvidence(*part) for part in zip(self.seen.split(count), self.weight.split(count), strict=True)]


class _Fit(NamedTuple):
    """What the model makes of photographs under given amounts: ``residual (B, P)`` after the code, ``variance (B, P)``,
    ``loadings (B, k, P)``, the ``code (B, k)``, a ``factor (B, k, k)`` of its precision, and the ``log_likelihood
    (B,)``."""

    residual: Tensor
    variance: Tensor
    loadings: Tensor
    code: Tensor
    factor: Tensor
    log_likelihood: Tensor


class MixtureModel(LearnedModule):
    """The terms of every bootstrap light at about ``pixels`` pixels.

    Buffers, of n directions: ``directions (n, 3)``; ``places (P,)``; ``mean (n, P)``; ``root (n, r, P)``, so that
    ``sum_r root root`` is what the directions share; ``kernel (n, J)``, ``std (n, P)``, ``unique (J, P)``, what single
    bootstrap lights have to themselves; ``narrow (2, n, P)`` by ``near (n, n)``, what only nearby lights share;
    ``loadings (n, k, P)``.
    """

    directions: Tensor
    places: Tensor
    mean: Tensor
    root: Tensor
    kernel: Tensor
    std: Tensor
    unique: Tensor
    narrow: Tensor
    near: Tensor
    loadings: Tensor

    def __init__(self, statistics: FaceStatistics, pixels: int) -> None:
        super().__init__()
        self.size: tuple[int, int] = statistics.size
        places = spread_pixels(self.size, pixels).to(statistics.lights.device)
        pixel = statistics.pixel if statistics.face is None else statistics.face.residual
        assert pixel is not None
        directions = statistics.lights
        terms = direction_terms(statistics, pixel, directions, statistics.face)
        normal = torch.einsum("nd,dcp->ncp", directions, pixel.n_factor.flatten(2)[..., places])
        loadings = terms.mean.new_zeros(len(directions), 0, len(places))
        if statistics.face is not None:
            each = torch.eye(len(directions)).to(directions)
            loadings = loadings_at(statistics.face, summed_terms(terms, each))[..., places]
        for name, tensor in (
            ("directions", directions.clone()),
            ("places", places),
            ("mean", terms.mean[:, places]),
            ("root", torch.cat((normal, terms.factor[..., places]), 1)),
            ("kernel", terms.weights),
            ("std", terms.std[:, places]),
            ("unique", 1 - pixel.v_factor.flatten(2)[..., places].square().sum(1)),
            ("narrow", torch.stack((terms.narrow[:, places], terms.lost[:, places]))),
            ("near", statistics.nugget(directions, directions)),
            ("loadings", loadings),
        ):
            self.register_buffer(name, tensor)

    def get_extra_state(self) -> dict[str, tuple[int, int]]:
        """The size of the images that its places are in."""
        return {"size": self.size}

    def set_extra_state(self, state: dict[str, tuple[int, int]]) -> None:
        """See :meth:`get_extra_state`."""
        self.size = state["size"]

    def look(self, images: Tensor, mask: Tensor) -> ImageEvidence:
        """The pixels looked at of ``images`` and ``mask``, ``(B, H, W)``."""
        seen, weight = (part.flatten(1)[:, self.places].double() for part in (images.detach(), mask))
        return ImageEvidence(seen.to(self.directions.device), weight.to(self.directions.device))

    def level(self, image: ImageEvidence) -> Tensor:
        """How bright the photographs are beside the average face under the mean of all lights, ``(B,)``."""
        average = (image.weight * self.mean.double().clamp_min(0).mean(0)).sum(1)
        return ((image.weight * image.seen).sum(1) / average.clamp_min(1e-12)).clamp_min(1e-6)

    def start(self, image: ImageEvidence) -> Tensor:
        """Amounts ``(B, n)`` by non-negative least squares on the average face (Lee and Seung 2000)."""
        mean = self.mean.double().clamp_min(0)
        weighted = mean * image.weight[:, None]  # (B, n, P)
        gram = weighted @ mean.T
        target = (weighted @ image.seen.clamp_min(0)[..., None])[..., 0]
        amounts = (target.sum(1) / gram.sum((1, 2)).clamp_min(1e-30))[:, None].expand_as(target)
        for _ in range(STEPS):
            amounts = amounts * target / (gram @ amounts[..., None])[..., 0].clamp_min(1e-30)
        return amounts

    def gain(self, image: ImageEvidence, amounts: Tensor) -> Tensor:
        """How much brighter the photographs are than the average face under ``amounts (B, n)``, ``(B,)``, by least
        squares: the likelihood's own level leans to the dark, where the model is surest."""
        expected = amounts @ self.mean.double()  # (B, P)
        power = (image.weight * expected.square()).sum(1)
        return (image.weight * image.seen * expected).sum(1).clamp_min(0) / power.clamp_min(1e-30)

    def log_likelihood(self, image: ImageEvidence, amounts: Tensor) -> Tensor:
        """Of each photograph under its ``amounts (B, n)``, up to a constant, untempered, ``(B,)``."""
        return self._fit(image, amounts).log_likelihood

    def _fit(self, image: ImageEvidence, amounts: Tensor) -> _Fit:
        variance = _sum(amounts, self.root).square().sum(1) + NOISE**2
        own = (amounts[:, None] * self.kernel.double().T) @ self.std.double()  # (B, J, P)
        variance = variance + (own.square() * self.unique.double()).sum(1)
        for narrow in self.narrow.double():
            each = amounts[..., None] * narrow  # (B, n, P)
            variance = variance + (each * (self.near.double() @ each)).sum(1)
        residual = image.seen - amounts @ self.mean.double()
        loadings = _sum(amounts, self.loadings)  # (B, k, P)
        trust = image.weight / variance
        temper = max(1.0, CODE_TEMPER * len(self.places))
        eye = torch.eye(loadings.shape[1]).to(variance)
        factor = gaussian.safe_cholesky(temper * eye + (loadings * trust[:, None]) @ loadings.mT)
        pull = loadings @ (trust * residual)[..., None]  # (B, k, 1)
        code = torch.cholesky_solve(pull, factor)[..., 0]
        misfit = (trust * residual.square()).sum(1) - (pull[..., 0] * code).sum(1)
        spread = (image.weight * variance.log()).sum(1) + 2 * factor.diagonal(dim1=1, dim2=2).log().sum(1)
        residual = residual - (code[:, None] @ loadings)[:, 0]
        return _Fit(residual, variance, loadings, code, factor, -0.5 * (misfit + spread))

    def slope(self, image: ImageEvidence, amounts: Tensor) -> tuple[Tensor, Tensor]:
        """The slope ``(B, n)`` of :meth:`log_likelihood` in the amounts, and Fisher's information of the mean about
        them, ``(B, n, n)``."""
        fit = self._fit(image, amounts)
        trust = image.weight / fit.variance  # (B, P)
        pull = trust * fit.residual  # slope in the mean
        spread = torch.cholesky_solve(fit.loadings, fit.factor)  # (B, k, P)
        power = (fit.loadings * spread).sum(1)
        of_variance = 0.5 * trust * ((fit.residual.square() + power) / fit.variance - 1)  # slope in the variance
        of_loadings = fit.code[..., None] * pull[:, None] - trust[:, None] * spread  # (B, k, P)
        slope = pull @ self.mean.double().T + _project(of_loadings, self.loadings)
        slope = slope + 2 * self._variance_slope(amounts, of_variance)
        rows = self.mean.double() + torch.einsum("bk,nkp->bnp", fit.code, self.loadings.double())  # (B, n, P)
        seen = (rows * trust[:, None]) @ fit.loadings.mT  # (B, n, k)
        half = gaussian.solve_lower(fit.factor, seen.mT)  # (B, k, n)
        return slope, (rows * trust[:, None]) @ rows.mT - half.mT @ half

    def _variance_slope(self, amounts: Tensor, outer: Tensor) -> Tensor:
        """``sum_p outer_p (C_p a)_j``, ``(B, n)``."""
        slope = _project(_sum(amounts, self.root) * outer[:, None], self.root)
        own = (amounts[:, None] * self.kernel.double().T) @ self.std.double() * self.unique.double()  # (B, J, P)
        through = (own * outer[:, None]) @ self.std.double().T  # (B, J, n)
        slope = slope + (self.kernel.double().T * through).sum(1)
        for narrow in self.narrow.double():
            slope = slope + ((self.near.double() @ (amounts[..., None] * narrow)) * outer[:, None] * narrow).sum(2)
        return slope


def _sum(amounts: Tensor, terms: Tensor) -> Tensor:
    """``sum_n a_n t_n``, ``(B, n)`` and ``(n, r, P)`` to ``(B, r, P)``."""
    return torch.tensordot(amounts, terms.double(), 1)


def _project(outer: Tensor, terms: Tensor) -> Tensor:
    """``sum_rp o_rp t_nrp``, ``(B, r, P)`` and ``(n, r, P)`` to ``(B, n)``."""
    return outer.flatten(1) @ terms.double().flatten(1).T
