"""What a head is, whoever it comes from.

Every head comes in the same units: y up, +z to the viewer, the origin midway between the eye centres and the eyes one
unit apart.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

try:
    import trimesh
except ModuleNotFoundError as error:
    raise RuntimeError('heads need trimesh, which is not installed; pip install "facerelight[train]"') from error

__all__ = ["Head", "HeadSource", "normalise"]


class Head(NamedTuple):
    """A head mesh.

    ``vertices (V, 3)``; ``triangles (T, 3)``; ``reference (V, 3)``, where each vertex lies on the average head (paint
    follows it); ``is_eye (V,)`` 1 on eyeballs, -1 where hair hangs free of the head; ``landmarks (3, 3)``: eye centre
    at image-left, at image-right, mouth centre.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    reference: np.ndarray
    is_eye: np.ndarray
    landmarks: np.ndarray

    def normals(self) -> np.ndarray:
        """Smooth vertex normals ``(V, 3)``."""
        return np.array(trimesh.Trimesh(self.vertices, self.triangles, process=False).vertex_normals, np.float32)


class HeadSource(Protocol):
    """Something that gives head number ``index``, the same one every time."""

    def head(self, index: int) -> Head: ...


def normalise(vertices: np.ndarray, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """To the units of this module, without turning: eyes one unit apart, origin midway."""
    origin = landmarks[:2].mean(0)
    scale = np.linalg.norm(landmarks[1] - landmarks[0])
    return (vertices - origin) / scale, (landmarks - origin) / scale
