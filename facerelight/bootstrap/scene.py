"""One head under one light: which effects can change a pixel, and the image they give. Only those effects are simulated.

Effects: ``attached`` shadow (surface turned from the light), ``cast`` shadow (something stands in the way), ``specular`` highlight,
``ambient`` fill. Geometry and albedo are rendered once a head; a cast-shadow pass is rendered a light, of the triangles that matter.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.skin import Look, Material, paint

__all__ = ["EFFECTS", "EffectPlan", "Surface", "plan_effects", "shade", "view_surface"]

EFFECTS = ("attached", "cast", "specular", "ambient")
RELIEF_SIZE = 64  # cells along each side of the light map; the relief that bounds occlusion is the part with the head in it
NEAR_CELLS = 2  # within so many cells occlusion is judged by slope, beyond by height
FRESNEL = 0.04  # reflectance of skin at normal incidence
SMALL = 1e-6  # radiance that cannot matter
GRAZING = 0.36  # cosine
IN_FRONT = 0.02  # z of the lights for which what hides a point stands in front of it
BELOW = -1e4  # a height below everything
ON_AXIS = 1e-3  # lights closer to the camera axis than this hide nothing that the camera sees
STEEPEST = 1.3  # steeper relief than this may be hidden in part by its own edge, whatever the light


class Relief(NamedTuple):
    """The head's front as a height map over all of it, in cells; bounds what can stand between a visible point and a light.

    ``highest, lowest (R, C)`` of each cell; ``slope (4, R, C)``, its steepest rise towards +x, -x, +y and -y; ``step``, a cell's side in
    pixels; ``corner (2,)``, row and column of the first cell in the whole map.
    """

    highest: np.ndarray
    lowest: np.ndarray
    slope: np.ndarray
    step: float
    corner: tuple[int, int]


class Surface(NamedTuple):
    """What the camera sees of a painted head, at its P visible pixels.

    ``position, normal (P, 3)``; ``albedo (P,)``; ``pixel (P,)`` flat indices into ``size``; the head's :class:`Relief`, and in which of
    its cells each pixel lies, ``cell (P,)``.
    """

    position: Tensor
    normal: Tensor
    albedo: Tensor
    pixel: Tensor
    size: tuple[int, int]
    relief: Relief
    cell: Tensor


class EffectPlan(NamedTuple):
    """What must be simulated for one (head, light): ``effects``, and at which pixels: ``cast``, ``specular`` ``(P,)`` bool."""

    effects: frozenset[str]
    cast: Tensor
    specular: Tensor


def view_surface(renderer: MeshRenderer, head: Head, look: Look) -> Surface:
    """Render a head's geometry once, paint it, and map its relief; ``renderer`` keeps the mesh for the light passes of :func:`shade`."""
    features = np.concatenate((head.reference, head.is_eye[:, None]), 1)
    renderer.load(head.vertices, head.normals(), head.triangles, features)
    seen = renderer.geometry()
    inside = torch.from_numpy(seen.inside.copy())
    pixel = inside.flatten().nonzero()[:, 0]
    position, normal, values = (torch.from_numpy(np.ascontiguousarray(a)).flatten(0, 1)[pixel] for a in seen[:3])
    albedo = paint(values[:, :3], values[:, 3], look)
    relief = _map_relief(renderer, head)
    column = ((position[:, 0] / renderer.extent + 1) * RELIEF_SIZE / 2).long() - relief.corner[1]
    row = ((1 - position[:, 1] / renderer.extent) * RELIEF_SIZE / 2).long() - relief.corner[0]
    rows, columns = relief.highest.shape
    cell = row.clamp(0, rows - 1) * columns + column.clamp(0, columns - 1)
    return Surface(position, normal, albedo, pixel, (inside.shape[0], inside.shape[1]), relief, cell)


