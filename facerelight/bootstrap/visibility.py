"""Cast shadows: which pixels something might hide from a light, and how much of the light reaches them."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.surface import AROUND, Surface

__all__ = ["possible_shadows", "visibility"]

NEAR_CELLS = 6  # within so many cells occlusion is judged by slope, beyond by height
GRAZING = 0.36  # cosine
IN_FRONT = 0.02  # z of the lights for which what hides a point stands in front of it
BELOW = -1e4  # a height below everything
ON_AXIS = 1e-3  # lights closer to the camera axis than this hide nothing that the camera sees
SOFTNESS = 2  # texels to each side that soften a shadow's edge
SOFT_CELLS = 0.75  # cells by which a shadow's soft edge reaches above what casts it: SOFTNESS and one texel
STEEPEST = 1.3  # relief that rises more than this towards the light may be hidden in part by its own edge


def possible_shadows(surface: Surface, light: Tensor, lit: Tensor) -> Tensor:
    """Pixels that something might hide from the light.

    A ray towards a light in front of the face rises ``slope`` for every unit it moves sideways, and all of the head
    lies at or below the visible relief. So a point can be hidden only where, on its way, the relief climbs faster than
    that nearby, or stands higher than the ray farther off. The relief is turned so that its rows run towards the light;
    a running maximum along them then finds both.
    """
    relief = surface.relief
    sideways = float(torch.linalg.vector_norm(light[:2]))
    if float(light[2]) <= IN_FRONT:
        return lit
    if sideways < ON_AXIS:
        return torch.zeros_like(lit)
    slope = float(light[2]) / sideways
    x, y = (light[:2] / sideways).tolist()
    climb = relief.slope[0 if x > 0 else 1] * np.float32(abs(x)) + relief.slope[2 if y > 0 else 3] * np.float32(abs(y))
    # Facets that face the light by less than this may shade themselves.
    grazing = slope - GRAZING / sideways * np.sqrt(1 + climb**2)
    steep = cv2.dilate(((climb >= np.minimum(grazing, STEEPEST)) | relief.cliff).astype(np.uint8), AROUND)
    # the turned map: columns towards the light, rows across; the visible pixels are all in it
    column, row = relief.corner
    rows, columns = relief.highest.shape
    reach = int(np.hypot(max(column, columns - column), max(row, rows - row)) + 1)
    size = (relief.radius + reach, 2 * relief.radius + 1)
    origin = relief.radius
    turn = np.array(((x, -y, column - origin * (x - y)), (-y, -x, row + origin * (x + y))))
    turned = cv2.warpAffine(
        relief.highest, turn, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, borderValue=BELOW
    )
    above_ray = turned - np.float32(relief.step * slope) * np.arange(size[0], dtype=np.float32)
    highest = np.maximum.accumulate(above_ray[:, ::-1], axis=1)[:, ::-1]
    near = cv2.warpAffine(steep, turn, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    nearby = np.zeros((1, 2 * NEAR_CELLS + 1), np.uint8)
    nearby[0, NEAR_CELLS - 1 :] = 1
    near = cv2.dilate(near, nearby)
    # each visible pixel, in the turned map
    place = surface.position @ torch.tensor(((x, -y, 0.0), (y, x, 0.0), (0.0, 0.0, 1.0)))
    toward = place[:, 0] / relief.step + origin
    line = (place[:, 1] / relief.step + origin).round().long() * size[0]
    far = torch.from_numpy(np.ascontiguousarray(highest)).flatten()[
        line + (toward + NEAR_CELLS).round().long().clamp_max(size[0] - 1)
    ]
    above = far > place[:, 2] - relief.step * (slope * (toward + 1) + SOFT_CELLS / sideways)
    return lit & (above | torch.from_numpy(near).bool().flatten()[line + toward.round().long()])


def visibility(surface: Surface, light: Tensor, where: Tensor, renderer: MeshRenderer) -> Tensor:
    """How much of the light reaches the pixels ``where (P,)``, 0 to 1: percentage-closer filtering of a depth pass.

    The filter, five texels across, gives shadows the soft edge that a lamp of finite size gives them.
    """
    if float(torch.linalg.vector_norm(light[:2])) < ON_AXIS and float(light[2]) > 0:
        return torch.ones(int(where.sum()))  # the camera's own view: what it sees, the light sees
    size, texel = renderer.shadow_size, 2 * renderer.extent / renderer.shadow_size
    direction = light.numpy().astype(np.float64)
    cast = where.nonzero()[:, 0]
    local = surface.position[cast] @ torch.from_numpy(renderer.light_frame(direction)).T
    column = (local[:, 0] / renderer.extent + 1) * size / 2 - 0.5
    row = (1 - local[:, 1] / renderer.extent) * size / 2 - 0.5
    margin = SOFTNESS + 1
    left, top = (int(axis.amin().clamp(margin, size - 1 - margin)) - margin for axis in (column, row))
    right, bottom = (int(axis.amax().clamp(margin, size - 1 - margin)) + margin + 1 for axis in (column, row))
    exhaustive = len(cast) == len(where)
    if exhaustive:  # everything, everywhere
        left, top, right, bottom = 0, 0, size, size
    height = renderer.heights(direction, (left, top, right - left, bottom - top))
    cosine = (surface.normal[cast] @ light).clamp(0.15, 1)
    # What hides a point stands higher than this.
    least = local[:, 2] + texel * (6.0 + 5.0 * (1 - cosine**2).sqrt() / cosine)
    row, column = row - top, column - left
    if exhaustive:
        return _filtered(torch.from_numpy(height), row, column, least, texel)
    # most points have nothing above them in any of the texels
    highest = torch.from_numpy(cv2.dilate(height, np.ones((2 * SOFTNESS + 1, 2 * SOFTNESS + 1), np.uint8)))
    i, j = (at.round().long().clamp(0, count - 1) for at, count in zip((row, column), height.shape, strict=True))
    doubt = (highest[i, j] > least).nonzero()[:, 0]
    light_seen = torch.ones_like(row)
    light_seen[doubt] = _filtered(torch.from_numpy(height), row[doubt], column[doubt], least[doubt], texel)
    return light_seen


def _filtered(height: Tensor, row: Tensor, column: Tensor, least: Tensor, texel: float) -> Tensor:
    """Percentage-closer filter: the share of the texels around each point whose height does not exceed ``least``,
    softened over a texel."""
    taps = torch.arange(-SOFTNESS, SOFTNESS + 1.0)[:, None]
    rows, columns = row.round() + taps, column.round() + taps  # (5, P)
    weight = _box(rows - row)[:, None] * _box(columns - column)[None]
    i = rows.clamp(0, height.shape[0] - 1).long() * height.shape[1]
    j = columns.clamp(0, height.shape[1] - 1).long()
    above = height.flatten()[i[:, None] + j[None]] - least
    return (weight * (1 - above / texel).clamp(0, 1)).sum((0, 1))


def _box(distance: Tensor) -> Tensor:
    """A box of 2 SOFTNESS texels with ramps of one texel; over the texels nearest to a point its values sum to 1."""
    return (SOFTNESS + 0.5 - distance.abs()).clamp(0, 1) / (2 * SOFTNESS)
