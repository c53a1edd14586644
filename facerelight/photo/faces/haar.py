"""Landmarks with what OpenCV ships, where a network cannot be read: Haar cascades (Viola and Jones 2001)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from facerelight.geometry.alignment import CANONICAL_LANDMARKS

__all__ = ["haar_landmarks"]


def haar_landmarks(photo: np.ndarray) -> list[np.ndarray]:
    """``(3, 2)`` landmarks of every upright, frontal face that has both its eyes, the largest first.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB, of about 1000 pixels at most.
    """
    grey = cv2.equalizeHist(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
    least = max(24, min(grey.shape) // 12)
    faces = _cascade("haarcascade_frontalface_default.xml").detectMultiScale(grey, 1.05, 6, minSize=(least, least))
    found = (_features(grey, face) for face in sorted(faces, key=lambda face: -face[2]))
    return [points for points in found if points is not None]


def _features(grey: np.ndarray, face: Sequence[int]) -> np.ndarray | None:
    """Eyes and mouth inside a face box ``(x, y, side, side)``; None where it has no two eyes where they should be."""
    x, y, side, _ = (int(v) for v in face)
    size = (side // 8, side // 8), (side // 3, side // 3)
    top = grey[y : y + int(0.6 * side), x : x + side]
    eyes = [
        (x + ex + ew / 2, y + ey + eh / 2)
        for name in ("haarcascade_eye.xml", "haarcascade_eye_tree_eyeglasses.xml")
        for ex, ey, ew, eh in _cascade(name).detectMultiScale(top, 1.03, 4, minSize=size[0], maxSize=size[1])
    ]
    expected = np.array(((x + 0.3 * side, y + 0.38 * side), (x + 0.7 * side, y + 0.38 * side)))
    found = []
    for place in expected:
        near = [e for e in eyes if np.hypot(*(np.array(e) - place)) < 0.15 * side]
        if not near:
            return None
        found.append(np.median(near, axis=0))
    left, right = found
    across = right - left
    down = np.array((-across[1], across[0]))
    (ex0, ey0), (ex1, _), (_, my) = CANONICAL_LANDMARKS
    guess = (left + right) / 2 + down * (my - ey0) / (ex1 - ex0)
    x0, x1 = int(left[0] - 0.2 * side), int(right[0] + 0.2 * side)
    y0 = int((left[1] + right[1]) / 2 + 0.25 * side)
    low = grey[max(y0, 0) : y0 + int(0.6 * side), max(x0, 0) : x1]
    smiles, least = _cascade("haarcascade_smile.xml"), (side // 5, side // 10)
    mouths = smiles.detectMultiScale(low, 1.05, 8, minSize=least) if low.size else ()
    centres = [np.array((max(x0, 0) + mx + mw / 2, max(y0, 0) + my_ + mh / 2)) for mx, my_, mw, mh in mouths]
    close = [c for c in centres if np.hypot(*(c - guess)) < 0.15 * side]
    mouth = guess if not close else (guess + 2 * np.median(close, axis=0)) / 3
    return np.stack((left, right, mouth))


def _cascade(name: str) -> cv2.CascadeClassifier:
    return cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / name))
