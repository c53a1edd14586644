"""Conditional Gaussians and the package's only factorisations; it knows nothing of faces.

Small systems are solved in float64 through a Cholesky factor, nothing is inverted, and variances are kept at or above zero.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import torch
from torch import Tensor

__all__ = [
    "Conditional",
    "NotPositiveDefiniteError",
    "NumericalWarning",
    "condition_gaussian",
    "correlation_factor",
    "covariance_factor",
    "positive_variance",
    "safe_cholesky",
    "solve_lower",
    "solve_upper",
]

JITTER_STEPS = (1e-12, 1e-10, 1e-8, 1e-6)  # relative to the mean diagonal


class NumericalWarning(RuntimeWarning):
    """A covariance had to be nudged to be factored; the message counts how many."""


class NotPositiveDefiniteError(RuntimeError):
    """A matrix that must be a covariance is not one, or holds NaN or infinity."""


class Conditional(NamedTuple):
    """``p(x | y)``: mean ``(..., X)`` and covariance ``(..., X, X)``."""

    mean: Tensor
    covariance: Tensor


def safe_cholesky(matrix: Tensor) -> Tensor:
    """Lower Cholesky factors of ``(..., K, K)`` covariances, in float64.

    Members of the batch that fail get a jitter on the diagonal, relative to their own mean diagonal, from 1e-12 to 1e-6; the
    others are left as they are.

    Raises:
        NotPositiveDefiniteError: a member holds NaN or infinity, or is indefinite beyond the largest jitter.

    Warns:
        NumericalWarning: some members needed jitter; says how many and how much.
    """
    matrix = matrix.double()
    factor, info = torch.linalg.cholesky_ex(matrix)
    if not info.any() and torch.isfinite(factor).all():
        return factor
    finite = torch.isfinite(matrix).all(dim=-1).all(dim=-1)
    if not finite.all():
        raise NotPositiveDefiniteError(
            f"covariance: expected finite entries, got NaN or infinity in {int((~finite).sum())} of {finite.numel()} matrices"
        )
    failed = info != 0
    count = int(failed.sum())
    scale = matrix.diagonal(dim1=-2, dim2=-1).mean(-1).abs().clamp_min(torch.finfo(torch.float64).tiny)
    eye = torch.eye(matrix.shape[-1], dtype=torch.float64, device=matrix.device)
    for jitter in JITTER_STEPS:
        nudged = matrix + (jitter * scale * failed)[..., None, None] * eye
        factor, info = torch.linalg.cholesky_ex(nudged)
        if not info.any():
            warnings.warn(f"{count} of {failed.numel()} covariances needed a relative jitter of {jitter:g}", NumericalWarning, stacklevel=2)
            return factor
    raise NotPositiveDefiniteError(
        f"covariance: expected positive semidefinite, {int((info != 0).sum())} of {failed.numel()} matrices are not,"
        f" even with a relative jitter of {JITTER_STEPS[-1]:g}; check for contradictory or corrupt statistics"
    )


def solve_lower(factor: Tensor, right: Tensor) -> Tensor:
    """``L^-1 B`` for lower factors ``(..., K, K)`` and ``(..., K, M)``; one by one is a division."""
    return right / factor if factor.shape[-1] == 1 else torch.linalg.solve_triangular(factor, right, upper=False)


def solve_upper(factor: Tensor, right: Tensor) -> Tensor:
    """``L^-T B`` for lower factors ``(..., K, K)`` and ``(..., K, M)``."""
    return right / factor if factor.shape[-1] == 1 else torch.linalg.solve_triangular(factor.mT, right, upper=True)


def positive_variance(variance: Tensor) -> Tensor:
    """``variance`` with what rounding left below zero set to zero."""
    return variance.clamp_min(0)


def condition_gaussian(mean_x: Tensor, mean_y: Tensor, cov_xx: Tensor, cov_xy: Tensor, cov_yy: Tensor, y: Tensor) -> Conditional:
    """The Gauss-Markov theorem (eqs. 3.7, 3.8): ``p(x | y)`` of jointly Gaussian x and y.

    Args:
        mean_x, mean_y: ``(..., X)`` and ``(..., Y)``.
        cov_xx, cov_xy, cov_yy: ``(..., X, X)``, ``(..., X, Y)``, ``(..., Y, Y)``.
        y: the observation, ``(..., Y)``.

    Returns:
        ``m = mu_x + R_xy R_yy^-1 (y - mu_y)`` and ``C_m = R_xx - R_xy R_yy^-1 R_yx``, in ``y``'s dtype, solved in float64.

    Example:
        >>> one = torch.ones(1, 1)
        >>> condition_gaussian(torch.zeros(1), torch.zeros(1), one, 0.5 * one, one, torch.ones(1)).mean
        tensor([0.5000])
    """
    factor = safe_cholesky(cov_yy)
    whitened = torch.linalg.solve_triangular(factor, cov_xy.double().mT, upper=False)  # L^-1 R_yx  (..., Y, X)
    residual = torch.linalg.solve_triangular(factor, (y - mean_y).double()[..., None], upper=False)
    mean = mean_x.double() + (whitened.mT @ residual)[..., 0]
    covariance = cov_xx.double() - whitened.mT @ whitened
    return Conditional(mean.to(y.dtype), ((covariance + covariance.mT) / 2).to(y.dtype))


def covariance_factor(samples: Tensor, dof: float) -> Tensor:
    """A square factor ``L`` with ``L L^T = X^T X / dof`` for centred samples ``(..., N, D)``, any N, exactly semidefinite; ``(..., D, D)``."""
    covariance = (samples.mT @ samples).double() / dof
    values, vectors = torch.linalg.eigh(covariance)
    return (vectors * values.clamp_min(0).sqrt()[..., None, :]).to(samples.dtype)


def correlation_factor(samples: Tensor, rank: int) -> Tensor:
    """The leading factor ``F`` ``(..., D, rank)`` of the correlation of samples whose columns have unit sum of squares.

    ``F F^T + diag(1 - rowsum F^2)`` is a correlation matrix: unit diagonal, semidefinite, and the best of that rank in what ``F F^T``
    keeps of the trace.

    Args:
        samples: ``(..., N, D)``, columns of unit length, or of zero length where a variable never varies.
        rank: columns to keep; zero columns fill up where N or D is smaller.
    """
    count, variables = samples.shape[-2:]
    kept = min(rank, count, variables)
    if count <= variables:  # the smaller Gram matrix has the same spectrum
        vectors = torch.linalg.eigh(samples @ samples.mT).eigenvectors[..., -kept:]
        factor = samples.mT @ vectors
    else:
        values, vectors = torch.linalg.eigh(samples.mT @ samples)
        factor = vectors[..., -kept:] * values[..., None, -kept:].clamp_min(0).sqrt()
    # rounding may lift a row's length above 1, which would make its own variance negative
    factor = factor / factor.square().sum(-1, keepdim=True).sqrt().clamp_min(1)
    return torch.nn.functional.pad(factor.flip(-1), (0, rank - kept))
