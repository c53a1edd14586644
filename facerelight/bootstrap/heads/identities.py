"""Scanned identities: the mean head of ICT-FaceKit (MIT) and its modes, of which the package carries the first 60."""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
import trimesh

from facerelight.bootstrap.heads.head import Head, normalise
from facerelight.bootstrap.heads.rest import at_rest

__all__ = ["IctHeads", "Identities", "read_identities", "read_packed"]

SEEN = ("face", "head", "eye")  # words in the names of the parts that a camera sees


class Identities(NamedTuple):
    """``vertices (V, 3)`` of the mean; ``modes (M, V, 3)``, of which people have normal amounts; ``triangles (T, 3)``;
    ``is_eye (V,)``, 1 on eyeballs; ``marks (68,)``, vertices of the iBUG landmarks."""

    vertices: np.ndarray
    modes: np.ndarray
    triangles: np.ndarray
    is_eye: np.ndarray
    marks: np.ndarray


class IctHeads:
    """Random identities of ICT-FaceKit: the mean of scanned heads plus Gaussian amounts of its modes, lids and mouth
    at ease (:mod:`rest`).

    Args:
        path: ``ict_heads.npz`` with all of its 100 modes; None: the 60 of the package, 99 % of the variance.
        seed: another seed gives other people.
        spread: factor on the modes' standard deviations.
    """

    def __init__(self, path: str | Path | None = None, seed: int = 0, spread: float = 0.8) -> None:
        self.seed, self.spread = seed, spread
        self._data = _packed() if path is None else _smooth_eyeballs(read_identities(path))
        self._reference = self._place(self._data.vertices)[0]

    def head(self, index: int) -> Head:
        """Identity ``index``, at ease."""
        rng = np.random.default_rng((self.seed, index, 3))  # 1 and 2: paint and posture
        return at_rest(self.awake(index), self._data.marks, rng)

    def awake(self, index: int) -> Head:
        """Identity ``index`` as people hold still for a scan: eyes wide open, lips a little apart."""
        data, rng = self._data, np.random.default_rng((self.seed, index))
        amounts = rng.normal(0, self.spread, len(data.modes))
        placed, landmarks = self._place(data.vertices + np.tensordot(amounts, data.modes.astype(np.float64), 1))
        return Head(placed, data.triangles, self._reference, data.is_eye, landmarks)

    def _place(self, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mark = vertices[self._data.marks]  # iBUG order: 36-41 and 42-47 the eyes, 48-67 the mouth
        return normalise(vertices, np.stack((mark[36:42].mean(0), mark[42:48].mean(0), mark[60:68].mean(0))))


def read_identities(path: str | Path) -> Identities:
    """ICT-FaceKit's meshes as arrays: ``vertices``, ``identity_basis``, ``triangles``, ``triangle_part``,
    ``part_names``, ``landmarks68``.

    Raises:
        ValueError: another file.
    """
    names = ("vertices", "identity_basis", "triangles", "landmarks68", "triangle_part", "part_names")
    try:
        with np.load(path, allow_pickle=False) as data:
            vertices, modes, triangles, marks, part, part_names = (data[name] for name in names)
    except (OSError, ValueError, KeyError) as error:
        raise ValueError(f"{path}: expected ict_heads.npz; got {error}") from error
    named = [str(name).lower() for name in part_names]
    kept = [i for i, name in enumerate(named) if any(word in name for word in SEEN)] or range(len(named))
    seen, is_eye = np.isin(part, list(kept)), np.zeros(len(vertices), np.float32)
    for ball in (i for i, name in enumerate(named) if "eyeball" in name):
        outside = _outermost(vertices, triangles[part == ball])
        is_eye[outside] = 1
        seen &= (part != ball) | np.isin(triangles, outside).all(1)
    return Identities(vertices, modes, triangles[seen], is_eye, marks)


def _outermost(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Vertices of the largest of several shells: an iris behind a cornea would shine through it."""
    shells = trimesh.graph.connected_components(trimesh.geometry.faces_to_edges(triangles), min_len=3)
    return max(shells, key=lambda shell: float(np.ptp(vertices[shell], axis=0).prod()))


def read_packed(file: IO[bytes] | Path) -> Identities:
    """What ``scripts/data/pack_identities.py`` wrote."""
    with np.load(file, allow_pickle=False) as data:
        steps = data["modes"].astype(np.int32).cumsum(-1, dtype=np.int32)  # (M, 3, V)
        modes = (steps * data["step"]).astype(np.float32).transpose(0, 2, 1)
        is_eye = np.zeros(len(data["vertices"]), np.float32)
        is_eye[data["eye"]] = 1
        marks, triangles = data["marks"].astype(np.int64), data["triangles"].astype(np.int32)
        return Identities(data["vertices"], modes, triangles, is_eye, marks)


@lru_cache(maxsize=1)
def _packed() -> Identities:
    """The package's, read once a process."""
    with files("facerelight.bootstrap").joinpath("data/identities.npz").open("rb") as file:
        return _smooth_eyeballs(read_packed(file))


def _smooth_eyeballs(found: Identities) -> Identities:
    """Modes that move, turn and stretch eyeballs as a whole: what they do beyond that is rounding, which breaks the
    light on a pupil."""
    modes = found.modes.copy()
    for side in (-1, 1):
        ball = np.flatnonzero((found.is_eye > 0.5) & (side * (found.vertices[:, 0] - found.vertices[:, 0].mean()) > 0))
        if len(ball):
            place = np.column_stack((found.vertices[ball], np.ones(len(ball)))).astype(np.float64)
            base = np.linalg.qr(place)[0]  # (B, 4)
            modes[:, ball] = base @ (base.T @ modes[:, ball])
    return found._replace(modes=modes)
