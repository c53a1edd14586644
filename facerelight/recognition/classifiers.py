"""Classifiers over exemplars, as modules with learned buffers and scikit-learn's manner."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Literal, Self

import torch
from torch import Tensor, nn

from facerelight.recognition.subspaces import Subspace, principal_subspace

Reject = float | Literal["fit"] | None

__all__ = ["Classifier", "GlobalPCAClassifier", "IndividualPCAClassifier", "NearestNeighborClassifier", "SumClassifier"]


class Classifier(nn.Module):
    """What all share: ``fit``, ``decision_function`` (higher is likelier), ``predict``, ``score``, ``classes_``,
    rejection of strangers.

    Args:
        normalizer: photometric normalisation of exemplars and probes alike.
        reject: least score that is not a stranger; "fit": :meth:`fit` finds it, where held-out exemplars are turned
            away as often as other people's are let in.
        shift: a probe may lie off by so many pixels to every side: it is compared at all of them, and its best score
            for each person counts.
    """

    def __init__(self, normalizer: nn.Module | None = None, reject: Reject = None, shift: int = 0) -> None:
        super().__init__()
        if shift < 0:
            raise ValueError(f"shift: expected at least 0 pixels, got {shift}")
        if isinstance(reject, str) and reject != "fit":
            raise ValueError(f"reject: expected a score, 'fit' or None, got {reject!r}")
        self.normalizer = normalizer or nn.Identity()
        self.reject, self.shift = reject, shift
        self.classes_: list[Hashable] | None = None
        self.threshold_: float | None = None if reject == "fit" else reject

    def fit(self, exemplars: Tensor, labels: Sequence[Hashable]) -> Self:
        """Learn from ``exemplars (M, H, W)`` with one label each; fitting again starts afresh."""
        rows, index = self._prepare(exemplars, labels)
        if self.reject == "fit":
            self.threshold_ = self._equal_error_threshold(rows, index)
        self._learn(rows, index)
        return self

    def _equal_error_threshold(self, rows: Tensor, index: Tensor) -> float:
        """Learn from every other exemplar of each person; the rest, and their best scores for other people, say where
        strangers begin."""
        place = nn.functional.one_hot(index).cumsum(0).gather(1, index[:, None])[:, 0]  # 1, 2, ... within each person
        held_out = place % 2 == 0
        if int(index.bincount().min()) < 4 or int(index.max()) < 1:
            raise ValueError(
                "reject='fit': expected 4 exemplars or more of each of 2 people or more;"
                " give a score, or call calibrate()"
            )
        self._learn(rows[~held_out], index[~held_out])
        scores, own = self._scores(rows[held_out]), index[held_out][:, None]
        genuine = scores.gather(1, own)[:, 0]
        others = scores.scatter(1, own, -torch.inf).amax(1)
        values = torch.cat((genuine, others)).sort().values
        between = (values[1:] + values[:-1]) / 2
        gap = ((genuine[:, None] < between).float().mean(0) - (others[:, None] >= between).float().mean(0)).abs()
        return float(between[gap == gap.min()].median())

    def _prepare(self, exemplars: Tensor, labels: Sequence[Hashable]) -> tuple[Tensor, Tensor]:
        if exemplars.dim() != 3 or len(exemplars) == 0:
            raise ValueError(f"exemplars: expected (M, H, W) with M >= 1, got {tuple(exemplars.shape)}")
        if len(labels) != len(exemplars):
            raise ValueError(f"labels: expected one for each of {len(exemplars)} exemplars, got {len(labels)}")
        if not torch.isfinite(exemplars).all():
            raise ValueError("exemplars: expected finite values, got NaN or infinity")
        self.classes_ = sorted(set(labels), key=str)
        place = {label: i for i, label in enumerate(self.classes_)}
        return self._rows(exemplars), torch.tensor([place[label] for label in labels])

    def _rows(self, images: Tensor) -> Tensor:
        """Normalised images as rows."""
        return self._flatten(self.normalizer(images.float()))

    def _flatten(self, images: Tensor) -> Tensor:
        return images.flatten(1)

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        raise TypeError(f"{type(self).__name__} cannot be fitted")

    def _scores(self, rows: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__} cannot score")

    def decision_function(self, images: Tensor) -> Tensor:
        """Scores ``(M, C)`` of images ``(M, H, W)`` for each of ``classes_``; the highest wins."""
        if self.classes_ is None:
            raise RuntimeError(f"{type(self).__name__}: nothing is learned yet; call fit first")
        if images.dim() != 3 or not torch.isfinite(images).all():
            raise ValueError(f"images: expected finite (M, H, W), got {tuple(images.shape)}")
        return self.compare(self.views(images))

    def views(self, images: Tensor) -> Iterator[Tensor]:
        """``images (M, H, W)`` at every shift, normalised: the half of :meth:`decision_function` that does not depend
        on who is enrolled."""
        steps = range(-self.shift, self.shift + 1)
        return (self.normalizer(_moved(images.float(), down, right)) for down in steps for right in steps)

    def compare(self, views: Iterable[Tensor]) -> Tensor:
        """Scores ``(M, C)`` of what :meth:`views` gave; classifiers with the same normaliser and shift can share it."""
        return functools.reduce(torch.maximum, (self._scores(self._flatten(view)) for view in views))

    def predict(self, images: Tensor) -> list[Hashable | None]:
        """The label of each image; None where the best score lies below ``threshold_``."""
        scores = self.decision_function(images)
        assert self.classes_ is not None
        best = scores.max(1)
        known = best.values >= (-torch.inf if self.threshold_ is None else self.threshold_)
        return [self.classes_[i] if ok else None for i, ok in zip(best.indices.tolist(), known.tolist(), strict=True)]

    def score(self, images: Tensor, labels: Sequence[Hashable]) -> float:
        """Rank-1 accuracy."""
        right = [p == label for p, label in zip(self.predict(images), labels, strict=True)]
        return sum(right) / max(len(right), 1)

    def calibrate(self, images: Tensor, false_rejections: float = 0.05) -> Self:
        """Set ``threshold_`` so that this share of ``images``, new ones of enrolled people, is turned away."""
        best = self.decision_function(images).max(1).values
        self.threshold_ = float(best.quantile(false_rejections))
        return self


def _moved(images: Tensor, down: int, right: int) -> Tensor:
    """``images (M, H, W)`` moved by whole pixels, their borders repeated."""
    if down == right == 0:
        return images
    height, width = images.shape[1:]
    rows = (torch.arange(height) - down).clamp(0, height - 1)
    columns = (torch.arange(width) - right).clamp(0, width - 1)
    return images[:, rows][:, :, columns]


class SumClassifier(Classifier):
    """The sum of the scores of fitted classifiers over the same people (the sum rule of Kittler et al. 1998).

    A photograph is the one exemplar that is certainly right, and synthesised exemplars are the ones that know other
    lights: the sum of a nearest neighbour over photographs and individual subspaces over exemplars is better than
    either where the statistics are rendered.

    Args:
        classifiers: fitted; their own normalisation and shifts apply.
        weights: of their scores; default: 1 each.
        reject: least score that is not a stranger.
    """

    def __init__(
        self, classifiers: Sequence[Classifier], weights: Sequence[float] | None = None, reject: float | None = None
    ) -> None:
        super().__init__(reject=reject)
        if not classifiers or any(c.classes_ is None or c.classes_ != classifiers[0].classes_ for c in classifiers):
            raise ValueError(
                "classifiers: expected one or more, fitted to the same people; fit each with the same labels first"
            )
        if weights is not None and len(weights) != len(classifiers):
            raise ValueError(f"weights: expected one for each of {len(classifiers)} classifiers, got {len(weights)}")
        self.classifiers = nn.ModuleList(classifiers)
        self.weights = list(weights or [1.0] * len(classifiers))
        self.classes_ = classifiers[0].classes_

    def decision_function(self, images: Tensor) -> Tensor:
        """The weighted sum of the classifiers' scores, ``(M, C)``."""
        scores = [weight * self._member(i).decision_function(images) for i, weight in enumerate(self.weights)]
        return torch.stack(scores).sum(0)

    def views(self, images: Tensor) -> Iterator[Tensor]:
        """The first classifier's."""
        return self._member(0).views(images)

    def compare(self, views: Iterable[Tensor]) -> Tensor:
        """For classifiers that all have the first one's normaliser and shift."""
        shared = list(views)
        return torch.stack([weight * self._member(i).compare(shared) for i, weight in enumerate(self.weights)]).sum(0)

    def _member(self, index: int) -> Classifier:
        member = self.classifiers[index]
        assert isinstance(member, Classifier)
        return member