def _map_relief(renderer: MeshRenderer, head: Head) -> Relief:
    """The relief seen along the camera axis, pooled from a depth pass over the whole head."""
    factor = renderer.shadow_size // RELIEF_SIZE
    texel = 2 * renderer.extent / renderer.shadow_size
    step = factor * texel
    low, high = head.vertices[:, :2].min(0), head.vertices[:, :2].max(0)
    left, right = (int(np.clip((x / renderer.extent + 1) * RELIEF_SIZE / 2, 1, RELIEF_SIZE - 2)) for x in (low[0], high[0]))
    top, bottom = (int(np.clip((1 - y / renderer.extent) * RELIEF_SIZE / 2, 1, RELIEF_SIZE - 2)) for y in (high[1], low[1]))
    left, top, right, bottom = left - 1, top - 1, right + 2, bottom + 2
    window = (left * factor, top * factor, (right - left) * factor, (bottom - top) * factor)
    fine = torch.from_numpy(renderer.heights(np.array((0.0, 0.0, 1.0)), window)[::2, ::2].copy())  # every other texel bounds well enough
    factor, texel = factor // 2, 2 * texel
    pool = torch.nn.functional.max_pool2d
    solid = fine > -5 * renderer.extent
    highest = pool(fine[None], factor)[0]
    lowest = -pool((-fine).masked_fill(~solid, BELOW)[None], factor)[0]
    # A step down to where nothing is hides nothing from the surface beside it.
    along_x = (fine.diff(dim=1) / texel).masked_fill(~(solid[:, 1:] & solid[:, :-1]), 0.0)
    along_y = (-fine.diff(dim=0) / texel).masked_fill(~(solid[1:] & solid[:-1]), 0.0)
    pad = torch.nn.functional.pad
    slope = torch.stack([pool(sign * axis[None], factor)[0] for axis in (pad(along_x, (0, 1)), pad(along_y, (0, 0, 0, 1))) for sign in (1, -1)])
    return Relief(highest.numpy(), lowest.numpy(), slope.numpy(), step, (top, left))


def plan_effects(surface: Surface, light: Tensor, material: Material, effects: str | Iterable[str] = "auto") -> EffectPlan:
    """Which effects can change a pixel of ``surface`` under ``light (3,)``, by cheap conservative tests.

    Args:
        surface: a viewed head.
        light: unit vector.
        material: the head's reflectance and fill.
        effects: "auto"; "all": everything, everywhere; or the names of the effects to force, everywhere.

    Raises:
        ValueError: an unknown effect.
    """
    everywhere = torch.ones_like(surface.pixel, dtype=torch.bool)
    if effects != "auto":
        chosen = frozenset(EFFECTS if effects == "all" else effects if not isinstance(effects, str) else (effects,))
        if chosen - set(EFFECTS):
            raise ValueError(f"effects: unknown {sorted(chosen - set(EFFECTS))}; choose 'auto', 'all' or from {', '.join(EFFECTS)}")
        return EffectPlan(chosen, everywhere & ("cast" in chosen), everywhere & ("specular" in chosen))
    facing = surface.normal @ light
    lit = facing > 0
    needed = set()
    if not lit.all():
        needed.add("attached")
    cast = _possible_shadows(surface, light, lit) if lit.any() else lit
    if cast.any():
        needed.add("cast")
    specular = torch.zeros_like(lit)
    if material.specular > 0:
        strongest = material.specular * (material.shininess + 8) / 8 / FRESNEL
        threshold = (SMALL / strongest) ** (1 / material.shininess) if strongest > SMALL else 2.0
        specular = lit & (surface.normal @ _half(light) > threshold)
        if specular.any():
            needed.add("specular")
    if material.fill > 0:
        needed.add("ambient")
    return EffectPlan(frozenset(needed), cast, specular)


