"""One frame of a film as a photograph of its own: what it shows of the person is seen anew, what is known of the person
and of the light comes from the frames before it."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from facerelight.inference.methods import Method
from facerelight.photo.bust.frame import Window, compose, invert
from facerelight.photo.bust.matte import coarse_cover, sharpened_matte
from facerelight.photo.colour import most_channel
from facerelight.photo.face_model import FaceModel
from facerelight.photo.faces.landmarks import Face
from facerelight.photo.film.evidence import Evidence
from facerelight.photo.person import Person
from facerelight.photo.session import PhotoRelighter

__all__ = ["FilmFrame", "SteadyMatte"]

SIDE = 640  # pixels of the window's copy: a frame is seen for a moment
STILL = 0.12  # share of a new cover that counts where the picture stays as it was
SAME, OTHER = 2.0, 8.0  # grey levels by which a picture without noise stays, and by which another one is there
NOISE = 3.0  # pixels over which noise goes


class SteadyMatte:
    """The network's cover of the person, averaged over the frames before it where the picture stays as it was: where
    the network is in two minds, noise decides."""

    def __init__(self) -> None:
        self._before: tuple[np.ndarray, np.ndarray, Window] | None = None

    def __call__(self, image: np.ndarray, window: Window) -> np.ndarray:
        """The cover ``(h, w)`` of the next frame's copy as ``image (h, w, 3)`` uint8, before it is sharpened."""
        cover = coarse_cover(image, window)
        smooth: np.ndarray = cv2.GaussianBlur(image, (0, 0), NOISE).astype(np.float32)
        if self._before is not None:
            before, picture, place = self._before
            to_window = compose(invert(window.to_bust), place.to_bust)
            before, picture = (
                cv2.warpAffine(one, to_window, window.size[::-1], borderMode=cv2.BORDER_REPLICATE)
                for one in (before, picture)
            )
            differs = most_channel(np.abs(smooth - picture))
            moved = cv2.GaussianBlur(np.clip((differs - SAME) / (OTHER - SAME), 0, 1), (0, 0), NOISE)
            cover = before + np.clip(STILL + 2 * moved, 0, 1) * (cover - before)
        self._before = cover.astype(np.float32), smooth, window
        return self._before[0]


class _FramePerson(Person):
    coarse: SteadyMatte | None = None

    def _matte(self, image: np.ndarray) -> np.ndarray:
        if self.coarse is None:
            return super()._matte(image)
        return sharpened_matte(self.coarse_seen, image, self.window)

    def look(self, steady: SteadyMatte) -> None:
        """See where the person is; frames are looked at in their order."""
        self.coarse = steady
        self.coarse_seen = steady(np.round(self.copy * 255).astype(np.uint8), self.window)


class FilmFrame(PhotoRelighter):
    """A frame's session.

    Args:
        pixels: ``(H, W, 3)`` uint8 or uint16.
        face: where the face is, steady.
        evidence: of the face that is followed.
        steady: its matte.
        key: whether this frame is evidence, too; if not, one that is has to have come before it.
    """

    _person = _FramePerson
    _largest_side = SIDE
    person: _FramePerson

    def __init__(self, pixels: np.ndarray, face: Face, evidence: Evidence, steady: SteadyMatte, key: bool) -> None:
        self._evidence, self._key = evidence, key
        super().__init__(pixels, relighter=evidence.relighter, face=face)
        self.person.look(steady)

    def _conditioned(self, crops: list[Tensor], source_light: Tensor | None, method: Method) -> FaceModel:
        rotation = self._rotation
        assert rotation is not None
        if self._key or self._evidence.model is None:
            return self._evidence.add(crops[0], rotation)
        return self._evidence.model.posed(crops[0], rotation)

    @property
    def rotation(self) -> np.ndarray:
        """How the head is turned, ``(3, 3)``."""
        assert self._rotation is not None
        return self._rotation

    @property
    def bust_points(self) -> np.ndarray:
        """The face's dense points in bust coordinates, ``(468, 2)``."""
        assert self._points is not None
        return self._points[:, :2]
