"""What a gallery needs of a recogniser: a template of an enrolled face, a description of a probe, and an index."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from facerelight.photo.faces.landmarks import Face

__all__ = ["Index", "Levels", "Recognizer", "Template"]

Template = dict[str, Tensor]
"""What is kept of enrolled faces: tensors by name, whose first dimension counts the faces."""


class Levels(NamedTuple):
    """Scores on other people than those enrolled, learned once: ``mean`` and ``std`` of scores between different
    people, and the logistic ``slope`` and ``intercept`` that turn a score, in such standard deviations above the mean,
    into the probability that two photographs are of one person, where one pair in two is."""

    mean: float
    std: float
    slope: float
    intercept: float


class Index(Protocol):
    """Templates arranged for search."""

    def search(self, probe: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Scores, best first, and numbers of the ``count`` best templates, or of all where there are fewer."""
        ...


class Recognizer(Protocol):
    """How faces are told apart.

    ``name``: as the command line calls it; ``levels``: see :class:`Levels`; ``personal``: whether some templates are
    more easily mistaken for strangers than others, so that each is held to its own level.
    """

    name: str
    levels: Levels
    personal: bool

    def key(self) -> dict[str, object]:
        """What its templates depend on: model, crop, version. Templates of another key are refused."""
        ...

    def describe(self, photo: np.ndarray, face: Face) -> Tensor:
        """A probe: the ``face`` of a ``photo (H, W, 3)`` uint8 sRGB."""
        ...

    def enroll(self, photo: np.ndarray, face: Face) -> Template:
        """A template of one face, ``(1, ...)`` each; its part "probe" is what :meth:`describe` says of it."""
        ...

    def index(self, templates: Template, owners: Tensor) -> Index:
        """Templates arranged for search; ``owners (M,)`` are numbers that say whose they are."""
        ...
