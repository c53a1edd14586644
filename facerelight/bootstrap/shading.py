"""One head under one light: which effects can change a pixel, and the image they give. Only those are simulated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.bootstrap.domain import Material
from facerelight.bootstrap.effects import EFFECTS, LampLight, Scene
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.surface import Surface

__all__ = ["EffectPlan", "plan_effects", "shade"]


class EffectPlan(NamedTuple):
    """What must be simulated for one (head, light): ``where``, by effect its pixels, ``(P,)`` bool."""

    where: dict[str, Tensor]

    @property
    def effects(self) -> frozenset[str]:
        """Names of the effects that are simulated."""
        return frozenset(self.where)


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
    if effects == "auto":
        scene = Scene(surface, light, material)
        asked = {name: effect.where(scene) for name, effect in EFFECTS.items()}
        return EffectPlan({name: where for name, where in asked.items() if where.any()})
    chosen = set(EFFECTS if effects == "all" else effects if not isinstance(effects, str) else (effects,))
    if chosen - set(EFFECTS):
        raise ValueError(
            f"effects: unknown {sorted(chosen - set(EFFECTS))}; choose 'auto', 'all' or from {', '.join(EFFECTS)}"
        )
    everywhere = torch.ones_like(surface.pixel, dtype=torch.bool)
    return EffectPlan({name: everywhere for name in EFFECTS if name in chosen})


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
    scene = Scene(surface, light, material)
    lamp_light = LampLight(scene.facing, torch.ones_like(scene.facing))
    for name, where in plan.where.items():
        EFFECTS[name].attenuate(scene, where, lamp_light, renderer)
    radiance = surface.albedo * lamp_light.facing * lamp_light.seen * scene.lamp  # (P,)
    for name, where in plan.where.items():
        pixels = slice(None) if where.all() else where  # a mask of everything would be copied through
        added = EFFECTS[name].emit(scene, pixels, lamp_light)
        if added is not None:
            radiance[pixels] += added
    if work is not None:
        for name in EFFECTS:
            touched = int(plan.where[name].sum()) if name in plan.where else 0
            work[f"{name} passes {'run' if name in plan.where else 'skipped'}"] += 1
            work[f"{name} pixels run"] += touched
            work[f"{name} pixels skipped"] += len(radiance) - touched
    image = torch.zeros(surface.size[0] * surface.size[1])
    image[surface.pixel] = radiance
    return image.view(surface.size)
