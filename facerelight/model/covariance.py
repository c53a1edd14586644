"""Prior mean and covariance of a pixel under any lights (3.16), valid by construction.

The deviation's correlation between lights p and q is ``w(p)^T R w(q)`` with R learned, plus
``sqrt(1-rho(p,p)) sqrt(1-rho(q,q)) k(|p - q|)``: unit diagonal, semidefinite for any set of lights, and 1 where two
lights meet.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.model.statistics import FaceLoadings, FaceStatistics, PixelStatistics
from facerelight.numerics.gaussian import positive_root

__all__ = [
    "LightTerms",
    "deviation_covariance",
    "image_covariance",
    "light_terms",
    "loadings_at",
    "narrow_terms",
    "observed",
    "prior_mean",
    "reached",
]

MEASUREMENT = 1e-8  # relative variance of an observation
EVERYWHERE = slice(None)


class LightTerms(NamedTuple):
    """What a model of A lights at P pixels is made of, gathered once.

    ``light (A, 3)``; ``weights (A, J)``; ``mean (A, P)``, the average face; ``std (A, P)``; ``factor (A, r, P)``, the
    interpolated correlation factor times std; ``narrow (A, P)``, the part of std that only nearby lights share;
    ``lost (A, P)``, std of the loadings lost to interpolation.
    """

    light: Tensor
    weights: Tensor
    mean: Tensor
    std: Tensor
    factor: Tensor
    narrow: Tensor
    lost: Tensor


def light_terms(
    statistics: FaceStatistics, pixel: PixelStatistics, lights: Tensor, face: FaceLoadings | None = None
) -> LightTerms:
    """Gather the terms of ``lights (A, 3)`` for the per-pixel statistics ``pixel`` (with ``face``: its residual's)."""
    weights = statistics.weights(lights)  # (A, J)
    mean = lights @ statistics.n_mean.flatten(1) + weights @ statistics.v_mean.flatten(1)  # (A, P)
    used = reached(weights)
    std = (weights[:, used] @ pixel.v_std[used].flatten(1).square()).sqrt()
    learned = pixel.v_factor[used].flatten(2)  # (J', r, P)
    factor = (weights[:, used] @ learned.flatten(1)).unflatten(1, learned.shape[1:])  # (A, r, P)
    return LightTerms(lights, weights, mean, std, factor * std[:, None], *narrow_terms(pixel, weights, face))


def narrow_terms(
    pixel: PixelStatistics, weights: Tensor, face: FaceLoadings | None = None, pixels: slice = EVERYWHERE
) -> tuple[Tensor, Tensor]:
    """``narrow`` and ``lost`` of :func:`light_terms`, ``(A, P)`` each, at some ``pixels``, from ``weights (A, J)``."""
    used = reached(weights)
    near = weights[:, used]  # (A, J')
    variance = pixel.v_std.flatten(1)[:, pixels][used].square()  # (J', P)
    learned = pixel.v_factor.flatten(2)[..., pixels][used].transpose(0, 1)  # (r, J', P)
    unique = 1 - learned.square().sum(0)
    own = torch.addmm((near @ learned).square().sum(0), near.square(), unique)  # rho(s, s), (A, P)
    narrow = positive_root((1 - own).clamp_min(0) * (near @ variance))  # (A, P)
    if face is None:
        return narrow, torch.zeros_like(narrow)
    kept = ((weights @ face.basis.T) @ face.v.flatten(2)[..., pixels]).square().sum(0)  # of (k, A, P)
    return narrow, positive_root(near @ face.v_power.flatten(1)[:, pixels][used] - kept)  # (A, P)


def reached(weights: Tensor) -> Tensor:
    """Which of the J bootstrap lights the kernel weights ``(A, J)`` reach: the maps of the others need not be read."""
    return (weights > 0).any(0).nonzero()[:, 0]


def prior_mean(statistics: FaceStatistics, lights: Tensor) -> Tensor:
    """``s^T mu_n + mu_v(s)``, ``(A, P)``."""
    return lights @ statistics.n_mean.flatten(1) + statistics.weights(lights) @ statistics.v_mean.flatten(1)


def deviation_covariance(statistics: FaceStatistics, pixel: PixelStatistics, a: LightTerms, b: LightTerms) -> Tensor:
    """Covariance of the deviation v between lights a and b, pixel by pixel (4.6), completed; ``(P, A, B)`` float64.

    Summed in float64: in float32 the rounding of K nearly equal lights alone can make it indefinite.
    """
    together = (a.weights.double()[:, None] * b.weights.double()[None]).flatten(0, 1)  # (A B, J)
    used = reached(together)
    unique = 1 - pixel.v_factor[used].flatten(2).square().sum(1)  # (J', P)
    paired = together[:, used] @ unique.double()  # (A B, P)
    paired = paired.unflatten(0, (len(a.light), len(b.light))) * a.std.double()[:, None] * b.std.double()[None]
    narrow = a.narrow.double()[:, None] * b.narrow.double()[None] + a.lost.double()[:, None] * b.lost.double()[None]
    narrow = narrow * statistics.nugget(a.light.double(), b.light.double())[..., None]  # (A, B, P)
    return torch.einsum("arp,brp->pab", a.factor.double(), b.factor.double()) + (paired + narrow).permute(2, 0, 1)


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


def loadings_at(face: FaceLoadings, terms: LightTerms) -> Tensor:
    """Loadings of the images under the lights of ``terms``: ``Lambda_n^T s + w(s).Lambda_v``, ``(A, k, P)``."""
    of_n = terms.light @ face.n.flatten(2)  # (k, A, P)
    of_v = (terms.weights @ face.basis.T) @ face.v.flatten(2)  # (k, A, P)
    return (of_n + of_v).transpose(0, 1)
