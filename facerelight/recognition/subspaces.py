"""Linear subspaces of images: batch PCA by the smaller Gram matrix, and an incremental SVD."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.numerics.buffers import LearnedModule

__all__ = ["IncrementalSubspace", "Subspace", "distances", "principal_angles", "principal_subspace"]


class Subspace(NamedTuple):
    """``mean (D,)``, orthonormal ``basis (D, k)`` and ``singular (k,)`` values of the centred exemplars."""

    mean: Tensor
    basis: Tensor
    singular: Tensor


def principal_subspace(
    exemplars: Tensor, dimension: int | None = None, error: float = 0.01, weights: Tensor | None = None
) -> Subspace:
    """PCA of exemplars ``(M, D)``.

    Args:
        exemplars: rows, float.
        dimension: how many components; None: as few as leave at most ``error`` of the exemplars' energy (6.1: 1 %
            reconstruction error).
        error: fraction of ``sum |x - x_k|^2 / sum |x|^2``.
        weights: ``(M,)`` quadrature weights; None: equal.

    Returns:
        A :class:`Subspace`; fewer components where the exemplars span fewer.

    Example:
        >>> principal_subspace(torch.randn(20, 50), 3).basis.shape
        torch.Size([50, 3])
    """
    if exemplars.dim() != 2 or len(exemplars) == 0:
        raise ValueError(f"exemplars: expected (M, D) with M >= 1, got {tuple(exemplars.shape)}")
    if not torch.isfinite(exemplars).all():
        raise ValueError("exemplars: expected finite values, got NaN or infinity")
    share = (
        torch.full((len(exemplars),), 1 / len(exemplars), dtype=exemplars.dtype, device=exemplars.device)
        if weights is None
        else weights / weights.sum()
    )
    mean = share @ exemplars
    rows = (exemplars - mean) * share.sqrt()[:, None]
    wide = rows.double()
    gram = wide @ wide.T if len(rows) <= rows.shape[1] else wide.T @ wide
    values, vectors = torch.linalg.eigh(gram)
    values, vectors = values.flip(0).clamp_min(0), vectors.flip(1)
    significant = int((values > 1e-10 * values[0].clamp_min(1e-30)).sum())
    if dimension is None:
        total = (share @ exemplars.double().square().sum(1).to(share)).double()
        left = values.sum() - values.cumsum(0)
        dimension = int((left > error * total).sum()) + 1
    kept = max(0, min(dimension, significant))
    singular = values[:kept].sqrt()
    basis = vectors[:, :kept]
    if len(rows) <= rows.shape[1]:
        basis = (wide.T @ basis) / singular
    return Subspace(mean, basis.to(rows), singular.to(rows))


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distances ``(M, N)`` between rows ``(M, D)`` and ``(N, D)``, in their dtype: each is a difference of
    large numbers, which float32 would lose among near twins, and so is worked out in float64, by parts."""
    wide = a.double()
    return torch.cat([torch.cdist(wide, part.double()) for part in b.split(1024)], 1).to(a)


def principal_angles(a: Tensor, b: Tensor) -> Tensor:
    """Angles in degrees between two subspaces with orthonormal bases ``(D, k)``, smallest first."""
    cosine = torch.linalg.svdvals(a.double().T @ b.double()).clamp(-1, 1)
    return torch.rad2deg(torch.acos(cosine))


class IncrementalSubspace(LearnedModule):
    """A PCA subspace that grows image by image (Chandrasekaran et al. 1997): only images that it represents badly
    change it.

    Args:
        error: relative reconstruction error ``|x - x_k|^2 / |x|^2`` above which an image is significant.
        capacity: most dimensions to keep; the weakest go.

    Buffers: ``basis (D, k)`` and ``singular (k,)`` of the images seen (not centred, as in the paper), ``count ()``.
    Orthogonality ``|U^T U - I|`` is kept below 1e-5 by re-orthonormalising whenever it drifts.
    """

    basis: Tensor
    singular: Tensor
    count: Tensor

    def __init__(self, size: int, error: float = 0.01, capacity: int = 200) -> None:
        super().__init__()
        self.error, self.capacity = error, capacity
        self.register_buffer("basis", torch.zeros(size, 0, dtype=torch.float64))
        self.register_buffer("singular", torch.zeros(0, dtype=torch.float64))
        self.register_buffer("count", torch.tensor(0))

    def add(self, image: Tensor) -> bool:
        """Take one image ``(D,)`` in; says whether the subspace changed."""
        x = image.flatten().double()
        if x.shape[0] != self.basis.shape[0] or not torch.isfinite(x).all():
            raise ValueError(f"image: expected {self.basis.shape[0]} finite values, got {tuple(image.shape)}")
        self.count += 1
        inside = self.basis.T @ x
        left = x - self.basis @ inside
        left = left - self.basis @ (self.basis.T @ left)  # twice is enough
        length = torch.linalg.vector_norm(left)
        if length**2 <= self.error * x.square().sum() or length < 1e-12:
            return False
        middle = torch.diag(torch.cat((self.singular, self.singular.new_zeros(1))))
        middle[:, -1] = torch.cat((inside, length[None]))
        u, s, _ = torch.linalg.svd(middle)
        grown = torch.cat((self.basis, (left / length)[:, None]), 1) @ u
        self.basis, self.singular = grown[:, : self.capacity], s[: self.capacity]
        drift = (self.basis.T @ self.basis - torch.eye(self.basis.shape[1]).to(self.basis)).abs().max()
        if drift > 1e-6:
            q, r = torch.linalg.qr(self.basis * self.singular)
            u, s, _ = torch.linalg.svd(r)
            self.basis, self.singular = q @ u, s
        return True
