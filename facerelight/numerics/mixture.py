"""The most probable grey level under a mixture of Gaussians: Algorithm 1, exactly and as the thesis draws it. It knows
nothing of faces."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

__all__ = ["draw_mixture", "histogram_mode", "mixture_mode"]

LEVELS = 256  # grey levels of the displayed range 0..1
LEAST_VARIANCE = (1 / 255) ** 2 / 12  # of a value rounded to a grey level


def mixture_mode(means: Tensor, variances: Tensor, weights: Tensor | None = None) -> Tensor:
    """The grey level at which the mixture's density is highest, evaluated exactly at the 256 levels.

    Args:
        means, variances: of the M components, ``(M, P)``; variances below that of rounding to a grey level count as
            that.
        weights: ``(M,)``, default equal.

    Returns:
        ``(P,)``, in 0..1; the level nearest to the mean where there is one component.

    Example:
        >>> mixture_mode(torch.tensor([[0.2], [0.6]]), torch.tensor([[1e-3], [1e-2]])).mul(255).round()
        tensor([51.])
    """
    count = len(means)
    share = torch.full((count,), 1 / count) if weights is None else weights / weights.sum()
    levels = torch.linspace(0, 1, LEVELS, dtype=means.dtype, device=means.device)
    parts = []
    for mean, variance in zip(means.split(2048, 1), variances.clamp_min(LEAST_VARIANCE).split(2048, 1), strict=True):
        density = torch.full((LEVELS, mean.shape[1]), -torch.inf, dtype=means.dtype, device=means.device)
        for m, v, w in zip(mean, variance, share.tolist(), strict=True):
            if w > 0:  # in log space: far from every component all densities underflow
                density = torch.logaddexp(density, -0.5 * ((levels[:, None] - m) ** 2 / v + v.log()) + float(np.log(w)))
        parts.append(levels[density.argmax(0)])
    return torch.cat(parts)


def draw_mixture(means: Tensor, variances: Tensor, draws: int, generator: torch.Generator | None = None) -> Tensor:
    """``draws`` samples from each of the M equally likely components (Algorithm 1, step 3), ``(M * draws, P)``."""
    noise = torch.randn(draws, *means.shape, generator=generator, dtype=means.dtype)
    return (means + variances.clamp_min(LEAST_VARIANCE).sqrt() * noise).flatten(0, 1)


def histogram_mode(samples: Tensor, order: int = 4, cutoff: float = 0.08) -> Tensor:
    """The mode of samples ``(S, P)`` as the thesis finds it: a histogram over the grey levels, low-pass filtered
    (Algorithm 1, 5.1).

    Args:
        samples: drawn images, one a row.
        order, cutoff: of the Butterworth filter; the cut-off is a fraction of the Nyquist frequency. Its delay is
            undone.

    Returns:
        ``(P,)``, in 0..1.
    """
    from scipy.signal import butter, group_delay, lfilter  # slow to import

    bins = (samples * (LEVELS - 1)).round().clamp(0, LEVELS - 1).long()
    counts = torch.zeros(LEVELS, samples.shape[1], dtype=torch.float64)
    counts.scatter_add_(0, bins, torch.ones_like(bins, dtype=torch.float64))
    b, a = butter(order, cutoff)
    delay = round(float(group_delay((b, a), w=[1e-3])[1][0]))
    padded = np.pad(counts.numpy(), ((0, delay), (0, 0)))
    smooth = lfilter(b, a, padded, axis=0)[delay:]
    return (torch.from_numpy(smooth.argmax(0)) / (LEVELS - 1)).to(samples.dtype)
