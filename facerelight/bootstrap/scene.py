"""One head under one light: which effects can change a pixel, and the image they give. Only those effects are
simulated.

Effects: ``attached`` shadow (surface turned from the light), ``cast`` shadow (something stands in the way),
``specular`` highlight, ``ambient`` fill. Geometry and albedo are rendered once a head; a cast-shadow pass is rendered a
light, of the triangles that matter.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.domain import Material
from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.skin import Look, paint

__all__ = ["EFFECTS", "EffectPlan", "Surface", "plan_effects", "shade", "view_surface"]

EFFECTS = ("attached", "cast", "specular", "ambient")
RELIEF_SIZE = (
    256  # cells along each side of the light map; the relief that bounds occlusion is the part with the head in it
)
NEAR_CELLS = 6  # within so many cells occlusion is judged by slope, beyond by height
AROUND = np.ones((5, 5), np.uint8)  # rounding of places to cells, and the soft edge of a shadow
REFLECTANCE = 0.028  # of skin at normal incidence; sets how it grows towards grazing
LEAST_VIEW = 0.05  # cosine to the viewer: pixels at the outline hold no thinner slivers
SMALL = 1e-6  # radiance that cannot matter
GRAZING = 0.36  # cosine
IN_FRONT = 0.02  # z of the lights for which what hides a point stands in front of it
BELOW = -1e4  # a height below everything
ON_AXIS = 1e-3  # lights closer to the camera axis than this hide nothing that the camera sees
SOFTNESS = 2  # texels to each side that soften a shadow's edge
STEEPEST = 1.3  # relief that rises more than this towards the light may be hidden in part by its own edge
CLIFF = 2.5  # steeper relief than this may be, whatever the light's direction


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

    ``position, normal (P, 3)``; ``albedo (P,)``; ``pixel (P,)`` flat indices into ``size``; and the head's
    :class:`Relief`.
    """

    position: Tensor
    normal: Tensor
    albedo: Tensor
    pixel: Tensor
    size: tuple[int, int]
    relief: Relief


class EffectPlan(NamedTuple):
    """What must be simulated for one (head, light): ``effects``, and at which pixels: ``cast``, ``specular`` ``(P,)``
    bool."""

    effects: frozenset[str]
    cast: Tensor
    specular: Tensor


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
    return Surface(
        position, normal, albedo, pixel, (inside.shape[0], inside.shape[1]), _map_relief(renderer, head, position)
    )


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
    fine = torch.from_numpy(
        renderer.heights(np.array((0.0, 0.0, 1.0)), window)[::2, ::2].copy()
    )  # every other texel bounds well enough
    factor, texel = factor // 2, 2 * texel
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
    )
    radius = int(torch.linalg.vector_norm(position[:, :2], dim=1).max() / step) + 2
    cliff = torch.hypot(slope[:2].amax(0), slope[2:].amax(0)) > CLIFF
    return Relief(
        highest, slope.numpy(), cliff.numpy(), step, (RELIEF_SIZE / 2 - left - 0.5, RELIEF_SIZE / 2 - top - 0.5), radius
    )


def plan_effects(
    surface: Surface, light: Tensor, material: Material, effects: str | Iterable[str] = "auto"
) -> EffectPlan:
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
            raise ValueError(
                f"effects: unknown {sorted(chosen - set(EFFECTS))}; choose 'auto', 'all' or from {', '.join(EFFECTS)}"
            )
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
        threshold = _highlight_reach(material)
        specular = lit & (surface.normal @ _half(light) > threshold)
        if specular.any():
            needed.add("specular")
    if material.fill > 0:
        needed.add("ambient")
    return EffectPlan(frozenset(needed), cast, specular)


def _possible_shadows(surface: Surface, light: Tensor, lit: Tensor) -> Tensor:
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
    grazing = slope - GRAZING / sideways * np.sqrt(
        1 + climb**2
    )  # facets that face the light by less than this may shade themselves
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
    above = far > place[:, 2] - relief.step * slope * (toward + 1)
    return lit & (above | torch.from_numpy(near).bool().flatten()[line + toward.round().long()])


def _half(light: Tensor) -> Tensor:
    """Half-way vector between the light and the viewer."""
    return torch.nn.functional.normalize(light + torch.tensor((0.0, 0.0, 1.0)), dim=0)


def _highlight(normal: Tensor, light: Tensor, material: Material) -> Tensor:
    """Radiance that a rough dielectric surface reflects to the viewer (Torrance and Sparrow 1967): Beckmann facets,
    Schlick's Fresnel term and V grooves, scaled like the rest: a white matte surface facing the light has 1.

    Args:
        normal: ``(P, 3)``, facing the light.
        light: unit vector ``(3,)``; the viewer is at +z.
        material: reflectance at normal incidence and roughness.
    """
    half = _half(light)
    to_half = (normal @ half).clamp_min(1e-3)
    to_light, to_viewer = (normal @ light).clamp_min(0), normal[:, 2].clamp_min(LEAST_VIEW)
    slope = (to_half**-2 - 1).clamp_min(0)
    facets = torch.exp(-slope / material.roughness**2) / (material.roughness**2 * to_half**4)
    fresnel = material.specular * (1 + (1 / REFLECTANCE - 1) * (1 - half[2]) ** 5)
    open_share = (2 * to_half / half[2].clamp_min(1e-3) * torch.minimum(to_light, to_viewer)).clamp_max(1)
    return fresnel * facets * open_share / (4 * to_viewer)