class NearestNeighborClassifier(Classifier):
    """The label of the nearest exemplar, or that of most of the nearest.

    Args:
        neighbors: how many vote; the nearest decides between people with as many votes.
        metric: "l2"; "cosine"; or "l0", the semi-norm of 6.1: how many pixels of a 16 x 16 thumbnail differ by more
            than ``threshold``.
        threshold: of "l0", in the images' units.
        normalizer, reject, shift: see :class:`Classifier`.
    """

    exemplars: Tensor
    index: Tensor

    def __init__(
        self,
        metric: str = "l2",
        threshold: float = 0.05,
        normalizer: nn.Module | None = None,
        reject: Reject = None,
        shift: int = 0,
        neighbors: int = 1,
    ) -> None:
        super().__init__(normalizer, reject, shift)
        if neighbors < 1:
            raise ValueError(f"neighbors: expected at least 1, got {neighbors}")
        self.neighbors = neighbors
        if metric not in ("l2", "cosine", "l0"):
            raise ValueError(f"metric: expected 'l2', 'cosine' or 'l0', got {metric!r}")
        self.metric, self.threshold = metric, threshold
        self.register_buffer("exemplars", torch.zeros(0, 0))
        self.register_buffer("index", torch.zeros(0, dtype=torch.long))

    def _flatten(self, images: Tensor) -> Tensor:
        if self.metric == "l0":
            return nn.functional.interpolate(images[:, None], (16, 16), mode="area")[:, 0].flatten(1)
        rows = images.flatten(1)
        return nn.functional.normalize(rows, dim=1) if self.metric == "cosine" else rows

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        self.exemplars, self.index = rows, index

    def _scores(self, rows: Tensor) -> Tensor:
        if self.metric == "l0":
            near = torch.stack([-((row - self.exemplars).abs() > self.threshold).sum(1).float() for row in rows])
        else:
            near = -torch.cdist(rows, self.exemplars).square() / rows.square().sum(1, keepdim=True).clamp_min(1e-12)
        assert self.classes_ is not None
        scores = torch.full((len(rows), len(self.classes_)), -torch.inf)
        scores = scores.scatter_reduce_(1, self.index.expand(len(rows), -1), near, "amax")
        if self.neighbors == 1:
            return scores
        nearest = near.topk(min(self.neighbors, near.shape[1]), dim=1).indices
        votes = torch.zeros_like(scores).scatter_add_(1, self.index[nearest], torch.ones(nearest.shape))
        return votes + 1 / (2 - scores)  # less than one vote, more for the nearer


