"""Class-conditional densities (7.3, item 4): one Gaussian a person, low rank and noise, or a mixture of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from facerelight.recognition.classifier import Classifier, Reject
from facerelight.recognition.subspaces import Subspace, principal_subspace

__all__ = ["GaussianClassifier"]


class GaussianClassifier(Classifier):
    """The likeliest person, each a mixture of probabilistic principal component analysers (Tipping and Bishop 1999).

    A component is ``N(m, B diag(l) B^T + s I)``; its exemplars are found by k-means, its parameters in closed form.
    Where :class:`IndividualPCAClassifier` lets a probe lie anywhere in a person's subspace, here what is far from their
    exemplars is unlikely.

    Args:
        components: of each person's mixture; 1 is a single Gaussian. People with too few exemplars have fewer.
        dimension: directions of each component that vary beyond the noise.
        noise: variance of a pixel beyond the exemplars' own, in units of their mean square, for what they do not know
            of photographs.
        normalizer, shift: see :class:`Classifier`.
        reject: least score that is not a stranger, in nats a pixel; "fit" finds it; see :class:`Classifier`.

    Buffers: ``means (S, D)``, ``bases (S, D, k)``, ``spread (S, k)``, ``floor (S,)``, ``log_weight (S,)`` and
    ``owner (S,)`` of the S components of all people.

    Example:
        >>> images = torch.rand(12, 8, 8)
        >>> classifier = GaussianClassifier(dimension=2).fit(images, ["ann"] * 6 + ["bob"] * 6)
        >>> classifier.decision_function(images).shape
        torch.Size([12, 2])
    """

    means: Tensor
    bases: Tensor
    spread: Tensor
    floor: Tensor
    log_weight: Tensor
    owner: Tensor

    def __init__(
        self,
        components: int = 1,
        dimension: int = 9,
        noise: float = 8.0,
        normalizer: nn.Module | None = None,
        reject: Reject = None,
        shift: int = 0,
    ) -> None:
        super().__init__(normalizer, reject, shift)
        if components < 1 or dimension < 0 or noise <= 0:
            raise ValueError(
                f"expected components >= 1, dimension >= 0 and noise > 0, got {components}, {dimension} and {noise}"
            )
        self.components, self.dimension, self.noise = components, dimension, noise
        for name in ("means", "bases", "spread", "floor", "log_weight"):
            self.register_buffer(name, torch.zeros(0))
        self.register_buffer("owner", torch.zeros(0, dtype=torch.long))

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        unknown = self.noise * float(rows.square().mean().clamp_min(1e-12))
        parts: list[tuple[Subspace, float, float, int]] = []  # subspace, noise variance, share, person
        for person in range(int(index.max()) + 1):
            own = rows[index == person]
            cluster = _clusters(own, self.components)
            for k in cluster.unique().tolist():
                members = own[cluster == k]
                space = principal_subspace(members, self.dimension)
                left = (members - space.mean).square().sum() / len(members) - space.singular.square().sum()
                rest = max(rows.shape[1] - len(space.singular), 1)
                parts.append((space, unknown + max(float(left), 0.0) / rest, len(members) / len(own), person))
        width = max(len(space.singular) for space, *_ in parts)
        pad = nn.functional.pad
        self.means = torch.stack([space.mean for space, *_ in parts])
        self.bases = torch.stack([pad(space.basis, (0, width - space.basis.shape[1])) for space, *_ in parts])
        self.spread = torch.stack(
            [pad(space.singular.square(), (0, width - len(space.singular))) for space, *_ in parts]
        )
        self.floor = torch.tensor([noise for _, noise, _, _ in parts], dtype=rows.dtype).to(rows)
        self.log_weight = torch.tensor([share for _, _, share, _ in parts], dtype=rows.dtype).log().to(rows)
        self.owner = torch.tensor([person for *_, person in parts]).to(rows.device)

    def _scores(self, rows: Tensor) -> Tensor:
        """Log likelihood of ``rows (M, D)`` under each person, in nats a pixel, ``(M, C)``."""
        size, width = self.bases.shape[1:]
        # The noise divides a difference of large numbers.
        rows, means, bases = rows.double(), self.means.double(), self.bases.double()
        offset = torch.einsum("sdk,sd->sk", bases, means)
        inside = (torch.matmul(rows, bases).transpose(0, 1) - offset).square()  # (M, S, k)
        length = rows.square().sum(1, keepdim=True) - 2 * rows @ means.T + means.square().sum(1)
        outside = (length - inside.sum(-1)).clamp_min(0)
        floor = self.floor.double()
        variance = self.spread + floor[:, None]
        log_determinant = variance.log().sum(1) + (size - width) * floor.log()
        distance = outside / floor + (inside / variance).sum(-1)
        log_density = self.log_weight - 0.5 * (distance + log_determinant + size * math.log(2 * math.pi))
        assert self.classes_ is not None
        people = [log_density[:, self.owner == person].logsumexp(1) for person in range(len(self.classes_))]
        return (torch.stack(people, 1) / size).to(self.means)


def _clusters(rows: Tensor, count: int) -> Tensor:
    """k-means labels of ``rows (M, D)``; at least two members each, or one cluster of all."""
    if count == 1 or len(rows) < 2 * count:
        return torch.zeros(len(rows), dtype=torch.long, device=rows.device)
    from scipy.cluster.vq import kmeans2

    space = principal_subspace(rows, min(20, len(rows) - 1))
    projected = ((rows - space.mean) @ space.basis).double().numpy()
    labels = torch.from_numpy(kmeans2(projected, count, minit="++", seed=0)[1]).long()
    return labels if int(labels.bincount(minlength=count).min()) >= 2 else torch.zeros(len(rows), dtype=torch.long)