def _highlight_reach(material: Material) -> float:
    """The least cosine between normal and half-way vector at which a highlight can show, whatever the light."""
    bound = material.specular / REFLECTANCE / (4 * LEAST_VIEW * material.roughness**2 * SMALL)
    slope = 0.0
    for _ in range(20):  # the fixed point of bound (1 + t)^2 exp(-t / m^2) = 1, from below
        slope = material.roughness**2 * max(0.0, math.log(bound * (1 + slope) ** 2))
    return (1 + slope) ** -0.5


def shade(
    surface: Surface,
    light: Tensor,
    material: Material,
    plan: EffectPlan,
    renderer: MeshRenderer,
    work: Counter[str] | None = None,
) -> Tensor:
    """Linear radiance of ``surface`` under one light, ``(H, W)``, black where no head is; a white matte surface facing
    the light has 1.

    ``work`` counts, by effect, passes run and skipped and the pixels they touched.
    """
    facing = surface.normal @ light
    if "attached" in plan.effects:
        facing = facing.clamp_min(0)
    light_seen = torch.ones_like(facing)
    if "cast" in plan.effects:
        light_seen[plan.cast] = _visibility(surface, light, plan, renderer)
    lamp = 1 + material.side_light * float(1 - light[2])
    radiance = surface.albedo * facing * light_seen * lamp
    if "specular" in plan.effects:
        where = plan.specular.nonzero()[:, 0]
        lamp_seen = light_seen[where] * lamp
        radiance[where] += lamp_seen * _highlight(surface.normal[where], light, material)
    if "ambient" in plan.effects:
        radiance = radiance + surface.albedo * material.fill * (0.5 + 0.5 * surface.normal[:, 2])
    if work is not None:
        touched = {
            "attached": len(facing),
            "cast": int(plan.cast.sum()),
            "specular": int(plan.specular.sum()),
            "ambient": len(facing),
        }
        for effect in EFFECTS:
            run = effect in plan.effects
            work[f"{effect} passes {'run' if run else 'skipped'}"] += 1
            work[f"{effect} pixels run"] += touched[effect] if run else 0
            work[f"{effect} pixels skipped"] += len(facing) - (touched[effect] if run else 0)
    image = torch.zeros(surface.size[0] * surface.size[1])
    image[surface.pixel] = radiance
    return image.view(surface.size)


def _visibility(surface: Surface, light: Tensor, plan: EffectPlan, renderer: MeshRenderer) -> Tensor:
    """How much of the light reaches the pixels ``plan.cast``, 0 to 1: percentage-closer filtering of a depth pass.

    The filter, five texels across, gives shadows the soft edge that a lamp of finite size gives them.
    """
    if float(torch.linalg.vector_norm(light[:2])) < ON_AXIS and float(light[2]) > 0:
        return torch.ones(int(plan.cast.sum()))  # the camera's own view: what it sees, the light sees
    size, texel = renderer.shadow_size, 2 * renderer.extent / renderer.shadow_size
    direction = light.numpy().astype(np.float64)
    cast = plan.cast.nonzero()[:, 0]
    local = surface.position[cast] @ torch.from_numpy(renderer.light_frame(direction)).T
    column = (local[:, 0] / renderer.extent + 1) * size / 2 - 0.5
    row = (1 - local[:, 1] / renderer.extent) * size / 2 - 0.5
    margin = SOFTNESS + 1
    left, top = (int(axis.amin().clamp(margin, size - 1 - margin)) - margin for axis in (column, row))
    right, bottom = (int(axis.amax().clamp(margin, size - 1 - margin)) + margin + 1 for axis in (column, row))
    exhaustive = len(cast) == len(plan.cast)
    if exhaustive:  # everything, everywhere
        left, top, right, bottom = 0, 0, size, size
    height = renderer.heights(direction, (left, top, right - left, bottom - top))
    cosine = (surface.normal[cast] @ light).clamp(0.15, 1)
    least = local[:, 2] + texel * (
        6.0 + 5.0 * (1 - cosine**2).sqrt() / cosine
    )  # what hides a point stands higher than this
    row, column = row - top, column - left
    if exhaustive:
        return _filtered(torch.from_numpy(height), row, column, least, texel)
    # most points have nothing above them in any of the texels
    highest = torch.from_numpy(cv2.dilate(height, np.ones((2 * SOFTNESS + 1, 2 * SOFTNESS + 1), np.uint8)))
    doubt = (highest.flatten()[row.round().long() * height.shape[1] + column.round().long()] > least).nonzero()[:, 0]
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
