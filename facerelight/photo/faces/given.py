"""Which face of a photograph is meant: one that was found, one marked by hand, or the best one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from facerelight.photo.faces.landmarks import Face, LandmarksNotFoundError, face_at, find_faces
from facerelight.photo.files.pixels import as_bytes

__all__ = ["Landmarks", "check_landmarks", "locate_face"]

Landmarks = Tensor | np.ndarray | Sequence[Sequence[float]]
LEAST_SCORE = 0.5  # of the mesh network: below it there are no dense points where the landmarks were given


def locate_face(pixels: np.ndarray, landmarks: Landmarks | None, face: Face | None) -> tuple[Face, int]:
    """The face that is meant: the one given, the one at ``landmarks``, or the best one found; and of how many."""
    if face is not None:
        return face, 1
    if landmarks is not None:
        points = np.asarray(landmarks, dtype=np.float64)
        check_landmarks(points, pixels.shape)
        found = face_at(as_bytes(pixels), points)
        return found if found.mesh_score >= LEAST_SCORE else found._replace(points=None, pose=None), 1
    faces = find_faces(as_bytes(pixels))
    if not faces:
        raise LandmarksNotFoundError(
            "landmarks: found no face; give them by hand: eye at image-left, eye at image-right, mouth, as x,y pixels"
        )
    return faces[0], len(faces)


def check_landmarks(landmarks: np.ndarray, shape: tuple[int, ...]) -> Tensor:
    points = torch.as_tensor(np.asarray(landmarks, dtype=np.float64))
    if points.shape != (3, 2):
        raise ValueError(f"landmarks: expected three (x, y) pairs, got shape {tuple(points.shape)}")
    if not torch.isfinite(points).all():
        raise ValueError("landmarks: expected finite pixel coordinates, got NaN or infinity")
    height, width = shape[:2]
    inside = (points >= -0.5).all() and (points[:, 0] <= width - 0.5).all() and (points[:, 1] <= height - 0.5).all()
    if not inside:
        raise ValueError(f"landmarks: expected pixels inside the {width} x {height} photo, got {points.tolist()}")
    across, down = points[1] - points[0], points[2] - points[:2].mean(0)
    distance = float(torch.linalg.vector_norm(across))
    if distance == 0:
        raise ValueError("landmarks: expected two different eyes, got the same point twice")
    # in the face's own frame: how far the mouth lies below the eyes, in eye distances, and how far aside
    below = float(across[0] * down[1] - across[1] * down[0]) / distance**2
    aside = float(across @ down) / distance**2
    if abs(below) > 1e-2 and (below < 0.3 or below > 4 or abs(aside) > 1.5):
        hint = "are the eyes swapped?" if below < 0 else "is the mouth in its place?"
        raise ValueError(
            "landmarks: expected eye at image-left, eye at image-right, and the mouth below them,"
            f" got {points.tolist()}; {hint}"
        )
    return points
