"""What a photograph shows of a person, as maps of the window's copy, and how all of them follows a new light: eyes
mirror the room, dark hair keeps its depth, outlines do not glow, and the picture is exposed for the lit skin."""

from __future__ import annotations

from functools import cached_property

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window, smooth_step
from facerelight.photo.bust.matte import ground_behind, person_matte
from facerelight.photo.colour import LUMA, SkinColour
from facerelight.photo.faces.features import Features, facial_features
from facerelight.photo.ratio import surely_another
from facerelight.photo.skin import skin_colour
from facerelight.photo.stages import StageLog

__all__ = ["Person"]

EXPOSED = 0.85  # quantile of skin luminance that a new light is exposed for
# a dark photograph's lit side is exposed up by so much, in log; one as bright as the second not at all
LIFT, ROOM = 0.35, 0.9
WHITE = 0.98  # quantile of the window's luminance that is its white
DARKER, BRIGHTER = -0.5, 0.8  # the most by which exposure goes with it, in log
EYEBALL = 0.15  # of a log ratio that wet eyes do not follow: they mirror the room
OUTLINE = 1.1  # of the face's oval, inside which skin is the face's
FEW = 50  # pixels of skin, fewer are not exposed for
RIM = 0.015  # units, how wide an outline is
HELD = 0.45  # of a brightening is kept from beard, brows and fringe: they are not to turn into a veil
FULL_FACE = 0.7  # of the face's outline: a picture that ends inside it shows nothing else


class Person:
    """The person around one face; each map is made when it is first asked for.

    Args:
        copy: ``(h, w, 3)`` the window's copy, sRGB in 0..1.
        scene: ``(h, w, 3)`` its radiance.
        window: the window.
        points: the face's dense points ``(468, 3)`` in pixels of the photograph, or None.
        mask: ``(H, W)`` of the model's crop, where the face's skin is sure.
        log: takes what is done and what is not.
        exhaustive: look for a matte even where the face fills the picture.
    """

    def __init__(
        self,
        copy: np.ndarray,
        scene: np.ndarray,
        window: Window,
        points: np.ndarray | None,
        mask: np.ndarray,
        log: StageLog,
        exhaustive: bool = False,
    ) -> None:
        self.copy, self.scene, self.window, self.points, self.mask = copy, scene, window, points, mask
        self._log, self._exhaustive = log, exhaustive

    @cached_property
    def oval(self) -> np.ndarray:
        """Distance from the face's middle in units of its outline, ``(h, w)``."""
        return self.window.from_crop(self.window.crop.oval().numpy(), outside=9.0)

    @cached_property
    def features(self) -> Features:
        """Eyes and mouth."""
        return facial_features(self.points, self.window)

    @cached_property
    def cover(self) -> np.ndarray:
        """The matte, ``(h, w)``; the face itself is covered."""
        if not self._exhaustive and float(self.oval.max()) < FULL_FACE:
            self._log.skip("matte", "the face fills the picture")
            return np.ones(self.window.size, np.float32)
        with self._log.measure("matte", "the picture shows more than the face"):
            matte = self._matte(np.round(self.copy * 255).astype(np.uint8))
            face = np.clip((1 - self.oval) / 0.3, 0, 1)
            cover = np.maximum(matte, smooth_step(face) * (matte > 0.05)) * self.window.fade()
            return cover.astype(np.float32)

    def _matte(self, image: np.ndarray) -> np.ndarray:
        """Of the copy as ``image (h, w, 3)`` uint8."""
        return person_matte(image, self.window)

    @cached_property
    def ground(self) -> np.ndarray:
        """Radiance of what is behind the person, ``(h, w, 3)``."""
        return ground_behind(self.scene, self.cover, self.window.unit)

    @cached_property
    def skin(self) -> SkinColour:
        """Where skin is, and what colour."""
        with self._log.measure("skin", "highlights and shade have their own colour"):
            face = self.window.from_crop(self.mask, outside=0.0).clip(0, 1)
            return skin_colour(self.scene, face, self.oval, self.features.eyes_and_lips, self.cover, self.window)

    def expose(self, log_ratio: np.ndarray) -> tuple[float, float]:
        """How much brighter the picture under the light's ``log_ratio (h, w, C)`` is exposed, in log, and how surely
        the light is another, 0 to 1."""
        log_ratio = self._seen(log_ratio)
        change = self._change(log_ratio)
        return self._exposure(log_ratio, change), change

    def follow(self, log_ratio: np.ndarray, exposure: float) -> np.ndarray:
        """What becomes of the light's ``log_ratio (h, w, C)`` on this person, brighter by ``exposure``."""
        log_ratio = self._seen(log_ratio) + exposure
        return np.where(log_ratio > 0, self.brightened[..., None] * log_ratio, log_ratio).astype(np.float32)

    def _seen(self, log_ratio: np.ndarray) -> np.ndarray:
        return log_ratio * (1 - EYEBALL * self.features.eyeballs[..., None])

    @cached_property
    def brightened(self) -> np.ndarray:
        """How much of a brightening is let through, ``(h, w)``: less on beard, brows and fringe, and nothing on the
        person's outline, which would glow."""
        inside = cv2.GaussianBlur(self.cover, (0, 0), max(RIM * self.window.unit, 0.5))
        return (1 - HELD * self.skin.pigment) * np.clip((inside - 0.55) / 0.35, 0, 1)

    @cached_property
    def sure_skin(self) -> np.ndarray:
        """``(h, w)`` bool: what the picture is exposed for, the face where enough of it is seen."""
        skin = self.skin.skin * self.cover > 0.6
        face = skin & (self.oval < OUTLINE)
        return face if face.sum() >= FEW else skin

    def _change(self, log_ratio: np.ndarray) -> float:
        """How surely the light is another, 0 to 1: what varies over the skin."""
        skin = self.sure_skin
        variance = float(np.var(log_ratio.mean(-1)[skin])) if skin.any() else 0.0
        return surely_another(variance)

    def _exposure(self, log_ratio: np.ndarray, change: float) -> float:
        """How much brighter to expose, in log: the lit side of the skin stays as bright as it was, brighter where there
        is room."""
        luminance, skin = self.scene @ LUMA, self.sure_skin
        if skin.sum() < FEW:
            return 0.0
        relit = luminance * np.exp(log_ratio.mean(-1))
        before, after = (max(float(np.quantile(values[skin], EXPOSED)), 1e-4) for values in (luminance, relit))
        white = float(np.quantile(luminance, WHITE))  # dark skin in a well exposed picture is to stay dark
        lift = LIFT * change * max(1 - max(before, 0.5 * white) / ROOM, 0.0)
        return float(np.clip(np.log(before / after) + lift, DARKER, BRIGHTER))
