"""Where eyes and mouth are: what is not skin on a face, and is lit by what surrounds it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window
from facerelight.photo.faces.head_pose import INNER_LIPS, LEFT_EYE, LIPS, RIGHT_EYE

__all__ = ["Features", "facial_features"]

LIDS = 0.06  # units by which the lids reach beyond the eye's opening
EYE, BALL, MOUTH, LIP = (
    (0.36, 0.2),
    (0.24, 0.1),
    (0.42, 0.12),
    (0.5, 0.25),
)  # half axes in units, where there are no dense points
EYES, MOUTH_CENTRE = ((-0.5, 0.0), (0.5, 0.0)), (0.0, -1.08)


class Features(NamedTuple):
    """Maps of a window's copy ``(h, w)``, 0 to 1: ``not_skin``, eyes with lids and the inside of the mouth;
    ``eyes_and_lips``; ``eyeballs``."""

    not_skin: np.ndarray
    eyes_and_lips: np.ndarray
    eyeballs: np.ndarray


def facial_features(points: np.ndarray | None, window: Window) -> Features:
    """Features from the dense ``points (468, 3)`` in pixels of the photograph; None: ellipses where an upright face has
    them."""
    draw = _ellipses(window) if points is None else _polygons(points, window)
    lids, balls, mouth, lips = draw
    return Features(np.maximum(lids, mouth), np.maximum(lids, lips), balls)


def _polygons(points: np.ndarray, window: Window) -> tuple[np.ndarray, ...]:
    height, width = window.size
    scale = width / (window.columns.stop - window.columns.start), height / (window.rows.stop - window.rows.start)
    places = (points[:, :2] - (window.columns.start, window.rows.start) + 0.5) * scale - 0.5

    def drawn(indices: Sequence[int], grow: float = 0.0) -> np.ndarray:
        shape: np.ndarray = np.zeros((height, width), np.float32)
        cv2.fillPoly(shape, [np.round(places[list(indices)] * 8).astype(np.int32)], 1.0, shift=3)
        if grow:
            side = 2 * max(1, int(grow * window.unit)) + 1
            shape = cv2.dilate(shape, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side)))
        return cv2.GaussianBlur(shape, (0, 0), max(0.6, 0.012 * window.unit))

    lids = np.maximum(drawn(RIGHT_EYE, LIDS), drawn(LEFT_EYE, LIDS))
    return lids, np.maximum(drawn(RIGHT_EYE), drawn(LEFT_EYE)), drawn(INNER_LIPS), drawn(LIPS)


def _ellipses(window: Window) -> tuple[np.ndarray, ...]:
    x, y = window.places()

    def drawn(centre: tuple[float, float], axes: tuple[float, float]) -> np.ndarray:
        return np.clip((1.15 - np.hypot((x - centre[0]) / axes[0], (y - centre[1]) / axes[1])) / 0.3, 0, 1).astype(
            np.float32
        )

    lids, balls = (np.maximum(*(drawn(eye, axes) for eye in EYES)) for axes in (EYE, BALL))
    return lids, balls, drawn(MOUTH_CENTRE, MOUTH), drawn(MOUTH_CENTRE, LIP)
