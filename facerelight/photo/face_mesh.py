"""468 points of a face in three dimensions: the Face Mesh network (Kartynnik et al. 2019), run by OpenCV on small crops."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.networks import FACE_MESH, network_path

__all__ = ["FaceMesh", "fit_face_mesh"]

SIZE = 192  # the network's input
ROUNDS = 2  # the second crop is cut by what the first one found
FIRST_SIDE = 1.5  # crop sides: in face heights, guessed from eyes and mouth ...
NEXT_SIDE = 1.5  # ... and in sides of the box of all points, as the network was trained
FACE_HEIGHT = 1.6  # of the larger of the eye distance times 1.5 and of eyes to mouth times 1.3
EYE_CORNERS = ((33, 133), (362, 263))  # at image-left, at image-right


class FaceMesh(NamedTuple):
    """``points (468, 3)`` float64, (x, y, z) in the photo's pixels, z away from the viewer; ``score``, the probability that a face is there."""

    points: np.ndarray
    score: float


def fit_face_mesh(photo: np.ndarray, landmarks: np.ndarray, mirror: np.ndarray) -> FaceMesh:
    """Fit the mesh to the face at ``landmarks``, twice: the second crop is cut by the points of the first; each pass once mirrored too.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        landmarks: ``(3, 2)``: eye at image-left of the upright face, the other eye, mouth; a rough guess is enough.
        mirror: ``(468,)``, the number of every point's mirror image.

    Raises:
        RuntimeError: the network is missing, damaged or not readable by this OpenCV.
    """
    left, right, mouth = np.asarray(landmarks, np.float64)
    eyes, across = (left + right) / 2, right - left
    down = np.array((-across[1], across[0])) / max(float(np.hypot(*across)), 1e-9)
    drop = float((mouth - eyes) @ down)
    side = FIRST_SIDE * FACE_HEIGHT * max(1.5 * float(np.hypot(*across)), 1.3 * drop)
    centre = eyes + 0.55 * drop * down
    mesh = FaceMesh(np.zeros((468, 3)), 0.0)
    for _ in range(ROUNDS):
        mesh = _both_ways(photo, centre, across, side, mirror)
        flat = mesh.points[:, :2]
        across = flat[list(EYE_CORNERS[1])].mean(0) - flat[list(EYE_CORNERS[0])].mean(0)
        axes = _axes(across)
        turned = flat @ axes.T
        centre = (turned.max(0) + turned.min(0)) / 2 @ axes
        side = NEXT_SIDE * float(np.ptp(turned, axis=0).max())
    return mesh


def _axes(across: np.ndarray) -> np.ndarray:
    """The face's own axes, unit vectors in rows: from eye to eye, and down."""
    x, y = across / max(float(np.hypot(*across)), 1e-9)
    return np.array(((x, y), (-y, x)))


def _both_ways(photo: np.ndarray, centre: np.ndarray, across: np.ndarray, side: float, mirror: np.ndarray) -> FaceMesh:
    """The mean of the network's points on a crop and on its mirror image."""
    axes, scale = _axes(across), SIZE / side
    middle = (SIZE - 1) / 2
    crop = cut(photo, scale * axes, middle - scale * axes @ centre)
    plain, score = _run(crop)
    other, other_score = _run(np.ascontiguousarray(crop[:, ::-1]))
    other = other[mirror] * (-1, 1, 1) + (SIZE - 1, 0, 0)
    points = (plain + other) / 2
    flat = (points[:, :2] - middle) / scale @ axes + centre
    return FaceMesh(np.column_stack((flat, points[:, 2] / scale)), (score + other_score) / 2)


def cut(photo: np.ndarray, linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """A square crop by ``crop = linear @ photo + shift``; border repeated; shrunk by area first, so that large faces do not alias."""
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
        raise RuntimeError(f"{path.name}: expected OpenCV 4.12 or newer to read it, got {cv2.__version__}; update opencv") from error
