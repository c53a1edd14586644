"""The nearest exemplar, or a vote of the nearest."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from facerelight.recognition.classifier import Classifier, Reject
from facerelight.recognition.subspaces import distances

__all__ = ["NearestNeighborClassifier"]


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
            near = torch.stack([-((row - self.exemplars).abs() > self.threshold).sum(1).to(rows) for row in rows])
        else:
            near = -distances(rows, self.exemplars).square() / rows.square().sum(1, keepdim=True).clamp_min(1e-12)
        assert self.classes_ is not None
        scores = rows.new_full((len(rows), len(self.classes_)), -torch.inf)
        scores = scores.scatter_reduce_(1, self.index.expand(len(rows), -1), near, "amax")
        if self.neighbors == 1:
            return scores
        nearest = near.topk(min(self.neighbors, near.shape[1]), dim=1).indices
        votes = torch.zeros_like(scores).scatter_add_(
            1, self.index[nearest], torch.ones_like(near[:, : nearest.shape[1]])
        )
        return votes + 1 / (2 - scores)  # less than one vote, more for the nearer
