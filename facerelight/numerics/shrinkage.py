"""Covariances of few samples: as they are, or shrunk towards something simpler. It knows nothing of faces."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

__all__ = ["Shrinkage", "block_shrinkage", "ledoit_wolf", "oas", "sample_covariance", "shrunk_covariance"]

Shrinkage = Literal["sample", "ledoit_wolf", "oas", "block"]
KINDS = ("sample", "ledoit_wolf", "oas", "block")


def sample_covariance(samples: Tensor) -> Tensor:
    """``X^T X / N`` of centred samples ``(..., N, D)``: what 4.3 and 5.5 use (maximum likelihood)."""
    return samples.mT @ samples / samples.shape[-2]


def ledoit_wolf(samples: Tensor) -> Tensor:
    """``(1 - a) S + a mu I`` with the a of Ledoit and Wolf (2004), for centred samples ``(..., N, D)``."""
    count, size = samples.shape[-2:]
    covariance = sample_covariance(samples)
    mu = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    energy = covariance.square().sum((-2, -1))
    spread = (samples.square().mT @ samples.square()).sum((-2, -1)) / count - energy
    beta = spread / (count * size)
    delta = (energy - size * mu**2) / size
    amount = torch.where(delta > 0, torch.minimum(beta, delta) / delta.clamp_min(1e-300), torch.ones_like(delta))
    return _towards_identity(covariance, mu, amount)


def oas(samples: Tensor) -> Tensor:
    """``(1 - a) S + a mu I`` with the oracle-approximating a of Chen et al. (2010), for centred samples
    ``(..., N, D)``."""
    count, size = samples.shape[-2:]
    covariance = sample_covariance(samples)
    mu = covariance.diagonal(dim1=-2, dim2=-1).mean(-1)
    alpha = covariance.square().mean((-2, -1))
    below = (count + 1) * (alpha - mu**2 / size)
    amount = torch.where(below > 0, (alpha + mu**2) / below.clamp_min(1e-300), torch.ones_like(below)).clamp(max=1)
    return _towards_identity(covariance, mu, amount)


def block_shrinkage(samples: Tensor, owner: Tensor) -> Tensor:
    """Entries between variables of different owners are shrunk towards 0, those within one owner's block stay as they
    are.

    The amount is the one of Schaefer and Strimmer (2005): the entries' sampling variance over their squares. At its
    largest, 1, every owner (a pixel) is modelled on its own.

    Args:
        samples: centred, ``(..., N, D)``.
        owner: ``(..., D)``, whose variable each is.
    """
    count = samples.shape[-2]
    covariance = sample_covariance(samples)
    between = (owner[..., :, None] != owner[..., None, :]).to(covariance)
    moment = samples.square().mT @ samples.square() / count
    noise = ((moment - covariance.square()) * between).sum((-2, -1)) / max(count - 1, 1)
    signal = (covariance.square() * between).sum((-2, -1))
    amount = torch.where(signal > 0, noise / signal.clamp_min(1e-300), torch.ones_like(signal)).clamp(0, 1)
    return covariance * (1 - amount[..., None, None] * between)


def shrunk_covariance(samples: Tensor, kind: Shrinkage, owner: Tensor) -> Tensor:
    """The covariance of centred samples ``(..., N, D)`` by one of "sample", "ledoit_wolf", "oas", "block"."""
    if kind == "block":
        return block_shrinkage(samples, owner)
    estimators = {"sample": sample_covariance, "ledoit_wolf": ledoit_wolf, "oas": oas}
    if kind not in estimators:
        raise ValueError(f"shrinkage: expected one of {', '.join(KINDS)}, got {kind!r}")
    return estimators[kind](samples)


def _towards_identity(covariance: Tensor, mu: Tensor, amount: Tensor) -> Tensor:
    eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    return (1 - amount)[..., None, None] * covariance + (amount * mu)[..., None, None] * eye
