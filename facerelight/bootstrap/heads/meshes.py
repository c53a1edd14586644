"""Heads of the user's own: meshes with marked points, brought to the units of :mod:`head`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

from facerelight.bootstrap.heads.head import Head

__all__ = ["MeshFolder", "apply_similarity", "fit_similarity_3d"]


class MeshFolder:
    """Meshes of the user's own (.obj, .ply, .glb), each with marked points in ``NAME.points.txt``: one ``x y z`` a
    line, three or more.

    The first three points are the eye centre at image-left, the one at image-right and the mouth centre; further ones
    (the thesis used eight) must come in the same order for every mesh. A 3-D similarity takes the points to those of
    the first mesh, which itself is placed by its first three points (4.2.1).
    """

    SUFFIXES = (".obj", ".ply", ".glb")
    FRONT = np.array(((-0.5, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, -1.07, 0.45)))

    def __init__(self, folder: str | Path) -> None:
        self.paths = sorted(p for p in Path(folder).glob("*") if p.suffix.lower() in self.SUFFIXES)
        if not self.paths:
            raise ValueError(f"{folder}: expected meshes ({', '.join(self.SUFFIXES)}), found none")
        self._target: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.paths)

    def head(self, index: int) -> Head:
        """Mesh number ``index``, in the order of the file names."""
        if not 0 <= index < len(self.paths):
            raise ValueError(f"head: expected an index below {len(self.paths)}, got {index}")
        path = self.paths[index]
        points = self._points(path)
        if self._target is None:
            first = points if index == 0 else self._points(self.paths[0])
            self._target = apply_similarity(fit_similarity_3d(first[:3], self.FRONT), first)
        if points.shape != self._target.shape:
            raise ValueError(
                f"{path}: expected {len(self._target)} marked points as in the first mesh, got {len(points)}"
            )
        try:
            mesh = trimesh.load(path, force="mesh", process=False)
        except Exception as error:  # trimesh raises whatever its parsers do
            raise ValueError(f"{path}: expected a readable mesh, got {error}") from error
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not np.isfinite(mesh.vertices).all():
            raise ValueError(f"{path}: expected a mesh with triangles and finite vertices")
        move = fit_similarity_3d(points, self._target)
        vertices = apply_similarity(move, np.asarray(mesh.vertices, np.float64))
        return Head(
            vertices,
            np.asarray(mesh.faces),
            vertices,
            np.zeros(len(vertices), np.float32),
            apply_similarity(move, points)[:3],
        )

    @staticmethod
    def _points(path: Path) -> np.ndarray:
        marked = path.with_suffix(".points.txt")
        try:
            points = np.loadtxt(marked, ndmin=2)
        except (OSError, ValueError) as error:
            raise ValueError(f"{marked}: expected one 'x y z' a line for {path.name}; got {error}") from error
        if points.shape[0] < 3 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"{marked}: expected three or more finite 'x y z' points, got an array of {points.shape}")
        return points


def fit_similarity_3d(source: np.ndarray, target: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Least-squares similarity between ``(N, 3)`` point sets (Umeyama 1991): scale, rotation ``(3, 3)``, translation
    ``(3,)``."""
    a, b = source - source.mean(0), target - target.mean(0)
    u, d, vt = np.linalg.svd(b.T @ a)
    if d[1] < 1e-9 * max(d[0], 1e-30):
        raise ValueError("marked points: expected three off one line, got collinear or coincident ones")
    sign = np.array((1.0, 1.0, np.sign(np.linalg.det(u @ vt))))
    rotation = u @ np.diag(sign) @ vt
    scale = float((d * sign).sum() / (a**2).sum())
    return scale, rotation, target.mean(0) - scale * rotation @ source.mean(0)


def apply_similarity(move: tuple[float, np.ndarray, np.ndarray], points: np.ndarray) -> np.ndarray:
    """``s R x + t`` for every row of ``points``."""
    scale, rotation, shift = move
    return scale * points @ rotation.T + shift
