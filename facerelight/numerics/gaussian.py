"""Conditional Gaussians and the package's only factorisations; it knows nothing of faces.

Small systems are solved in float64 through a Cholesky factor, nothing is inverted, and variances are kept at or above
zero.
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
    "SequentialConditional",
    "condition_gaussian",
    "correlation_factor",
    "covariance_factor",
    "low_rank_code",
    "positive_root",
    "positive_variance",
    "safe_cholesky",
    "solve_lower",
    "solve_upper",
]

ROUNDING = 1e-6  # of the largest variance; more below zero than this is no rounding
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

    Members of the batch that fail get a jitter on the diagonal, relative to their own mean diagonal, from 1e-12 to
    1e-6; the others are left as they are.

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
            f"covariance: expected finite entries, got NaN or infinity in {int((~finite).sum())}"
            f" of {finite.numel()} matrices"
        )
    failed = info != 0
    count = int(failed.sum())
    scale = matrix.diagonal(dim1=-2, dim2=-1).mean(-1).abs().clamp_min(torch.finfo(torch.float64).tiny)
    eye = torch.eye(matrix.shape[-1], dtype=torch.float64, device=matrix.device)
    for jitter in JITTER_STEPS:
        nudged = matrix + (jitter * scale * failed)[..., None, None] * eye
        factor, info = torch.linalg.cholesky_ex(nudged)
        if not info.any():
            warnings.warn(
                f"{count} of {failed.numel()} covariances needed a relative jitter of {jitter:g}",
                NumericalWarning,
                stacklevel=2,
            )
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


def positive_variance(variance: Tensor, before: Tensor) -> Tensor:
    """``variance`` with what rounding left below zero set to zero; ``before`` is the variance that something was taken
    off.

    Warns:
        NumericalWarning: some lie further below zero than rounding explains; says how many.
    """
    floor = -ROUNDING * float(before.detach().abs().amax()) if before.numel() else 0.0
    below = int((variance < floor).sum())
    if below:
        warnings.warn(
            f"{below} of {variance.numel()} variances were negative, down to {float(variance.detach().min()):g}",
            NumericalWarning,
            stacklevel=2,
        )
    return variance.clamp_min(0)


def positive_root(values: Tensor) -> Tensor:
    """Square roots, zero of what is not positive; there the slope is zero too, and not infinite."""
    positive = values > 0
    return torch.where(positive, torch.where(positive, values, 1).sqrt(), 0)


def condition_gaussian(
    mean_x: Tensor, mean_y: Tensor, cov_xx: Tensor, cov_xy: Tensor, cov_yy: Tensor, y: Tensor
) -> Conditional:
    """The Gauss-Markov theorem (eqs. 3.7, 3.8): ``p(x | y)`` of jointly Gaussian x and y.

    Args:
        mean_x, mean_y: ``(..., X)`` and ``(..., Y)``.
        cov_xx, cov_xy, cov_yy: ``(..., X, X)``, ``(..., X, Y)``, ``(..., Y, Y)``.
        y: the observation, ``(..., Y)``.

    Returns:
        ``m = mu_x + R_xy R_yy^-1 (y - mu_y)`` and ``C_m = R_xx - R_xy R_yy^-1 R_yx``, in ``y``'s dtype, solved in
        float64.

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


