"""Where faces may be: the YuNet detector (Wu, Peng and Yu 2023) on padded, shrunken and turned copies of a photo."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.faces.copies import shrink
from facerelight.photo.networks import YUNET, network_path

__all__ = ["Candidate", "detect_faces", "merge_candidates"]

PAD = 0.2  # of the longer side, on every side: faces near the border
OVERLAP = 0.5  # of the smaller face's size, between the centres of two that are one


class Candidate(NamedTuple):
    """``points (5, 2)`` photo pixels: eye at image-left of the upright face, the other eye, nose, two mouth corners;
    ``score`` in 0..1."""

    points: np.ndarray
    score: float

    @property
    def landmarks(self) -> np.ndarray:
        """Eyes and the middle of the mouth corners, ``(3, 2)``."""
        return np.vstack((self.points[:2], self.points[3:].mean(0)))

    @property
    def size(self) -> float:
        """The larger of eye distance and distance from eyes to mouth, in pixels."""
        left, right, mouth = self.landmarks
        return float(max(np.hypot(*(right - left)), np.hypot(*(mouth - (left + right) / 2))))


def detect_faces(photo: np.ndarray, side: int, turn: float = 0.0, least: float = 0.5) -> list[Candidate]:
    """Candidates on one copy of the photo, best first.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        side: pixels of the copy's longer side; the network knows faces of 10 to 300 pixels.
        turn: degrees by which the copy is turned clockwise first; the points come back in the photo's pixels.
        least: score below which nothing is reported.

    Raises:
        RuntimeError: the network is missing, damaged or not readable by this OpenCV.
    """
    height, width = photo.shape[:2]
    small = shrink(photo, side)
    factor = np.array((width / small.shape[1], height / small.shape[0]))
    pad = int(PAD * max(small.shape[:2]))
    radians = np.deg2rad(turn)
    linear = np.array(((np.cos(radians), -np.sin(radians)), (np.sin(radians), np.cos(radians))))
    extent = np.abs(linear) @ small.shape[1::-1]
    size = tuple(int(n) for n in np.ceil(extent) + 2 * pad)
    middle = (np.array(small.shape[1::-1]) - 1) / 2
    shift = (np.array(size) - 1) / 2 - linear @ middle
    canvas = cv2.warpAffine(small, np.column_stack((linear, shift)), size, borderMode=cv2.BORDER_REPLICATE)
    network = _network()
    network.setInputSize(size)
    network.setScoreThreshold(least)
    _, found = network.detect(cv2.cvtColor(canvas, cv2.COLOR_RGB2BGR))
    candidates = []
    for row in () if found is None else found.astype(np.float64):
        points = (row[4:14].reshape(5, 2) - shift) @ linear
        if np.abs(points - middle).max() < 2 * max(size):  # on tiny pictures the network may overflow
            candidates.append(Candidate((points + 0.5) * factor - 0.5, float(row[14])))
    return sorted(candidates, key=lambda candidate: -candidate.score)


def merge_candidates(candidates: list[Candidate]) -> list[Candidate]:
    """One for each face, the best by score, best first."""
    kept: list[Candidate] = []
    for candidate in sorted(candidates, key=lambda one: -one.score):
        apart = [np.hypot(*(candidate.landmarks - other.landmarks).mean(0)) for other in kept]
        if all(far > OVERLAP * min(candidate.size, other.size) for far, other in zip(apart, kept, strict=True)):
            kept.append(candidate)
    return kept


@lru_cache(maxsize=1)
def _network() -> cv2.FaceDetectorYN:
    path = network_path(YUNET)
    try:
        return cv2.FaceDetectorYN.create(str(path), "", (320, 320), 0.5)
    except (cv2.error, AttributeError) as error:
        wanted = f"{path.name}: expected OpenCV 4.12 or newer to read it, got {cv2.__version__}"
        raise RuntimeError(f"{wanted}; pip install --upgrade 'opencv-contrib-python-headless>=4.12,<5'") from error