def _possible_shadows(surface: Surface, light: Tensor, lit: Tensor) -> Tensor:
    """Pixels that something might hide from the light.

    A ray towards a light in front of the face rises ``slope`` for every unit it moves sideways, and all of the head lies at or below the
    visible relief. So a point can be hidden only where, on its way, the relief climbs faster than that nearby, or stands higher than the
    ray farther off; both are found for all cells at once by shifting the relief against the light, step by step.
    """
    relief = surface.relief
    sideways = float(torch.linalg.vector_norm(light[:2]))
    if float(light[2]) <= IN_FRONT:
        return lit
    if sideways < ON_AXIS:
        return torch.zeros_like(lit)
    slope = float(light[2]) / sideways
    x, y = (light[:2] / sideways).tolist()
    climb = relief.slope[0 if x > 0 else 1] * abs(x) + relief.slope[2 if y > 0 else 3] * abs(y)
    grazing = slope - GRAZING / sideways * np.sqrt(1 + climb**2)  # facets that face the light by less than this may shade themselves
    steep = np.where(climb >= np.minimum(grazing, STEEPEST), 0, BELOW).astype(np.float32)
    drop = relief.step * slope
    depth = relief.highest.max() - float(surface.position[:, 2].min())
    reach = min(RELIEF_SIZE, NEAR_CELLS + 2 + int(depth / drop))
    near = _sweep(steep, x, y, range(NEAR_CELLS + 1), 0.0) >= 0
    far = _sweep(relief.highest, x, y, range(NEAR_CELLS, reach), drop) >= relief.lowest
    receivers = cv2.dilate((near | far).astype(np.uint8), np.ones((3, 3), np.uint8))  # the soft edge of a shadow
    return lit & torch.from_numpy(receivers.ravel()).bool()[surface.cell]


def _sweep(image: np.ndarray, x: float, y: float, steps: range, drop: float) -> np.ndarray:
    """Largest value met at ``steps`` cells in direction (x, y), less ``drop`` a cell; cells are rounded so that it is never too small."""
    around = cv2.dilate(image, np.ones((3, 3), np.uint8))
    largest = np.full_like(image, BELOW)
    for k in steps:
        np.maximum(largest, _shift(around, k * x, k * y) - np.float32(drop * max(k - 1, 0)), out=largest)
    return largest


