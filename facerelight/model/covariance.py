"""Prior mean and covariance of a pixel under any lights (3.16), valid by construction.

The deviation's correlation between lights p and q is ``w(p)^T R w(q)`` with R learned, plus
``sqrt(1-rho(p,p)) sqrt(1-rho(q,q)) k(|p - q|)``: unit diagonal, semidefinite for any set of lights, and 1 where two
lights meet.
"""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.geometry.sums import LightSum
from facerelight.model.light_terms import LightTerms, at_pixels, left_alone, of_lights, own_terms, pixel_blocks, reached
from facerelight.model.statistics import FaceStatistics, PixelStatistics

__all__ = ["deviation_covariance", "image_covariance", "observed", "prior_mean", "same_light"]

MEASUREMENT = 1e-8  # relative variance of an observation


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
    blocks = pixel_blocks(max(t.amounts.numel() if t.std is None else 1 for t in (a, b)), statistics)
    parts = [_deviation_covariance(pixel, at_pixels(a, here), at_pixels(b, here), kernel, here) for here in blocks]
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
    unique = left_alone(of_lights(pixel.v_factor.flatten(2)[..., pixels], used), 1).double()  # (J', P)
    if a.std is not None and b.std is not None:
        paired = (together[:, used] @ unique).unflatten(0, (len(a.light), len(b.light)))
        return paired * a.std.double()[:, None] * b.std.double()[None]
    rows = [own_terms(t)[:, used].double() for t in (a, b)]  # (A, J', P)
    return torch.einsum("ajp,bjp->abp", rows[0] * unique, rows[1])


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
