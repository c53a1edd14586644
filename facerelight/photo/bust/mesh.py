"""A mesh seen by an orthographic camera, drawn without OpenGL: the photograph's path must not need it."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.bust.frame import Grid

__all__ = ["Relief", "draw_mesh", "harmonic", "unit_vectors"]

SIZES = (2, 3, 4, 5, 7, 9, 12, 16, 20, 60)  # pixels: a triangle is sampled as densely as its size class needs
THIN = 0.02  # of a coarse pixel: so little that is known fixes it, and thin lines are not lost
THICKNESS = 0.03  # units: samples that far below the highest belong to the same surface


class Relief(NamedTuple):
    """``height (H, W)``, unit ``normal (H, W, 3)`` float32, and ``seen (H, W)`` bool, where there is a surface."""

    height: np.ndarray
    normal: np.ndarray
    seen: np.ndarray


def draw_mesh(
    vertices: np.ndarray, triangles: np.ndarray, grid: Grid, box: tuple[float, float, float, float] | None = None
) -> Relief:
    """The visible surface of a mesh, seen from +z.

    Every triangle is sampled evenly and each pixel keeps its highest samples: exact enough for triangles of some
        pixels.

    Args:
        vertices: ``(V, 3)`` bust coordinates.
        triangles: ``(T, 3)`` vertex numbers, counter-clockwise from outside.
        grid: what to draw on.
        box: x from, x to, y from, y to: triangles that reach out of it are left out.
    """
    normals = _vertex_normals(vertices, triangles)
    height, width = grid.size
    matrix = grid.matrix()
    flat = vertices[:, :2] @ matrix[:, :2].T + matrix[:, 2]  # (V, 2) pixels
    corner = flat[triangles]  # (T, 3, 2)
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    facing = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] <= 0  # rows run downwards
    low, high = np.array((0.0, 0.0)), np.array((width, height), float)
    if box is not None:
        ends = np.array(((box[0], box[3]), (box[1], box[2]))) @ matrix[:, :2].T + matrix[:, 2]
        low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
    inside = (corner.max(1) >= low).all(1) & (corner.min(1) < high).all(1)
    if box is not None:
        inside &= (corner.min(1) >= low).all(1) & (corner.max(1) < high).all(1)
    kept = triangles[inside & facing]
    extent = (corner.max(1) - corner.min(1)).max(1)[inside & facing]
    corners = np.concatenate((flat, vertices[:, 2:], normals), 1).astype(np.float32)  # (V, 6)
    classes = np.minimum(np.searchsorted(SIZES, extent), len(SIZES) - 1)
    parts = [
        np.matmul(_even_shares(size + 1), corners[kept[classes == k]]).reshape(-1, 6)
        for k, size in enumerate(SIZES)
        if (classes == k).any()
    ]
    if not parts:
        nothing = np.zeros((height, width))
        return Relief(nothing.astype(np.float32), np.zeros((height, width, 3), np.float32), nothing > 0)
    samples: np.ndarray = np.concatenate(parts)
    column, row = np.rint(samples[:, :2]).astype(np.int32).T
    shown = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    samples = samples[shown]
    index = row[shown] * width + column[shown]
    highest = np.full(height * width, -np.inf, np.float32)
    np.maximum.at(highest, index, samples[:, 2])
    top = samples[:, 2] > highest[index] - THICKNESS
    index, samples = index[top], samples[top]
    count = np.bincount(index, minlength=height * width)
    sums = np.stack([np.bincount(index, values, height * width) for values in samples[:, 2:].T], -1)
    total = (sums / np.maximum(count, 1)[:, None]).astype(np.float32).reshape(height, width, 4)
    return Relief(total[..., 0], unit_vectors(total[..., 1:]), (count > 0).reshape(height, width))


@lru_cache(maxsize=16)
def _even_shares(n: int) -> np.ndarray:
    """Barycentric coordinates of ``n * n`` evenly spread samples of a triangle, ``(n * n, 3)`` float32."""
    first = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    second = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    share = np.array(first + second, np.float32) / n
    return np.column_stack((share, 1 - share.sum(1)))


def _vertex_normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Smooth normals ``(V, 3)``: the sum of the faces around each vertex, weighted by area."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    sums = [sum(np.bincount(triangles[:, k], face[:, d], len(vertices)) for k in range(3)) for d in range(3)]
    return unit_vectors(np.stack(sums, -1))


def harmonic(value: np.ndarray, known: np.ndarray, inside: np.ndarray, rounds: int = 40) -> np.ndarray:
    """Harmonic interpolation of ``value (H, W, C)`` from the ``known`` pixels over ``inside``; coarse to fine.

    Nothing flows across the outline of ``inside``. ``rounds`` of Jacobi's method at every scale.

    Raises:
        ValueError: an empty map.
    """
    if not value.size:
        raise ValueError("harmonic: expected a map of at least one pixel, got none")
    levels: list[tuple[np.ndarray, ...]] = [
        (value * known[..., None], known.astype(np.float32), inside.astype(np.float32))
    ]
    while min(levels[-1][1].shape) > 12:
        half = levels[-1][1].shape[1] // 2, levels[-1][1].shape[0] // 2
        smaller = (cv2.resize(part.astype(np.float32), half, interpolation=cv2.INTER_AREA) for part in levels[-1])
        levels.append(
            tuple(part.reshape(half[::-1] + whole.shape[2:]) for part, whole in zip(smaller, levels[-1], strict=True))
        )
    cross = np.array(((0, 1, 0), (1, 0, 1), (0, 1, 0)), np.float32)
    v, k, _ = levels[-1]
    field: np.ndarray = np.broadcast_to(v.sum((0, 1)) / max(float(k.sum()), 1e-6), v.shape).astype(np.float32)
    for v, k, i in reversed(levels):
        field = cv2.resize(field, v.shape[1::-1], interpolation=cv2.INTER_LINEAR).reshape(v.shape)
        here = k > THIN
        field = np.where(here[..., None], v / np.maximum(k, 1e-6)[..., None], field).astype(np.float32)
        weight = (i > 0.3).astype(np.float32)
        around = np.maximum(cv2.filter2D(weight, -1, cross, borderType=cv2.BORDER_CONSTANT), 1e-6)
        share = (((weight > 0) & ~here) / around)[..., None].astype(np.float32)  # 0 where the value stays
        stays = field * (share == 0)
        for _ in range(rounds):
            moved = cv2.filter2D(field * weight[..., None], -1, cross, borderType=cv2.BORDER_CONSTANT)
            field = moved.reshape(v.shape) * share + stays
    return field


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """``vectors (..., 3)`` scaled to unit length; zero stays zero."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    return vectors / np.maximum(np.sqrt(x * x + y * y + z * z), 1e-6)[..., None]
