"""Prior mean and covariance of a pixel under any lights (3.16), valid by construction.

The deviation's correlation between lights p and q is ``w(p)^T R w(q)`` with R learned, plus
``sqrt(1-rho(p,p)) sqrt(1-rho(q,q)) k(|p - q|)``: unit diagonal, semidefinite for any set of lights, and 1 where two
lights meet.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.sums import LightSum
from facerelight.model.statistics import FaceLoadings, FaceStatistics, PixelStatistics
from facerelight.numerics.gaussian import positive_root

__all__ = [
    "DirectionTerms",
    "LightTerms",
    "deviation_covariance",
    "direction_terms",
    "gain_noise",
    "image_covariance",
    "light_terms",
    "loadings_at",
    "narrow_terms",
    "observed",
    "prior_mean",
    "reached",
    "same_light",
    "summed_terms",
]

MEASUREMENT = 1e-8  # relative variance of an observation
EVERYWHERE = slice(None)
LOADINGS_AT_ONCE = 8


class LightTerms(NamedTuple):
    """What a model of A lights at P pixels is made of, gathered once. A light is a sum of n directions, or one.

    Sums over a light's directions, times their amounts: ``light (A, 3)``; ``weights (A, J)``; ``mean (A, P)``, the
    average face; ``factor (A, r, P)``, the interpolated correlation factor times std; ``own (A, J', P)``, the kernel
    weight of each bootstrap light that is ``used (J',)`` times std. Of every direction, ``directions (A, n, 3)`` and
    ``amounts (A, n)``, times its amount: ``narrow (A, n, P)``, the part of std that only nearby lights share;
    ``lost (A, n, P)``, std of the loadings lost to interpolation.
    """

    light: Tensor
    weights: Tensor
    mean: Tensor
    factor: Tensor
    used: Tensor
    own: Tensor
    directions: Tensor
    amounts: Tensor
    narrow: Tensor
    lost: Tensor


class DirectionTerms(NamedTuple):
    """The terms of n single directions: ``directions (n, 3)``, ``weights (n, J)``, ``mean (n, P)``, ``std (n, P)``,
    ``factor (n, r, P)``, ``used (J',)``, ``narrow (n, P)``, ``lost (n, P)``; see :class:`LightTerms`."""

    directions: Tensor
    weights: Tensor
    mean: Tensor
    std: Tensor
    factor: Tensor
    used: Tensor
    narrow: Tensor
    lost: Tensor


def light_terms(
    statistics: FaceStatistics, pixel: PixelStatistics, lights: Tensor | LightSum, face: FaceLoadings | None = None
) -> LightTerms:
    """Gather the terms of ``lights``, directions ``(A, 3)`` or sums with amounts ``(A, n)``, for the per-pixel
    statistics ``pixel`` (with ``face``: its residual's)."""
    if isinstance(lights, Tensor):
        lights = LightSum.single(lights)
    directions, amounts = lights.directions, lights.amounts
    if not lights.shared and amounts.shape[1] == 1:
        return _scaled(direction_terms(statistics, pixel, directions[:, 0], face), amounts[:, 0])
    if lights.shared:
        return summed_terms(direction_terms(statistics, pixel, directions, face), amounts)
    rows = [
        summed_terms(direction_terms(statistics, pixel, row, face), amount[None])
        for row, amount in zip(directions, amounts, strict=True)
    ]
    return _stacked(rows)


def direction_terms(
    statistics: FaceStatistics, pixel: PixelStatistics, directions: Tensor, face: FaceLoadings | None = None
) -> DirectionTerms:
    """Gather the terms of single ``directions (n, 3)``."""
    weights = statistics.weights(directions)  # (n, J)
    mean = directions @ statistics.n_mean.flatten(1) + weights @ statistics.v_mean.flatten(1)  # (n, P)
    used = reached(weights)
    std = (weights[:, used] @ pixel.v_std[used].flatten(1).square()).sqrt()
    factor, narrow, lost = _interpolated(pixel, weights, face, EVERYWHERE)
    return DirectionTerms(directions, weights, mean, std, factor.transpose(0, 1) * std[:, None], used, narrow, lost)


def summed_terms(terms: DirectionTerms, amounts: Tensor) -> LightTerms:
    """Lights that are sums of ``amounts (A, n)`` of the same n directions."""
    near = terms.weights[:, terms.used]  # (n, J')
    return LightTerms(
        amounts @ terms.directions,
        amounts @ terms.weights,
        amounts @ terms.mean,
        torch.tensordot(amounts, terms.factor, 1),
        terms.used,
        (amounts[:, None] * near.T) @ terms.std,  # (A, J', P)
        terms.directions.expand(len(amounts), -1, -1),
        amounts,
        amounts[..., None] * terms.narrow,
        amounts[..., None] * terms.lost,
    )


def _scaled(terms: DirectionTerms, amounts: Tensor) -> LightTerms:
    """Lights of one direction each, ``amounts (A,)`` times as strong."""
    by = amounts[:, None]
    return LightTerms(
        by * terms.directions,
        by * terms.weights,
        by * terms.mean,
        by[..., None] * terms.factor,
        terms.used,
        (by * terms.weights[:, terms.used])[..., None] * terms.std[:, None],
        terms.directions[:, None],
        by,
        (by * terms.narrow)[:, None],
        (by * terms.lost)[:, None],
    )


def _stacked(rows: list[LightTerms]) -> LightTerms:
    """Terms of lights that were gathered one by one."""
    used = torch.cat([row.used for row in rows]).unique()
    own = [_at(row, used) for row in rows]
    joined = {name: torch.cat([getattr(row, name) for row in rows]) for name in LightTerms._fields if name != "used"}
    return LightTerms(**{**joined, "used": used, "own": torch.cat(own)})


def _at(terms: LightTerms, lights: Tensor) -> Tensor:
    """``own`` at some bootstrap ``lights (J'',)``, zero where the terms do not reach, ``(A, J'', P)``."""
    if terms.used.shape == lights.shape and bool((terms.used == lights).all()):
        return terms.own
    there = torch.isin(lights, terms.used)
    place = torch.searchsorted(terms.used, lights).clamp_max(len(terms.used) - 1)
    return terms.own[:, place] * there[:, None].to(terms.own)


def narrow_terms(
    pixel: PixelStatistics, weights: Tensor, face: FaceLoadings | None = None, pixels: slice = EVERYWHERE
) -> tuple[Tensor, Tensor]:
    """``narrow`` and ``lost`` of :class:`DirectionTerms`, ``(n, P)`` each, at some ``pixels``, from
    ``weights (n, J)``."""
    return _interpolated(pixel, weights, face, pixels)[1:]


def _interpolated(
    pixel: PixelStatistics, weights: Tensor, face: FaceLoadings | None, pixels: slice
) -> tuple[Tensor, Tensor, Tensor]:
    """The correlation factor between the bootstrap lights, ``(r, n, P)``, and what interpolation loses: ``narrow`` and
    ``lost``, ``(n, P)`` each."""
    used = reached(weights)
    near = weights[:, used]  # (n, J')
    variance = pixel.v_std.flatten(1)[:, pixels][used].square()  # (J', P)
    learned = pixel.v_factor.flatten(2)[..., pixels][used].transpose(0, 1)  # (r, J', P)
    factor = near @ learned  # (r, n, P)
    unique = 1 - learned.square().sum(0)
    own = torch.addmm(factor.square().sum(0), near.square(), unique)  # rho(s, s), (n, P)
    narrow = positive_root((1 - own).clamp_min(0) * (near @ variance))  # (n, P)
    if face is None:
        return factor, narrow, torch.zeros_like(narrow)
    inside = weights @ face.basis.T  # (n, m)
    parts = face.v.flatten(2)[..., pixels].split(LOADINGS_AT_ONCE)
    kept = torch.stack([(inside @ part).square().sum(0) for part in parts]).sum(0)  # of (k, n, P)
    return factor, narrow, positive_root(near @ face.v_power.flatten(1)[:, pixels][used] - kept)


def reached(weights: Tensor) -> Tensor:
    """Which of the J bootstrap lights the kernel weights ``(A, J)`` reach: the maps of the others need not be read."""
    return (weights > 0).any(0).nonzero()[:, 0]


def prior_mean(statistics: FaceStatistics, lights: Tensor | LightSum) -> Tensor:
    """``s^T mu_n + mu_v(s)`` under directions ``(A, 3)`` or sums with amounts ``(A, n)``, ``(A, P)``."""
    lights = LightSum.single(lights) if isinstance(lights, Tensor) else lights
    weights = (lights.amounts[:, None] @ statistics.weights(lights.directions))[:, 0]  # (A, J)
    return lights.vector @ statistics.n_mean.flatten(1) + weights @ statistics.v_mean.flatten(1)


def deviation_covariance(statistics: FaceStatistics, pixel: PixelStatistics, a: LightTerms, b: LightTerms) -> Tensor:
    """Covariance of the deviation v between lights a and b, pixel by pixel (4.6), completed; ``(P, A, B)`` float64.

    Summed in float64: in float32 the rounding of K nearly equal lights alone can make it indefinite.
    """
    both = a.used[torch.isin(a.used, b.used)]
    unique = positive_root(1 - pixel.v_factor[both].flatten(2).square().sum(1))  # (J'', P)
    rows = [torch.cat((t.factor, _at(t, both) * unique), 1).double() for t in (a, b)]  # (A, r + J'', P)
    kernel = statistics.nugget(*(t.directions.double().flatten(0, 1) for t in (a, b)))  # (A n, B m)
    narrow = _meeting(a.narrow, b.narrow, kernel) + _meeting(a.lost, b.lost, kernel)  # (A, B, P)
    return torch.einsum("arp,brp->pab", *rows) + narrow.permute(2, 0, 1)


def same_light(statistics: FaceStatistics, a: LightTerms, b: LightTerms) -> Tensor:
    """How nearly lights a and b are the same up to strength, ``(A, B)`` in 0 to 1 float64: the narrow kernel between
    two directions."""

    def between(p: LightTerms, q: LightTerms) -> Tensor:
        kernel = statistics.nugget(*(t.directions.double().flatten(0, 1) for t in (p, q)))
        return _meeting(p.amounts[..., None], q.amounts[..., None], kernel)[..., 0]

    own = [between(t, t).diagonal() for t in (a, b)]
    return between(a, b) / (own[0][:, None] * own[1]).clamp_min(1e-60).sqrt()


def _meeting(a: Tensor, b: Tensor, kernel: Tensor) -> Tensor:
    """``sum_ij a_i k_ij b_j`` of ``a (A, n, P)`` and ``b (B, m, P)`` by the narrow kernel ``(A n, B m)``,
    ``(A, B, P)``."""
    kernel = kernel.unflatten(0, a.shape[:2]).unflatten(2, b.shape[:2]).permute(2, 0, 1, 3)  # (B, A, n, m)
    through = kernel.flatten(1, 2) @ b.double() if b.shape[1] > 1 else kernel.flatten(1, 2) * b.double()  # (B, A n, P)
    return (a.double() * through.unflatten(1, a.shape[:2])).sum(2).transpose(0, 1)


def image_covariance(statistics: FaceStatistics, pixel: PixelStatistics, a: LightTerms, b: LightTerms) -> Tensor:
    """Covariance of the intensities under lights a and b: ``s_a^T C_n s_b + cov v`` (3.16), ``(P, A, B)`` float64."""
    root = pixel.n_factor.flatten(2)  # (3, 3, P)
    normal = torch.einsum("cap,cbp->pab", *(torch.einsum("ld,dcp->clp", t.light, root).double() for t in (a, b)))
    return normal + deviation_covariance(statistics, pixel, a, b)


def observed(covariance: Tensor, noise: Tensor | float = 0.0) -> Tensor:
    """Covariance ``(P, K, K)`` of what a camera records: ``noise`` squared, and a relative variance of 1e-8, at every
    observation.

    The relative part is far below a grey level: without noise inputs are returned exactly, and two lights nearer than
    about 1e-4 rad count as one, where otherwise the rounding of the arithmetic would be blown up without bound.

    Args:
        covariance: of noiseless intensities, ``(P, K, K)``.
        noise: standard deviation of each observation in units of the intensities, broadcast to ``(P, K)``.
    """
    own = covariance.diagonal(dim1=-2, dim2=-1)  # (P, K)
    squared = torch.as_tensor(noise, dtype=covariance.dtype, device=covariance.device).square()
    return covariance + torch.diag_embed((MEASUREMENT * own + squared).expand_as(own))


def gain_noise(statistics: FaceStatistics, terms: LightTerms) -> Tensor:
    """Noise of the logarithm of a gain read off an image under each light of ``terms``, ``(A,)``: the mean of its
    directions'."""
    return (terms.weights @ statistics.gain_noise) / terms.weights.sum(1).clamp_min(1e-30)


def loadings_at(face: FaceLoadings, terms: LightTerms) -> Tensor:
    """Loadings of the images under the lights of ``terms``: ``Lambda_n^T s + w(s).Lambda_v``, ``(A, k, P)``."""
    of_n = terms.light @ face.n.flatten(2)  # (k, A, P)
    of_v = (terms.weights @ face.basis.T) @ face.v.flatten(2)  # (k, A, P)
    return (of_n + of_v).transpose(0, 1)