class SequentialConditional:
    """``p(x | y_1 .. y_K)`` of a scalar x, one observation at a time (Appendix A), equal to conditioning on all at
    once.

    Appendix A grows the inverse of ``R_yy``; this grows its Cholesky factor by a row, which is the same recursion
    without an inverse: each observation takes ``(sigma_0K - a^T R^-1 r)^2 / gamma`` off the variance, gamma its own
    variance given the earlier ones.

    Args:
        mean, variance: of x before anything is observed, ``(...)``; all arithmetic is in float64.

    Example:
        >>> x = SequentialConditional(torch.zeros(1), torch.ones(1))
        >>> x.add(torch.tensor([2.0]), torch.tensor([0.5]), torch.tensor([1.0]), torch.zeros(1, 0)).variance
        tensor([0.7500], dtype=torch.float64)
    """

    def __init__(self, mean: Tensor, variance: Tensor) -> None:
        self.mean, self.variance = mean.double(), variance.double()
        self._rows = self.mean.new_zeros(*self.mean.shape, 0, 0)  # L, lower triangular
        self._cross = self.mean.new_zeros(*self.mean.shape, 0)  # L^-1 r_yx
        self._white_residuals = self._cross  # L^-1 (y - mu)

    def add(self, residual: Tensor, cross: Tensor, variance: Tensor, covariances: Tensor) -> SequentialConditional:
        """Take in one more observation.

        Args:
            residual: ``y_K - mu_K``, ``(...)``; what the earlier observations foretold of it is taken off here.
            cross: ``Cov(x, y_K)``, ``(...)``.
            variance: ``Var(y_K)``, ``(...)``.
            covariances: ``Cov(y_K, y_j)`` with the earlier observations, in order, ``(..., K - 1)``.
        """
        row = (
            solve_lower(self._rows, covariances.double()[..., None])[..., 0]
            if self._rows.shape[-1]
            else covariances.double()
        )
        gamma = variance.double() - row.square().sum(-1)  # Var(y_K | y_1 .. y_K-1)
        pivot = (
            gamma.clamp_min(JITTER_STEPS[0] * variance.double().abs()).clamp_min(torch.finfo(torch.float64).tiny).sqrt()
        )
        white = (cross.double() - (row * self._cross).sum(-1)) / pivot
        fresh = (residual.double() - (row * self._white_residuals).sum(-1)) / pivot
        self.mean = self.mean + white * fresh
        self.variance = positive_variance(self.variance - white.square(), self.variance)
        self._white_residuals = torch.cat((self._white_residuals, fresh[..., None]), -1)
        self._cross = torch.cat((self._cross, white[..., None]), -1)
        grown = torch.cat((row, pivot[..., None]), -1)
        self._rows = torch.cat((torch.nn.functional.pad(self._rows, (0, 1)), grown[..., None, :]), -2)
        return self


def low_rank_code(
    design: Tensor, observed: Tensor, temper: float, weight: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Posterior of ``c ~ N(0, I_k)`` from whitened observations ``y = A c + e`` at P pixels, the likelihood tempered by
    ``1 / temper``.

    Args:
        design: A, ``(P, K, k)``, float64.
        observed: y, ``(P, K, M)``, M sets of observations.
        temper: how many pixels count as one independent observation.
        weight: ``(P,)``, how much each pixel counts; None: all alike.

    Returns:
        The means ``(k, M)`` and an upper triangular factor ``(k, k)`` of the covariance, ``F F^T``.
    """
    if weight is not None:
        design, observed = design * weight[:, None, None].sqrt(), observed * weight[:, None, None].sqrt()
    rows = design.flatten(0, 1)  # (P K, k)
    eye = torch.eye(rows.shape[1], dtype=rows.dtype, device=rows.device)
    factor = safe_cholesky(eye + rows.T @ rows / temper)
    mean = torch.cholesky_solve(rows.T @ observed.flatten(0, 1) / temper, factor)
    return mean, torch.linalg.solve_triangular(factor, eye, upper=False).T


def covariance_factor(samples: Tensor, dof: float) -> Tensor:
    """A square factor ``L`` with ``L L^T = X^T X / dof`` for centred samples ``(..., N, D)``, any N, exactly
    semidefinite; ``(..., D, D)``."""
    covariance = (samples.mT @ samples).double() / dof
    values, vectors = torch.linalg.eigh(covariance)
    return (vectors * values.clamp_min(0).sqrt()[..., None, :]).to(samples.dtype)


def correlation_factor(samples: Tensor, rank: int) -> Tensor:
    """The leading factor ``F`` ``(..., D, rank)`` of the correlation of samples whose columns have unit sum of squares.

    ``F F^T + diag(1 - rowsum F^2)`` is a correlation matrix: unit diagonal, semidefinite, and the best of that rank in
    what ``F F^T`` keeps of the trace.

    Args:
        samples: ``(..., N, D)``, columns of unit length, or of zero length where a variable never varies.
        rank: columns to keep; zero columns fill up where N or D is smaller.
    """
    count, variables = samples.shape[-2:]
    kept = min(rank, count, variables)
    if kept == 0:
        return samples.new_zeros(*samples.shape[:-2], variables, rank)
    wide = samples.double()  # in float32 LAPACK gives up on some of these, whose small eigenvalues are all rounding
    if count <= variables:  # the smaller Gram matrix has the same spectrum
        factor = wide.mT @ torch.linalg.eigh(wide @ wide.mT).eigenvectors[..., -kept:]
    else:
        values, vectors = torch.linalg.eigh(wide.mT @ wide)
        factor = vectors[..., -kept:] * values[..., None, -kept:].clamp_min(0).sqrt()
    factor = factor.to(samples.dtype)
    # rounding may lift a row's length above 1, which would make its own variance negative
    factor = factor / factor.square().sum(-1, keepdim=True).sqrt().clamp_min(1)
    return torch.nn.functional.pad(factor.flip(-1), (0, rank - kept))
