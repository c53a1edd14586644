"""468 points of a face in three dimensions: the Face Mesh network (Kartynnik et al. 2019), run on small crops."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.faces.copies import brighten
from facerelight.photo.networks import FACE_MESH, network_path

__all__ = ["FaceMesh", "fit_face_mesh"]

SIZE = 192  # the network's input
ROUNDS = 16  # at most, until the crop stays in place
NEAR_TURN, NEAR_SHIFT, NEAR_SCALE = 0.07, 0.03, 0.1  # radians, crop sides, logarithm: the crop stayed
FIRST_SIDE = 2.4  # crop sides: of the larger of the eye distance times 1.5 and of eyes to mouth times 1.3 ...
NEXT_SIDE = 1.5  # ... and of the box of all points, as the network was trained
EYE_CORNERS = ((33, 133), (362, 263))  # at image-left, at image-right


class FaceMesh(NamedTuple):
    """``points (468, 3)`` float64, (x, y, z) in the photo's pixels, z away from the viewer; ``score``, the probability
    that a face is there."""

    points: np.ndarray
    score: float


def fit_face_mesh(photo: np.ndarray, landmarks: np.ndarray, mirror: np.ndarray) -> FaceMesh:
    """Fit the mesh to the face at ``landmarks``: every crop is cut by the points of the one before, until it stays in
    place; the last ones are seen mirrored too, and averaged.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        landmarks: ``(3, 2)``: eye at image-left of the upright face, the other eye, mouth; a rough guess is enough.
        mirror: ``(468,)``, the number of every point's mirror image.

    Raises:
        RuntimeError: the network is missing, damaged or not readable by this OpenCV.
    """
    square = _guess(np.asarray(landmarks, np.float64))
    for _ in range(ROUNDS):
        before = square
        square = _around(_look(photo, before).points)
        if square.near(before):
            break
    plain, other = _look(photo, square), _look(photo, square, mirror)
    return FaceMesh((plain.points + other.points) / 2, (plain.score + other.score) / 2)


class _Square(NamedTuple):
    """A crop: its ``centre (2,)``, the direction ``across (2,)`` from eye to eye, of any length, and ``side``."""

    centre: np.ndarray
    across: np.ndarray
    side: float

    @property
    def axes(self) -> np.ndarray:
        """The face's own axes, unit vectors in rows: from eye to eye, and down."""
        x, y = self.across / max(float(np.hypot(*self.across)), 1e-9)
        return np.array(((x, y), (-y, x)))

    def near(self, other: _Square) -> bool:
        """Whether the network would see about the same."""
        turn = np.arctan2(*(other.axes @ self.axes[0])[::-1])
        moved = np.hypot(*(self.centre - other.centre)) / self.side
        return bool(abs(turn) < NEAR_TURN and moved < NEAR_SHIFT and abs(np.log(self.side / other.side)) < NEAR_SCALE)


def _guess(landmarks: np.ndarray) -> _Square:
    left, right, mouth = landmarks
    eyes, across = (left + right) / 2, right - left
    unit = max(float(np.hypot(*across)), 1e-9)
    down = np.array((-across[1], across[0])) / unit
    drop = float((mouth - eyes) @ down)
    return _Square(eyes + 0.55 * drop * down, across, FIRST_SIDE * max(1.5 * unit, 1.3 * drop))


def _around(points: np.ndarray) -> _Square:
    flat = points[:, :2]
    across = flat[list(EYE_CORNERS[1])].mean(0) - flat[list(EYE_CORNERS[0])].mean(0)
    square = _Square(flat.mean(0), across, 1.0)
    turned = flat @ square.axes.T
    low, high = turned.min(0), turned.max(0)
    return _Square((low + high) / 2 @ square.axes, across, NEXT_SIDE * float((high - low).max()))


def _look(photo: np.ndarray, square: _Square, mirror: np.ndarray | None = None) -> FaceMesh:
    """The network's points on one crop, or on its mirror image, in the photo's pixels."""
    scale, middle = SIZE / square.side, (SIZE - 1) / 2
    linear = scale * square.axes
    crop = brighten(cut(photo, linear, middle - linear @ square.centre))
    points, score = _run(crop if mirror is None else np.ascontiguousarray(crop[:, ::-1]))
    if mirror is not None:
        points = points[mirror] * (-1, 1, 1) + (SIZE - 1, 0, 0)
    flat = (points[:, :2] - middle) / scale @ square.axes + square.centre
    return FaceMesh(np.column_stack((flat, points[:, 2] / scale)), score)


def cut(photo: np.ndarray, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A square crop by ``crop = linear @ photo + shift``, border repeated; large faces are averaged down first."""
    inverse = np.linalg.inv(linear)
    corners = (np.array(((0, 0), (SIZE, 0), (0, SIZE), (SIZE, SIZE)), np.float64) - 0.5 - shift) @ inverse.T
    height, width = photo.shape[:2]
    x0, y0 = np.clip(np.floor(corners.min(0)).astype(int) - 2, 0, (width - 1, height - 1))
    x1, y1 = np.clip(np.ceil(corners.max(0)).astype(int) + 3, (x0 + 1, y0 + 1), (width, height))
    part = photo[y0:y1, x0:x1]
    shrink = np.sqrt(abs(np.linalg.det(linear)))
    factor = np.ones(2)
    if shrink < 0.5:
        small = np.maximum(np.round(np.array(part.shape[1::-1]) * shrink * 1.5).astype(int), 1)
        factor = np.array(part.shape[1::-1]) / small
        part = cv2.resize(part, tuple(int(n) for n in small), interpolation=cv2.INTER_AREA)
    # photo = (part + 0.5) * factor - 0.5 + (x0, y0)
    matrix = np.column_stack((linear * factor, linear @ (0.5 * factor - 0.5 + (x0, y0)) + shift))
    return cv2.warpAffine(part, matrix, (SIZE, SIZE), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _run(crop: np.ndarray) -> tuple[np.ndarray, float]:
    network = _network()
    network.setInput(cv2.dnn.blobFromImage(crop, 1 / 255.0))
    found = sorted((output.ravel() for output in network.forward(network.getUnconnectedOutLayersNames())), key=len)
    logit = float(np.clip(found[0][0], -50, 50))
    return found[-1].reshape(468, 3).astype(np.float64) - (0.5, 0.5, 0.0), 1 / (1 + float(np.exp(-logit)))


@lru_cache(maxsize=1)
def _network() -> cv2.dnn.Net:
    path = network_path(FACE_MESH)
    try:
        return cv2.dnn.readNetFromTFLite(str(path))
    except (cv2.error, AttributeError) as error:
        wanted = f"{path.name}: expected OpenCV 4.12 or newer to read it, got {cv2.__version__}"
        raise RuntimeError(f"{wanted}; pip install --upgrade 'opencv-contrib-python-headless>=4.12,<5'") from error
