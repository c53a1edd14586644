"""What all classifiers over exemplars share: modules with learned buffers in scikit-learn's manner, and their sum."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from typing import Any, Literal, Self

import torch
from torch import Tensor, nn

from facerelight.numerics.buffers import LearnedModule
from facerelight.numerics.checks import check_radiance

Reject = float | Literal["fit"] | None

__all__ = ["Classifier", "Reject", "SumClassifier"]


class Classifier(LearnedModule):
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
        self.dtype_ = torch.float32  # of the exemplars, in which they are compared
        self.size_: tuple[int, int] | None = None  # of the exemplars, height and width
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
        check_radiance(exemplars, "exemplars", "M H W")
        if len(exemplars) == 0:
            raise ValueError("exemplars: expected (M, H, W) with M >= 1, got none")
        if len(labels) != len(exemplars):
            raise ValueError(f"labels: expected one for each of {len(exemplars)} exemplars, got {len(labels)}")
        self.classes_ = sorted(set(labels), key=str)
        self.size_ = (exemplars.shape[1], exemplars.shape[2])
        place = {label: i for i, label in enumerate(self.classes_)}
        self.dtype_ = torch.promote_types(exemplars.dtype, torch.float32)
        index = torch.tensor([place[label] for label in labels]).to(exemplars.device)
        return self._rows(exemplars), index

    def _rows(self, images: Tensor) -> Tensor:
        """Normalised images as rows."""
        return self._flatten(self.normalizer(images.to(self.dtype_)))

    def get_extra_state(self) -> dict[str, object]:
        """What of the fitted classifier is no tensor: who is enrolled, the threshold, the images' size and dtype."""
        return {"classes": self.classes_, "threshold": self.threshold_, "size": self.size_, "dtype": self.dtype_}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """See :meth:`get_extra_state`."""
        self.classes_, self.threshold_ = state["classes"], state["threshold"]
        self.size_, self.dtype_ = state["size"], state["dtype"]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """``.double()`` and the like: probes are then converted, too."""
        self.dtype_ = fn(torch.zeros(0, dtype=self.dtype_)).dtype
        return super()._apply(fn, recurse)

    def _flatten(self, images: Tensor) -> Tensor:
        return images.flatten(1)

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        raise TypeError(f"{type(self).__name__} cannot be fitted")

    def _scores(self, rows: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__} cannot score")

    def decision_function(self, images: Tensor) -> Tensor:
        """Scores ``(M, C)`` of images ``(M, H, W)``, in their dtype, for each of ``classes_``; the highest wins."""
        if self.classes_ is None:
            raise RuntimeError(f"{type(self).__name__}: nothing is learned yet; call fit first")
        return self.compare(self.views(images)).to(images.dtype)

    def views(self, images: Tensor) -> Iterator[Tensor]:
        """``images (M, H, W)`` at every shift, normalised: the half of :meth:`decision_function` that does not depend
        on who is enrolled."""
        self._check(images)
        steps = range(-self.shift, self.shift + 1)
        images = images.to(self.dtype_)
        return (self.normalizer(moved(images, down, right)) for down in steps for right in steps)

    def view_key(self) -> Hashable:
        """Equal for classifiers whose :meth:`views` of the same images are the same, so that they can be shared."""
        modules = [(name, type(module), _settings(module)) for name, module in self.normalizer.named_modules()]
        tensors = [(name, value.numpy(force=True).tobytes()) for name, value in self.normalizer.state_dict().items()]
        return (type(self).views, self.shift, self.dtype_, self.size_, tuple(modules), tuple(tensors))

    def _check(self, images: Tensor) -> None:
        """Images ``(M, H, W)`` of the exemplars' size, in radiance."""
        size = (None, None) if self.size_ is None else self.size_
        check_radiance(images, "images", "M H W", size)

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
        """Rank-1 accuracy; one label an image."""
        if len(labels) != len(images):
            raise ValueError(f"labels: expected one for each of {len(images)} images, got {len(labels)}")
        right = [p == label for p, label in zip(self.predict(images), labels, strict=True)]
        return sum(right) / max(len(right), 1)

    def calibrate(self, images: Tensor, false_rejections: float = 0.05) -> Self:
        """Set ``threshold_`` so that this share of ``images``, new ones of enrolled people, is turned away."""
        if not len(images) or not 0 <= false_rejections <= 1:
            raise ValueError(
                f"calibrate: expected images and a share from 0 to 1, got {len(images)} and {false_rejections}"
            )
        best = self.decision_function(images).max(1).values
        self.threshold_ = float(best.quantile(false_rejections))
        return self


def _settings(module: nn.Module) -> tuple[tuple[str, object], ...]:
    """What a module was made with: values that can be compared as they are, other objects by their identity."""
    shown = {name: value for name, value in vars(module).items() if not name.startswith("_") and name != "training"}
    return tuple((name, value if _is_value(value) else id(value)) for name, value in sorted(shown.items()))


def _is_value(thing: object) -> bool:
    return isinstance(thing, Hashable) and type(thing).__eq__ is not object.__eq__


def moved(images: Tensor, down: int, right: int) -> Tensor:
    """``images (M, H, W)`` moved by whole pixels, their borders repeated."""
    if down == right == 0:
        return images
    height, width = images.shape[1:]
    rows = (torch.arange(height, device=images.device) - down).clamp(0, height - 1)
    columns = (torch.arange(width, device=images.device) - right).clamp(0, width - 1)
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

    def view_key(self) -> Hashable:
        """The first classifier's."""
        return self._member(0).view_key()

    def compare(self, views: Iterable[Tensor]) -> Tensor:
        """For classifiers that all have the first one's normaliser and shift."""
        shared = list(views)
        return torch.stack([weight * self._member(i).compare(shared) for i, weight in enumerate(self.weights)]).sum(0)

    def _member(self, index: int) -> Classifier:
        member = self.classifiers[index]
        assert isinstance(member, Classifier)
        return member
