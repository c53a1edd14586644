"""What the frames in which one face is followed say together of the person and of the light: a running posterior.

Frames in which the head is turned alike are observations of one image under one light, and their mean says as much as
all of them; other turns of the head are further inputs, each with its own light, as the thesis's several photographs
are. The photograph's own light stands still while a head turns, and is averaged over all.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from facerelight.inference.methods import Method
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo.face_model import FaceModel

__all__ = ["Evidence"]

APART = 8.0  # degrees: heads turned less apart show one image
VIEWS = 3
MEMORY = 16  # observations: older ones are forgotten, since people walk about and rooms change


class _View:
    def __init__(self, crop: Tensor, rotation: np.ndarray) -> None:
        self.crop, self.rotation, self.count = crop.clone(), rotation, 1
        self._mean = rotation

    def add(self, crop: Tensor, rotation: np.ndarray) -> None:
        self.count += 1
        self.crop += (crop - self.crop) / min(self.count, MEMORY)
        self._mean = self._mean + (rotation - self._mean) / min(self.count, MEMORY)
        left, _, right = np.linalg.svd(self._mean)  # of rotations less than APART from each other: no reflection
        self.rotation = left @ right


class Evidence:
    """Of one face that is followed.

    Args:
        relighter: the model.
        method: see :class:`facerelight.photo.PhotoRelighter`.
        source_light: ``(3,)`` where the light is known.
    """

    def __init__(
        self, relighter: StatisticalRelighter, method: Method = "expected", source_light: Tensor | None = None
    ) -> None:
        self.relighter, self.method, self.source_light = relighter, method, source_light
        self.views: list[_View] = []
        self.count = 0
        self.model: FaceModel | None = None
        self._towards: np.ndarray | None = None
        self._amounts: Tensor | None = None

    def add(self, crop: Tensor, rotation: np.ndarray) -> FaceModel:
        """What is known with one more frame, posed as the face is in it.

        Args:
            crop: ``(3, h, w)`` scene radiance.
            rotation: ``(3, 3)``, how the head is turned.
        """
        view = min(self.views, key=lambda one: angle_between(one.rotation, rotation), default=None)
        if view is None or angle_between(view.rotation, rotation) > APART:
            view = _View(crop, rotation)
            self.views = [view, *self.views][:VIEWS]
        else:
            view.add(crop, rotation)
            self.views = [view, *(one for one in self.views if one is not view)]
        crops = [one.crop for one in self.views]
        known = self.relighter, crops, self.source_light, self.method
        model = FaceModel(*known, view.rotation, self._towards)
        if self._towards is None:
            self._towards = model.towards.numpy().copy()
        self.count += 1
        if self._amounts is None:
            self._amounts = model.amounts
        else:
            self._amounts = self._amounts + (model.amounts - self._amounts) / min(self.count, MEMORY)
        if self.source_light is None:
            model.light = model.mixture(self._amounts)
        self.model = model
        return model.posed(crop, rotation)


def angle_between(one: np.ndarray, two: np.ndarray) -> float:
    """Degrees from a rotation ``(3, 3)`` to another."""
    cosine = (float(np.trace(one @ two.T)) - 1) / 2
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1, 1))))
