"""What lights make of a model, gathered once: of single directions, and of sums of them."""

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
    "at_pixels",
    "direction_terms",
    "gain_noise",
    "left_alone",
    "light_terms",
    "loadings_at",
    "narrow_terms",
    "of_lights",
    "own_terms",
    "pixel_blocks",
    "pull_of",
    "reached",
    "summed_terms",
]

EVERYWHERE = slice(None)
LEAST_BLOCK, VALUES_AT_ONCE = 512, 32768
OF_PIXELS = ("mean", "std", "factor", "own", "narrow", "lost")


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


Terms = TypeVar("Terms", DirectionTerms, LightTerms)


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
        blocks = pixel_blocks(len(directions), statistics)
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
    blocks = pixel_blocks(len(directions), statistics)
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
    std = (weights[:, used] @ of_lights(pixel.v_std.flatten(1)[:, pixels], used).square()).sqrt()  # (n, P')
    factor, narrow, lost = _interpolated(pixel, weights, face, pixels)
    factor = factor.transpose(0, 1) * std[:, None]
    return DirectionTerms(directions, weights, directions @ n_mean + weights @ v_mean, std, factor, narrow, lost)


def _beside(parts: list[Terms]) -> Terms:
    """Terms of blocks of pixels as one."""
    first = parts[0]
    if len(parts) == 1:
        return first
    names = [name for name in OF_PIXELS if getattr(first, name, None) is not None]
    return first._replace(**{name: torch.cat([getattr(part, name) for part in parts], -1) for name in names})


def at_pixels(terms: LightTerms, pixels: slice) -> LightTerms:
    """Terms at some pixels."""
    names = [name for name in OF_PIXELS if getattr(terms, name) is not None]
    return terms._replace(**{name: getattr(terms, name)[..., pixels] for name in names})


def of_lights(maps: Tensor, used: Tensor) -> Tensor:
    """``maps (J, ...)`` of the lights ``used (J',)``; no copy where that is all of them."""
    return maps if len(used) == len(maps) else maps[used]


def pixel_blocks(count: int, statistics: FaceStatistics) -> list[slice]:
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
    variance = of_lights(pixel.v_std.flatten(1)[:, pixels], used).square()  # (J', P)
    learned = of_lights(pixel.v_factor.flatten(2)[..., pixels], used).transpose(0, 1)  # (r, J', P)
    factor = near @ learned  # (r, n, P)
    # 1 - rho(s, s), (n, P)
    missing = left_alone(factor, 0) - near.square() @ left_alone(learned, 0)
    narrow = positive_root(missing.clamp_min(0) * (near @ variance))  # (n, P)
    if face is None:
        return factor, narrow, torch.zeros_like(narrow)
    loadings = (weights @ face.basis.T) @ face.v.flatten(2)[..., pixels]  # (k, n, P)
    kept = _power(loadings, 0)
    return factor, narrow, positive_root(near @ of_lights(face.v_power.flatten(1)[:, pixels], used) - kept)


def reached(weights: Tensor) -> Tensor:
    """Which of the J bootstrap lights the kernel weights ``(A, J)`` reach: the maps of the others need not be read. All
    where most are, since leaving some out is a copy."""
    found = (weights > 0).any(0)
    return (found | (2 * found.sum() > len(found))).nonzero()[:, 0]


def left_alone(factor: Tensor, dimension: int) -> Tensor:
    """``1 - sum_r F_r^2``, what a correlation factor leaves."""
    return 1 - _power(factor, dimension)


def _power(values: Tensor, dimension: int) -> Tensor:
    """The sum of squares over one dimension, row by row, so that no square of their size is held."""
    total = torch.zeros_like(values.select(dimension, 0)) if values.shape[dimension] else values.sum(dimension)
    for row in values.unbind(dimension):
        total.addcmul_(row, row)
    return total


def own_terms(terms: LightTerms) -> Tensor:
    """Weights times std, ``(A, J, P)``."""
    if terms.std is not None:
        return terms.weights[..., None] * terms.std[:, None]
    assert terms.own is not None
    return terms.own


def pull_of(terms: LightTerms, solved: Tensor) -> Tensor:
    """``sum_k own_kj g_k``, how inputs with ``g = solved (K, P)`` pull each bootstrap light, ``(J, P)`` float64."""
    if terms.std is not None:
        return terms.weights.double().T @ (terms.std * solved)
    return (own_terms(terms) * solved[:, None]).sum(0)


def gain_noise(statistics: FaceStatistics, terms: LightTerms) -> Tensor:
    """Noise of the logarithm of a gain read off an image under each light of ``terms``, ``(A,)``: the mean of its
    directions'."""
    return (terms.weights @ statistics.gain_noise) / terms.weights.sum(1).clamp_min(1e-30)


def loadings_at(face: FaceLoadings, terms: LightTerms) -> Tensor:
    """Loadings of the images under the lights of ``terms``: ``Lambda_n^T s + w(s).Lambda_v``, ``(A, k, P)``."""
    of_n = terms.light @ face.n.flatten(2)  # (k, A, P)
    of_v = (terms.weights @ face.basis.T) @ face.v.flatten(2)  # (k, A, P)
    return (of_n + of_v).transpose(0, 1)
