"""Find the three landmarks of the largest face in a photo: with what OpenCV ships, or with a better detector where one is installed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.alignment import CANONICAL_LANDMARKS
from facerelight.photo.networks import YUNET, network_path

__all__ = ["LandmarksNotFoundError", "find_landmarks"]

MAX_SIDE = 1024  # faces are searched at this size


class LandmarksNotFoundError(RuntimeError):
    """No face, or not both eyes, could be found."""


def find_landmarks(photo: np.ndarray, detector: Literal["auto", "haar", "yunet"] = "auto") -> Tensor:
    """Eye centre at image-left, eye centre at image-right and mouth centre of the largest face.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        detector: "haar", the cascades that OpenCV ships; "yunet" or "auto", a small network.

    Returns:
        ``(3, 2)`` float64 pixels (x, y).

    Raises:
        LandmarksNotFoundError: nothing was found; give the landmarks by hand.
        ValueError: an unknown detector.
    """
    scale = min(1.0, MAX_SIDE / max(photo.shape[:2]))
    small = cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else photo
    if detector not in ("auto", "haar", "yunet"):
        raise ValueError(f"detector: expected 'auto', 'haar' or 'yunet', got {detector!r}")
    points = _haar(small) if detector == "haar" else _yunet(small, network_path(YUNET))
    return torch.from_numpy((points + 0.5) / scale - 0.5)


def _yunet(image: np.ndarray, model: Path) -> np.ndarray:
    height, width = image.shape[:2]
    detector = cv2.FaceDetectorYN.create(str(model), "", (width, height), 0.6)
    _, faces = detector.detect(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if faces is None:
        raise LandmarksNotFoundError(_hint("no face"))
    face = max(faces, key=lambda f: f[2] * f[3])
    points = face[4:14].reshape(5, 2).astype(np.float64)  # eyes, nose, mouth corners
    eyes = points[:2][np.argsort(points[:2, 0])]
    return np.vstack((eyes, points[3:].mean(0)))


def _haar(image: np.ndarray) -> np.ndarray:
    grey = cv2.equalizeHist(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    least = max(24, min(grey.shape) // 12)
    faces = _cascade("haarcascade_frontalface_default.xml").detectMultiScale(grey, 1.05, 6, minSize=(least, least))
    if len(faces) == 0:
        raise LandmarksNotFoundError(_hint("no frontal face"))
    for face in sorted(faces, key=lambda f: -f[2]):
        points = _features(grey, face)
        if points is not None:
            return points
    raise LandmarksNotFoundError(_hint("a face, but not both of its eyes"))


def _features(grey: np.ndarray, face: Sequence[int]) -> np.ndarray | None:
    """Eyes and mouth inside a face box ``(x, y, side, side)``, or None where it has not two eyes where eyes should be."""
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
    mouths = _cascade("haarcascade_smile.xml").detectMultiScale(low, 1.05, 8, minSize=(side // 5, side // 10)) if low.size else ()
    centres = [np.array((max(x0, 0) + mx + mw / 2, max(y0, 0) + my_ + mh / 2)) for mx, my_, mw, mh in mouths]
    close = [c for c in centres if np.hypot(*(c - guess)) < 0.15 * side]
    mouth = guess if not close else (guess + 2 * np.median(close, axis=0)) / 3
    return np.stack((left, right, mouth))


def _cascade(name: str) -> cv2.CascadeClassifier:
    return cv2.CascadeClassifier(str(Path(cv2.__file__).parent / "data" / name))


def _hint(found: str) -> str:
    return f"landmarks: found {found}; give them by hand: eye at image-left, eye at image-right, mouth, as x,y pixels"
