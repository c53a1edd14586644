"""Principal components: one subspace of everybody, or one a person (6.1)."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Self

import torch
from torch import Tensor, nn

from facerelight.numerics.checks import check_radiance
from facerelight.recognition.classifier import Classifier, Reject
from facerelight.recognition.subspaces import IncrementalSubspace, Subspace, distances, principal_subspace

__all__ = ["GlobalPCAClassifier", "IndividualPCAClassifier"]


class GlobalPCAClassifier(Classifier):
    """The nearest exemplar in one PCA subspace of all exemplars (6.1), which more people can join one by one.

    Args:
        dimension: of the subspace; None: by 1 % reconstruction error.
        error: that error.
        normalizer, reject, shift: see :class:`Classifier`.
    """

    mean: Tensor
    basis: Tensor
    singular: Tensor
    projected: Tensor
    index: Tensor

    def __init__(
        self,
        dimension: int | None = 40,
        error: float = 0.01,
        normalizer: nn.Module | None = None,
        reject: Reject = None,
        shift: int = 0,
    ) -> None:
        super().__init__(normalizer, reject, shift)
        self.dimension, self.error = dimension, error
        for name in ("mean", "basis", "singular", "projected"):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("index", torch.zeros(0, dtype=torch.long))

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        space = principal_subspace(rows, self.dimension, self.error)
        self.mean, self.basis, self.index = space.mean, space.basis, index
        self.singular = space.singular * len(rows) ** 0.5  # of the exemplars themselves
        self.projected = (rows - self.mean) @ self.basis

    def partial_fit(self, exemplars: Tensor, label: Hashable) -> Self:
        """Add exemplars ``(M, H, W)`` of one person, new or known, where the others' are no longer at hand: only those
        that the subspace represents badly change it (Chandrasekaran et al. 1997); the mean stays that of :meth:`fit`.

        Raises:
            RuntimeError: nothing is learned yet.
            ValueError: exemplars of another size, or none.
        """
        if self.classes_ is None:
            raise RuntimeError("GlobalPCAClassifier: nothing is learned yet; call fit first")
        self._check(exemplars)
        if not len(exemplars):
            raise ValueError("exemplars: expected (M, H, W) with M >= 1, got none")
        rows = self._rows(exemplars) - self.mean
        space = IncrementalSubspace(rows.shape[1], self.error, self.dimension or 200)
        space.basis, space.singular = self.basis.double(), self.singular.double()
        for row in rows:
            space.add(row)
        turn = space.basis.to(self.basis).T @ self.basis  # what was projected, seen in the new basis
        self.basis, self.singular = space.basis.to(self.basis), space.singular.to(self.basis)
        self.projected = torch.cat((self.projected @ turn.T, rows @ self.basis))
        owners = [self.classes_[i] for i in self.index.tolist()] + [label] * len(rows)
        self.classes_ = sorted(set(owners), key=str)
        self.index = torch.tensor([self.classes_.index(owner) for owner in owners]).to(rows.device)
        return self

    def _scores(self, rows: Tensor) -> Tensor:
        near = -distances((rows - self.mean) @ self.basis, self.projected)
        assert self.classes_ is not None
        scores = rows.new_full((len(rows), len(self.classes_)), -torch.inf)
        return scores.scatter_reduce_(1, self.index.expand(len(rows), -1), near, "amax")


class IndividualPCAClassifier(Classifier):
    """One PCA subspace a person; the smallest reconstruction error wins (6.1).

    Memory is linear in people and does not depend on how many exemplars there were.

    Args:
        dimension: of each subspace; None: as few as leave 1 % of the energy, 35 to 45 in the thesis.
        error: that error.
        metric: "error", the reconstruction error (6.1); or "cosine", between a probe and the person's mean, both
            outside the person's subspace. The cosine takes the mean at the strength that the probe shows it with, and
            measures what is left by what the subspace leaves of the probe, so people enrolled from bright and from
            nearly black photographs can be compared.
        normalizer, shift: see :class:`Classifier`.
        reject: least score (minus relative reconstruction error; for "cosine" the cosine) that is not a stranger; see
            :meth:`Classifier.calibrate`.

    Buffers: ``means (C, D)``, ``bases (C, D, k)`` zero-padded to one k, ``offsets (C, k)`` of the means in them,
    ``dimensions (C,)``.

    Example:
        >>> images = torch.rand(12, 8, 8)
        >>> classifier = IndividualPCAClassifier(dimension=2).fit(images, ["ann"] * 6 + ["bob"] * 6)
        >>> classifier.reconstruction_error(images).shape
        torch.Size([12, 2])
    """

    means: Tensor
    bases: Tensor
    offsets: Tensor
    dimensions: Tensor

    def __init__(
        self,
        dimension: int | None = None,
        error: float = 0.01,
        normalizer: nn.Module | None = None,
        reject: Reject = None,
        shift: int = 0,
        metric: str = "error",
    ) -> None:
        super().__init__(normalizer, reject, shift)
        if dimension is not None and dimension < 0:
            raise ValueError(f"dimension: expected at least 0, got {dimension}")
        if metric not in ("error", "cosine"):
            raise ValueError(f"metric: expected 'error' or 'cosine', got {metric!r}")
        self.dimension, self.error, self.metric = dimension, error, metric
        for name in ("means", "bases", "offsets"):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("dimensions", torch.zeros(0, dtype=torch.long))

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        spaces = [principal_subspace(rows[index == c], self.dimension, self.error) for c in range(int(index.max()) + 1)]
        self._keep(spaces)

    def fit_subspaces(self, spaces: Sequence[Subspace], labels: Sequence[Hashable]) -> Self:
        """Take ready-made subspaces, one a person (of :func:`direct_subspace`, say), instead of exemplars."""
        if len(spaces) == 0 or len(spaces) != len(labels) or len(set(labels)) != len(labels):
            raise ValueError(
                f"labels: expected a different one for each of {len(spaces)} subspaces, got {len(set(labels))}"
            )
        order = sorted(range(len(labels)), key=lambda i: str(labels[i]))
        self.classes_ = [labels[i] for i in order]
        self._keep([spaces[i] for i in order])
        return self

    def partial_fit(self, exemplars: Tensor, label: Hashable) -> Self:
        """Add one person, or replace them, without touching the others."""
        check_radiance(exemplars, "exemplars", "M H W", self.size_ or (None, None))
        if self.classes_ is None:
            self.dtype_ = torch.promote_types(exemplars.dtype, torch.float32)
        rows = self._rows(exemplars)
        known = {} if self.classes_ is None else dict(zip(self.classes_, self._spaces(), strict=True))
        known[label] = principal_subspace(rows, self.dimension, self.error)
        self.fit_subspaces(list(known.values()), list(known))
        self.size_ = (exemplars.shape[1], exemplars.shape[2])
        return self

    def _spaces(self) -> list[Subspace]:
        sizes = self.dimensions.tolist()
        return [Subspace(m, b[:, :k], torch.ones(k)) for m, b, k in zip(self.means, self.bases, sizes, strict=True)]

    def _keep(self, spaces: Sequence[Subspace]) -> None:
        widest = max(space.basis.shape[1] for space in spaces)
        self.means = torch.stack([space.mean for space in spaces])
        self.bases = torch.stack(
            [nn.functional.pad(space.basis, (0, widest - space.basis.shape[1])) for space in spaces]
        )
        self.offsets = torch.einsum("cdk,cd->ck", self.bases, self.means)
        self.dimensions = torch.tensor([space.basis.shape[1] for space in spaces]).to(self.means.device)

    def reconstruction_error(self, images: Tensor) -> Tensor:
        """``|x - x_c|^2`` of images ``(M, H, W)`` in each person's subspace, ``(M, C)``."""
        if self.classes_ is None:
            raise RuntimeError("IndividualPCAClassifier: nothing is learned yet; call fit first")
        self._check(images)
        return self._errors(self._rows(images))

    def _errors(self, rows: Tensor) -> Tensor:
        """``|x - m|^2 - |B^T (x - m)|^2``; the bases are read once, where they lie."""
        inside = torch.matmul(rows, self.bases).transpose(0, 1) - self.offsets  # (M, C, k)
        outside = rows.square().sum(1, keepdim=True) - 2 * rows @ self.means.T + self.means.square().sum(1)
        return (outside - inside.square().sum(-1)).clamp_min(0)

    def _cosines(self, rows: Tensor) -> Tensor:
        """``cos(x - B B^T x, m - B B^T m)``; 0 where the subspace leaves nothing of either."""
        inside = torch.matmul(rows, self.bases).transpose(0, 1)  # (M, C, k)
        together = rows @ self.means.T - (inside * self.offsets).sum(-1)
        probe = rows.square().sum(1, keepdim=True) - inside.square().sum(-1)
        person = self.means.square().sum(1) - self.offsets.square().sum(1)
        return together / (probe.clamp_min(1e-12) * person.clamp_min(1e-12)).sqrt()

    def _scores(self, rows: Tensor) -> Tensor:
        if self.metric == "cosine":
            return self._cosines(rows)
        return -self._errors(rows) / rows.square().sum(1, keepdim=True).clamp_min(1e-12)
