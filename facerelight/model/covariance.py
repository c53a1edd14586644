"""Prior mean and covariance of a pixel under any lights (3.16), valid by construction.

The deviation's correlation between lights p and q is ``w(p)^T R w(q)`` with R learned, plus
``sqrt(1-rho(p,p)) sqrt(1-rho(q,q)) k(|p - q|)``: unit diagonal, semidefinite for any set of lights, and 1 where two
lights meet.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

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
    "left_alone",
    "light_terms",
    "loadings_at",
    "narrow_terms",
    "observed",
    "prior_mean",
    "pull_of",
    "reached",
    "same_light",
    "summed_terms",
]

MEASUREMENT = 1e-8  # relative variance of an observation
EVERYWHERE = slice(None)
LEAST_BLOCK, VALUES_AT_ONCE = 512, 32768


class LightTerms(NamedTuple):
    """What a model of A lights at P pixels is made of, gathered once. A light is a sum of n directions, or one.

    Sums over a light's directions, times their amounts: ``light (A, 3)``; ``weights (A, J)``; ``mean (A, P)``, the
    average face; ``factor (A, r, P)``, the interpolated correlation factor times std; ``own (A, J, P)``, weights times
    std. A single direction's ``own`` is None and its ``std (A, P)`` given instead. Of every direction,
    ``directions (A, n, 3)`` and ``amounts (A, n)``, times its amount: ``narrow (A, n, P)``, the part of std that only
    nearby lights share; ``lost (A, n, P)``, std of the loadings lost to interpolation.
    """

    light: Tensor
    weights: Tensor
    mean: Tensor
    factor: Tensor
    own: Tensor | None
    std: Tensor | None
    directions: Tensor
    amounts: Tensor
    narrow: Tensor
    lost: Tensor


class DirectionTerms(NamedTuple):
    """The terms of n single directions: ``directions (n, 3)``, ``weights (n, J)``, ``mean (n, P)``, ``std (n, P)``,
    ``factor (n, r, P)``, ``narrow (n, P)``, ``lost (n, P)``; see :class:`LightTerms`."""

    directions: Tensor
    weights: Tensor
    mean: Tensor
    std: Tensor
    factor: Tensor
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
        return _scaled(direction_terms(statistics, pixel, directions[:, 0], face), amounts)
    if lights.shared:
        weights = statistics.weights(directions)
        blocks = _blocks(len(directions), statistics)
        parts = [_direction_terms(statistics, pixel, directions, weights, face, here) for here in blocks]
        return _beside([summed_terms(part, amounts) for part in parts])
    rows = [
        light_terms(statistics, pixel, LightSum(row, amount[None]), face)
        for row, amount in zip(directions, amounts, strict=True)
    ]
    first = rows[0]
    names = [name for name in LightTerms._fields if getattr(first, name) is not None]
    return first._replace(**{name: torch.cat([getattr(row, name) for row in rows]) for name in names})


def direction_terms(
    statistics: FaceStatistics, pixel: PixelStatistics, directions: Tensor, face: FaceLoadings | None = None
) -> DirectionTerms:
    """Gather the terms of single ``directions (n, 3)``."""
    weights = statistics.weights(directions)
    blocks = _blocks(len(directions), statistics)
    return _beside([_direction_terms(statistics, pixel, directions, weights, face, here) for here in blocks])


def _direction_terms(
    statistics: FaceStatistics,
    pixel: PixelStatistics,
    directions: Tensor,
    weights: Tensor,
    face: FaceLoadings | None,
    pixels: slice,
) -> DirectionTerms:
    """:func:`direction_terms` at some ``pixels``, from ``weights (n, J)``."""
    n_mean, v_mean = (part.flatten(1)[:, pixels] for part in (statistics.n_mean, statistics.v_mean))
    used = reached(weights)
    std = (weights[:, used] @ _some(pixel.v_std.flatten(1)[:, pixels], used).square()).sqrt()  # (n, P')
    factor, narrow, lost = _interpolated(pixel, weights, face, pixels)
    factor = factor.transpose(0, 1) * std[:, None]
    return DirectionTerms(directions, weights, directions @ n_mean + weights @ v_mean, std, factor, narrow, lost)


Terms = TypeVar("Terms", DirectionTerms, LightTerms)
OF_PIXELS = ("mean", "std", "factor", "own", "narrow", "lost")


def _beside(parts: list[Terms]) -> Terms:
    """Terms of blocks of pixels as one."""
    first = parts[0]
    if len(parts) == 1:
        return first
    names = [name for name in OF_PIXELS if getattr(first, name, None) is not None]
    return first._replace(**{name: torch.cat([getattr(part, name) for part in parts], -1) for name in names})


def _at(terms: LightTerms, pixels: slice) -> LightTerms:
    """Terms at some pixels."""
    names = [name for name in OF_PIXELS if getattr(terms, name) is not None]
    return terms._replace(**{name: getattr(terms, name)[..., pixels] for name in names})


def _some(maps: Tensor, used: Tensor) -> Tensor:
    """``maps (J, ...)`` of the lights ``used (J',)``; no copy where that is all of them."""
    return maps if len(used) == len(maps) else maps[used]


def _blocks(count: int, statistics: FaceStatistics) -> list[slice]:
    """Pixels that are worked on together: few enough for the terms of ``count`` directions to stay in the cache."""
    pixels = statistics.size[0] * statistics.size[1]
    step = max(LEAST_BLOCK, VALUES_AT_ONCE // max(count, 1))
    return [slice(start, min(start + step, pixels)) for start in range(0, pixels, step)]


def summed_terms(terms: DirectionTerms, amounts: Tensor) -> LightTerms:
    """Lights that are sums of ``amounts (A, n)`` of the same n directions."""
    return LightTerms(
        amounts @ terms.directions,
        amounts @ terms.weights,
        amounts @ terms.mean,
        torch.tensordot(amounts, terms.factor, 1),
        (amounts[:, None] * terms.weights.T) @ terms.std,  # (A, J, P)
        None,
        terms.directions.expand(len(amounts), -1, -1),
        amounts,
        amounts[..., None] * terms.narrow,
        amounts[..., None] * terms.lost,
    )


def _scaled(terms: DirectionTerms, amounts: Tensor) -> LightTerms:
    """Lights of one direction each, ``amounts (A, 1)`` times as strong."""
    return LightTerms(
        amounts * terms.directions,
        amounts * terms.weights,
        amounts * terms.mean,
        amounts[..., None] * terms.factor,
        None,
        terms.std,
        terms.directions[:, None],
        amounts,
        (amounts * terms.narrow)[:, None],
        (amounts * terms.lost)[:, None],
    )


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
    variance = _some(pixel.v_std.flatten(1)[:, pixels], used).square()  # (J', P)
    learned = _some(pixel.v_factor.flatten(2)[..., pixels], used).transpose(0, 1)  # (r, J', P)
    factor = near @ learned  # (r, n, P)
    # 1 - rho(s, s), (n, P)
    missing = left_alone(factor, 0) - near.square() @ left_alone(learned, 0)
    narrow = positive_root(missing.clamp_min(0) * (near @ variance))  # (n, P)
    if face is None:
        return factor, narrow, torch.zeros_like(narrow)
    loadings = (weights @ face.basis.T) @ face.v.flatten(2)[..., pixels]  # (k, n, P)
    kept = _power(loadings, 0)
    return factor, narrow, positive_root(near @ _some(face.v_power.flatten(1)[:, pixels], used) - kept)


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
    kernel = statistics.nugget(*(t.directions.double().flatten(0, 1) for t in (a, b)))  # (A n, B m)
    blocks = _blocks(max(t.amounts.numel() if t.std is None else 1 for t in (a, b)), statistics)
    parts = [_deviation_covariance(pixel, _at(a, here), _at(b, here), kernel, here) for here in blocks]
    return parts[0] if len(parts) == 1 else torch.cat(parts)


def _deviation_covariance(
    pixel: PixelStatistics, a: LightTerms, b: LightTerms, kernel: Tensor, pixels: slice
) -> Tensor:
    """At some ``pixels``, whose terms ``a`` and ``b`` are."""
    apart = (
        _unique_covariance(pixel, a, b, pixels)
        + _meeting(a.narrow, b.narrow, kernel)
        + _meeting(a.lost, b.lost, kernel)
    )
    return torch.einsum("arp,brp->pab", a.factor.double(), b.factor.double()) + apart.permute(2, 0, 1)


def _unique_covariance(pixel: PixelStatistics, a: LightTerms, b: LightTerms, pixels: slice) -> Tensor:
    """What lights a and b share of that which the correlation factor leaves to single bootstrap lights,
    ``(A, B, P)``."""
    together = (a.weights.double()[:, None] * b.weights.double()[None]).flatten(0, 1)  # (A B, J)
    used = reached(together)
    unique = left_alone(_some(pixel.v_factor.flatten(2)[..., pixels], used), 1).double()  # (J', P)
    if a.std is not None and b.std is not None:
        paired = (together[:, used] @ unique).unflatten(0, (len(a.light), len(b.light)))
        return paired * a.std.double()[:, None] * b.std.double()[None]
    rows = [_own(t)[:, used].double() for t in (a, b)]  # (A, J', P)
    return torch.einsum("ajp,bjp->abp", rows[0] * unique, rows[1])


def left_alone(factor: Tensor, dimension: int) -> Tensor:
    """``1 - sum_r F_r^2``, what a correlation factor leaves."""
    return 1 - _power(factor, dimension)


def _power(values: Tensor, dimension: int) -> Tensor:
    """The sum of squares over one dimension, row by row, so that no square of their size is held."""
    total = torch.zeros_like(values.select(dimension, 0)) if values.shape[dimension] else values.sum(dimension)
    for row in values.unbind(dimension):
        total.addcmul_(row, row)
    return total


def _own(terms: LightTerms) -> Tensor:
    """Weights times std, ``(A, J, P)``."""
    if terms.std is not None:
        return terms.weights[..., None] * terms.std[:, None]
    assert terms.own is not None
    return terms.own


def pull_of(terms: LightTerms, solved: Tensor) -> Tensor:
    """``sum_k own_kj g_k``, how inputs with ``g = solved (K, P)`` pull each bootstrap light, ``(J, P)`` float64."""
    if terms.std is not None:
        return terms.weights.double().T @ (terms.std * solved)
    return (_own(terms) * solved[:, None]).sum(0)


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
