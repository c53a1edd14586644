"""What the camera sees of a painted head, and the head's relief: a height map that bounds what can cast shadows."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.look.eyes import lid_shade
from facerelight.bootstrap.look.skin import Look, paint
from facerelight.bootstrap.renderer import MeshRenderer

__all__ = ["AROUND", "Relief", "Surface", "view_surface"]

# Cells along each side of the light map; the relief that bounds occlusion is the part with the head in it.
RELIEF_SIZE = 256
AROUND = np.ones((5, 5), np.uint8)  # rounding of places to cells, and the soft edge of a shadow
STEEP = 100.0  # a rise that stands for a wall
CLIFF = 2.5  # relief steeper than this may be hidden in part by its own edge, whatever the light's direction


class Relief(NamedTuple):
    """The head's front as a height map in cells; bounds what can stand between a visible point and a light.

    ``highest (R, C)`` of each cell and those around it; ``slope (4, R, C)``, its steepest rise towards +x, -x, +y and
    -y; ``cliff (R, C)``, where it is steep in any direction; ``step``, a cell's side in mesh units; ``corner (2,)``,
    column and row of the map's origin, counted from the first cell; ``radius``, cells from there to the farthest
    visible pixel.
    """

    highest: np.ndarray
    slope: np.ndarray
    cliff: np.ndarray
    step: float
    corner: tuple[float, float]
    radius: int


class Surface(NamedTuple):
    """What the camera sees of a painted head, at its P visible pixels.

    ``position, normal (P, 3)``; ``albedo (P,)``; ``wet (P,)`` bool, eyeballs; ``pixel (P,)`` flat indices into
    ``size``; and the head's :class:`Relief`.
    """

    position: Tensor
    normal: Tensor
    albedo: Tensor
    wet: Tensor
    pixel: Tensor
    size: tuple[int, int]
    relief: Relief


def view_surface(renderer: MeshRenderer, head: Head, look: Look) -> Surface:
    """Render a head's geometry once, paint it, and map its relief; ``renderer`` keeps the mesh for the light passes of
    :func:`shade`."""
    features = np.concatenate((head.reference, head.is_eye[:, None]), 1)
    renderer.load(head.vertices, head.normals(), head.triangles, features)
    seen = renderer.geometry()
    inside = torch.from_numpy(seen.inside.copy())
    pixel = inside.flatten().nonzero()[:, 0]
    position, normal, values = (torch.from_numpy(np.ascontiguousarray(a)).flatten(0, 1)[pixel] for a in seen[:3])
    albedo = paint(values[:, :3], values[:, 3], look)
    wet = values[:, 3] > 0.5
    if wet.any():
        eye = torch.zeros_like(inside)
        eye.view(-1)[pixel] = wet
        eye_distance = renderer.supersample * float(np.linalg.norm(head.landmarks[1] - head.landmarks[0]))
        albedo *= lid_shade(eye, eye_distance).flatten()[pixel]
    size, relief = (inside.shape[0], inside.shape[1]), _map_relief(renderer, head, position)
    return Surface(position, normal, albedo, wet, pixel, size, relief)


def _map_relief(renderer: MeshRenderer, head: Head, position: Tensor) -> Relief:
    """The relief seen along the camera axis, pooled from a depth pass over the whole head; ``position`` of the visible
    pixels."""
    factor = renderer.shadow_size // RELIEF_SIZE
    texel = 2 * renderer.extent / renderer.shadow_size
    step = factor * texel
    low, high = head.vertices[:, :2].min(0) / step, head.vertices[:, :2].max(0) / step
    edges = [
        int(np.clip(np.floor(edge) + RELIEF_SIZE // 2, 1, RELIEF_SIZE - 2))
        for edge in (low[0], -high[1], high[0], -low[1])
    ]
    left, top, right, bottom = edges[0] - 1, edges[1] - 1, edges[2] + 2, edges[3] + 2
    window = (left * factor, top * factor, (right - left) * factor, (bottom - top) * factor)
    fine = torch.from_numpy(renderer.heights(np.array((0.0, 0.0, 1.0)), window).copy())
    pool = torch.nn.functional.max_pool2d
    solid = fine > -5 * renderer.extent
    highest = cv2.dilate(pool(fine[None], factor)[0].numpy(), AROUND)
    # A step down to where nothing is hides nothing from the surface beside it.
    along_x = (fine.diff(dim=1) / texel).masked_fill(~(solid[:, 1:] & solid[:, :-1]), 0.0)
    along_y = (-fine.diff(dim=0) / texel).masked_fill(~(solid[1:] & solid[:-1]), 0.0)
    pad = torch.nn.functional.pad
    slope = torch.stack(
        [
            pool(sign * axis[None], factor)[0]
            for axis in (pad(along_x, (0, 1)), pad(along_y, (0, 0, 0, 1)))
            for sign in (1, -1)
        ]
    ).numpy()
    # What is thinner than a texel the pass may have missed, but not the edges of its triangles.
    points, climb = _edge_points(head, step / 2)
    column, row = points[:, 0] / step + RELIEF_SIZE // 2 - left, RELIEF_SIZE // 2 - points[:, 1] / step - top
    rows, columns = highest.shape
    seen = fine.numpy()
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    points, climb, column, row = points[inside], climb[:, inside], column[inside], row[inside]
    below = seen[(row * factor).astype(int), (column * factor).astype(int)]
    upper = points[:, 2] > below - CLIFF * texel
    cell = row[upper].astype(int), column[upper].astype(int)
    edges_of_cells = np.full_like(highest, -np.inf)
    np.maximum.at(edges_of_cells, cell, points[upper, 2])
    highest = np.maximum(highest, cv2.dilate(edges_of_cells, AROUND))
    for of_direction, values in zip(slope, climb, strict=True):
        np.maximum.at(of_direction, cell, values[upper])
    radius = int(torch.linalg.vector_norm(position[:, :2], dim=1).max() / step) + 2
    cliff = np.hypot(slope[:2].max(0), slope[2:].max(0)) > CLIFF
    return Relief(highest, slope, cliff, step, (RELIEF_SIZE / 2 - left - 0.5, RELIEF_SIZE / 2 - top - 0.5), radius)


def _edge_points(head: Head, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Points on the edges of a head's triangles, no farther apart than ``spacing`` as the camera sees them, ``(S, 3)``,
    and how steeply their triangles rise there towards +x, -x, +y and -y, ``(4, S)``; the rim of an open mesh is a
    cliff."""
    corners = head.triangles[:, [[0, 1], [1, 2], [2, 0]]]  # (T, 3, 2)
    a, b, c = (head.vertices[head.triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    level = np.maximum(np.abs(normal[:, 2]), np.linalg.norm(normal, axis=1) / STEEP).clip(1e-30)
    rise = -normal[:, :2] * np.sign(normal[:, 2:] + 1e-300) / level[:, None]  # (T, 2)
    climb = np.stack((rise[:, 0], -rise[:, 0], rise[:, 1], -rise[:, 1])).repeat(3, 1)  # (4, E)
    edges = np.sort(corners.reshape(-1, 2).astype(np.int64), 1)  # meshes of few vertices count them in 16 bits
    _, which, count = np.unique(edges[:, 0] * len(head.vertices) + edges[:, 1], return_inverse=True, return_counts=True)
    climb = np.where(count[which.ravel()] == 1, STEEP, climb)
    start, along = head.vertices[edges[:, 0]], head.vertices[edges[:, 1]] - head.vertices[edges[:, 0]]
    steps = np.ceil(np.linalg.norm(along[:, :2], axis=1) / spacing).astype(int) + 1  # (E,)
    edge = np.arange(len(edges)).repeat(steps)
    part = (np.arange(len(edge)) - (steps.cumsum() - steps).repeat(steps)) / np.maximum(steps - 1, 1).repeat(steps)
    return (start[edge] + part[:, None] * along[edge]).astype(np.float32), climb[:, edge].astype(np.float32)