class GlobalPCAClassifier(Classifier):
    """The nearest exemplar in one PCA subspace of all exemplars (6.1).

    Args:
        dimension: of the subspace; None: by 1 % reconstruction error.
        error: that error.
        normalizer, reject, shift: see :class:`Classifier`.
    """

    mean: Tensor
    basis: Tensor
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
        for name in ("mean", "basis", "projected"):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("index", torch.zeros(0, dtype=torch.long))

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        space = principal_subspace(rows, self.dimension, self.error)
        self.mean, self.basis, self.index = space.mean, space.basis, index
        self.projected = (rows - self.mean) @ self.basis

    def _scores(self, rows: Tensor) -> Tensor:
        near = -torch.cdist((rows - self.mean) @ self.basis, self.projected)
        assert self.classes_ is not None
        scores = torch.full((len(rows), len(self.classes_)), -torch.inf)
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
        rows = self._rows(exemplars)
        known = {} if self.classes_ is None else dict(zip(self.classes_, self._spaces(), strict=True))
        known[label] = principal_subspace(rows, self.dimension, self.error)
        return self.fit_subspaces(list(known.values()), list(known))

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
        self.dimensions = torch.tensor([space.basis.shape[1] for space in spaces])

    def reconstruction_error(self, images: Tensor) -> Tensor:
        """``|x - x_c|^2`` of images ``(M, H, W)`` in each person's subspace, ``(M, C)``."""
        if self.classes_ is None:
            raise RuntimeError("IndividualPCAClassifier: nothing is learned yet; call fit first")
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
