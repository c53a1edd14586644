"""Gaussian kernel regression (eqs. 4.4 to 4.6), in log space so that no distance is too large for it."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["error_correlation", "kernel_weights", "neighbour_widths"]


def kernel_weights(squared_distance: Tensor, width: Tensor | float) -> Tensor:
    """Normalised Gaussian kernel weights ``w_j = exp(-d_j^2 / 2 h_j^2) / sum`` (eqs. 4.4, 4.5).

    Args:
        squared_distance: ``(..., J)``, squared distances to the J kernel centres.
        width: kernel widths ``h``, positive, broadcast against it.

    Returns:
        Weights ``(..., J)``, non-negative, that sum to 1 along the last axis even where every kernel underflows on its
        own.

    Example:
        >>> kernel_weights(torch.tensor([1e6, 1e6 + 1.0]), 0.1).tolist()[0]
        1.0
    """
    return torch.softmax(-0.5 * squared_distance / torch.as_tensor(width, dtype=squared_distance.dtype) ** 2, dim=-1)


def neighbour_widths(distance: Tensor, neighbours: int) -> Tensor:
    """The distance from each centre to its ``neighbours``-th nearest other centre.

    Args:
        distance: ``(J, J)`` distances between the centres.
        neighbours: which one, at least 1; capped at ``J - 1``.

    Returns:
        ``(J,)`` widths, kept above zero where centres coincide.
    """
    if neighbours < 1:
        raise ValueError(f"neighbours: expected at least 1, got {neighbours}")
    count = distance.shape[-1]
    if count == 1:
        return torch.ones(1, dtype=distance.dtype, device=distance.device)
    width = distance.kthvalue(min(neighbours, count - 1) + 1, dim=-1).values
    return width.clamp_min(torch.finfo(distance.dtype).eps)


def error_correlation(points: Tensor, reach: float, own: float) -> Tensor:
    """Correlation ``exp(-d^2 / 2 reach^2)`` of errors made at ``points (..., K, 3)``, of which ``own`` is each one's,
    ``(..., K, K)`` float64."""
    squared = torch.cdist(points.double(), points.double()).square()
    eye = torch.eye(points.shape[-2], dtype=torch.float64, device=points.device)
    return torch.exp(-0.5 * squared / reach**2) * (1 - own) + own * eye
