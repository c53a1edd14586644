"""Maps that depend on where a lamp stands, as a few maps and a table of how much of each a direction takes.

Directions are those in front of a face, on a polar grid: rings of equal angles about the camera's axis. Between them
the table is interpolated, in the page as in :meth:`Dome.at`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

__all__ = ["Dome", "compress_dome", "dome_directions"]


class Dome(NamedTuple):
    """``basis (R, h, w)`` in the units of the maps; ``table (T, P, R)`` in -1..1, of T rings from the camera to 90
    degrees and P places on each."""

    basis: np.ndarray
    table: np.ndarray

    def at(self, direction: np.ndarray) -> np.ndarray:
        """The map under a unit ``direction (3,)`` with z of 0 or more, ``(h, w)`` float32, never negative.

        Example:
            >>> dome = compress_dome(lambda lights: np.ones((len(lights), 2, 2)), 4, 8, 1e-3)
            >>> dome.basis.shape, dome.at(np.array((0.0, 0.6, 0.8))).round(3).tolist()
            ((1, 2, 2), [[1.0, 1.0], [1.0, 1.0]])
        """
        rings, places, _ = self.table.shape
        ring = np.arccos(np.clip(direction[2], 0, 1)) / (np.pi / 2) * (rings - 1)
        place = np.arctan2(direction[1], direction[0]) / (2 * np.pi) % 1 * places
        i, j = min(int(ring), rings - 2), int(place) % places
        u, v = ring - i, place - int(place)
        after = (j + 1) % places
        inner, outer = ((1 - v) * self.table[k, j] + v * self.table[k, after] for k in (i, i + 1))
        return np.tensordot((1 - u) * inner + u * outer, self.basis, 1).clip(0).astype(np.float32)


def dome_directions(rings: int, places: int) -> np.ndarray:
    """``(T, P, 3)`` unit vectors."""
    tilt = np.linspace(0, np.pi / 2, rings)[:, None]
    turn = np.arange(places) * (2 * np.pi / places)
    return np.stack(
        (np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.broadcast_to(np.cos(tilt), (rings, places))), -1
    ).astype(np.float32)


def compress_dome(render: Callable[[np.ndarray], np.ndarray], rings: int, places: int, bound: float) -> Dome:
    """As few maps as keep the root mean square error, over the dome and all pixels, within ``bound``.

    Args:
        render: directions ``(Q, 3)`` to maps ``(Q, h, w)``.
        rings: how many rings, the camera's own direction the first.
        places: directions on each ring.
        bound: in the units of the maps.
    """
    directions = dome_directions(rings, places)
    maps = np.concatenate([render(directions[0, :1]), *map(render, directions[1:])]).astype(np.float64)
    height, width = maps.shape[1:]
    tilt = np.linspace(0, np.pi / 2, rings)
    share = np.concatenate(([1.0], np.repeat(places * np.sin(tilt[1:]), places)))[:, None] / places
    flat = maps.reshape(len(maps), -1)
    weighted = flat * np.sqrt(share)
    # the small side's eigenvectors: pixels are many, directions few
    energy, vectors = np.linalg.eigh(weighted @ weighted.T)
    energy, vectors = energy[::-1].clip(0), vectors[:, ::-1]
    left = energy.sum() - np.cumsum(energy)
    allowed = bound**2 * share.sum() * flat.shape[1]
    count = max(1, min(int((left > allowed).sum()) + 1, len(energy)))
    basis = vectors[:, :count].T @ weighted
    basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), 1e-12)
    table = flat @ basis.T
    most = np.maximum(np.abs(table).max(0), 1e-12)
    table, basis = table / most, basis * most[:, None]
    table = np.concatenate((np.repeat(table[:1], places, 0), table[1:])).reshape(rings, places, count)
    return Dome(basis.reshape(count, height, width).astype(np.float32), table.astype(np.float32))
