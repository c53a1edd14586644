"""Readers of MakeHuman's files, from which the heads and the mean bust are packed."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np

__all__ = ["read_obj", "read_target"]

Polygon = list[tuple[int, int]]


def read_obj(path: Path) -> tuple[np.ndarray, np.ndarray, dict[str, list[Polygon]]]:
    """Vertices, texture coordinates and the polygons of each group, as ``(vertex, texture)`` index pairs."""
    vertices, uv = [], []
    groups: dict[str, list[Polygon]] = {}
    group: list[Polygon] = []
    for line in path.read_text().splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            vertices.append([float(x) for x in rest[:3]])
        elif kind == "vt":
            uv.append([float(x) for x in rest[:2]])
        elif kind == "g":
            group = groups.setdefault(rest[0], [])
        elif kind == "f":
            corners = (corner.split("/") for corner in rest)
            group.append([(int(vertex) - 1, int(texture) - 1) for vertex, texture, *_ in corners])
    return np.array(vertices), np.array(uv), groups


def read_target(path: Path, count: int) -> np.ndarray:
    """A displacement of every vertex, from a MakeHuman ``.target`` file (index x y z a line)."""
    opener = gzip.open if path.suffix == ".gz" else open
    with opener(path, "rt") as file:
        rows = [line.split() for line in file if line.strip() and not line.startswith("#")]
    delta = np.zeros((count, 3))
    for index, *xyz in rows:
        delta[int(index)] = [float(v) for v in xyz]
    return delta