def _shift(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """``image`` read ``x`` cells to the right and ``y`` cells up, rounded; what lies outside is below everything."""
    columns, rows = round(x), -round(y)
    moved = np.full_like(image, BELOW)
    height, width = image.shape
    if abs(columns) < width and abs(rows) < height:
        here = slice(max(0, -rows), height - max(0, rows)), slice(max(0, -columns), width - max(0, columns))
        there = slice(max(0, rows), height + min(0, rows)), slice(max(0, columns), width + min(0, columns))
        moved[here] = image[there]
    return moved


def _half(light: Tensor) -> Tensor:
    """Half-way vector between the light and the viewer."""
    return torch.nn.functional.normalize(light + torch.tensor((0.0, 0.0, 1.0)), dim=0)


def shade(
    surface: Surface, light: Tensor, material: Material, plan: EffectPlan, renderer: MeshRenderer, work: Counter[str] | None = None
) -> Tensor:
    """Linear radiance of ``surface`` under one light, ``(H, W)``, black where no head is; a white matte surface facing the light has 1.

    ``work`` counts, by effect, passes run and skipped and the pixels they touched.
    """
    facing = surface.normal @ light
    if "attached" in plan.effects:
        facing = facing.clamp_min(0)
    light_seen = torch.ones_like(facing)
    if "cast" in plan.effects:
        light_seen[plan.cast] = _visibility(surface, light, plan, renderer)
    arriving = facing * light_seen
    radiance = surface.albedo * arriving
    if "specular" in plan.effects:
        where = plan.specular
        half = _half(light)
        lobe = (surface.normal[where] @ half).clamp_min(0) ** material.shininess * (material.shininess + 8) / 8
        fresnel = 1 + (1 / FRESNEL - 1) * (1 - half[2]) ** 5
        radiance[where] += material.specular * fresnel * lobe * arriving[where]
    if "ambient" in plan.effects:
        radiance = radiance + surface.albedo * material.fill * (0.5 + 0.5 * surface.normal[:, 2])
    if work is not None:
        touched = {"attached": len(facing), "cast": int(plan.cast.sum()), "specular": int(plan.specular.sum()), "ambient": len(facing)}
        for effect in EFFECTS:
            run = effect in plan.effects
            work[f"{effect} passes {'run' if run else 'skipped'}"] += 1
            work[f"{effect} pixels run"] += touched[effect] if run else 0
            work[f"{effect} pixels skipped"] += len(facing) - (touched[effect] if run else 0)
    image = torch.zeros(surface.size[0] * surface.size[1])
    image[surface.pixel] = radiance
    return image.view(surface.size)


def _visibility(surface: Surface, light: Tensor, plan: EffectPlan, renderer: MeshRenderer) -> Tensor:
    """How much of the light reaches the pixels ``plan.cast``, 0 to 1: percentage-closer filtering over 3 x 3 texels of a depth pass."""
    if float(torch.linalg.vector_norm(light[:2])) < ON_AXIS and float(light[2]) > 0:
        return torch.ones(int(plan.cast.sum()))  # the camera's own view: what it sees, the light sees
    size, texel = renderer.shadow_size, 2 * renderer.extent / renderer.shadow_size
    direction = light.numpy().astype(np.float64)
    local = surface.position[plan.cast] @ torch.from_numpy(renderer.light_frame(direction)).T
    column = (local[:, 0] / renderer.extent + 1) * size / 2 - 0.5
    row = (1 - local[:, 1] / renderer.extent) * size / 2 - 0.5
    left, top = (int(axis.amin().clamp(2, size - 3)) - 2 for axis in (column, row))
    right, bottom = (int(axis.amax().clamp(2, size - 3)) + 3 for axis in (column, row))
    exhaustive = bool(plan.cast.all())
    if exhaustive:  # everything, everywhere
        left, top, right, bottom = 0, 0, size, size
    height = renderer.heights(direction, (left, top, right - left, bottom - top))
    cosine = (surface.normal[plan.cast] @ light).clamp(0.05, 1)
    least = local[:, 2] + texel * (6.0 + 2.5 * (1 - cosine**2).sqrt() / cosine)  # what hides a point stands higher than this
    row, column = row - top, column - left
    light_seen = torch.ones_like(row)
    doubt = torch.arange(len(row))
    if not exhaustive:  # most points have nothing above them in any of the nine texels
        highest = torch.from_numpy(cv2.dilate(height, np.ones((3, 3), np.uint8)))
        doubt = (highest[row.round().long(), column.round().long()] > least).nonzero()[:, 0]
    light_seen[doubt] = _filtered(torch.from_numpy(height), row[doubt], column[doubt], least[doubt], texel)
    return light_seen


def _filtered(height: Tensor, row: Tensor, column: Tensor, least: Tensor, texel: float) -> Tensor:
    """Percentage-closer filter: the share of 3 x 3 texels around each point whose height does not exceed ``least``, softened over a texel."""
    taps = torch.tensor((-1.0, 0.0, 1.0))[:, None]
    rows, columns = row.round() + taps, column.round() + taps  # (3, P)
    weight = _spline(rows - row)[:, None] * _spline(columns - column)[None]
    i = rows.clamp(0, height.shape[0] - 1).long() * height.shape[1]
    j = columns.clamp(0, height.shape[1] - 1).long()
    above = height.flatten()[i[:, None] + j[None]] - least
    return (weight * (1 - above / texel).clamp(0, 1)).sum((0, 1))


def _spline(distance: Tensor) -> Tensor:
    """Quadratic B-spline; over the three texels nearest to a point its values sum to 1."""
    distance = distance.abs()
    return torch.where(distance < 0.5, 0.75 - distance**2, 0.5 * (1.5 - distance).clamp_min(0) ** 2)
