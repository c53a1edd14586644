"""The effects of the rendered world, one class each: when a scene calls for it, where, and what it does to the picture.

To add one, write a class here and list it in :data:`EFFECTS`; its strength is a number of
:class:`~facerelight.bootstrap.domain.Material`. Planning, shading, forcing by name and the report of work follow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from facerelight.bootstrap.domain import Material, lamp_strength
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.surface import Surface
from facerelight.bootstrap.visibility import possible_shadows, visibility

__all__ = ["EFFECTS", "AmbientFill", "AttachedShadow", "CastShadow", "Effect", "Scene", "SpecularHighlight"]

REFLECTANCE = 0.028  # of skin at normal incidence; sets how it grows towards grazing
LEAST_VIEW = 0.05  # cosine to the viewer: pixels at the outline hold no thinner slivers
WET, SMOOTH = 0.01, 0.07  # reflectance and roughness of eyeballs, whose light is a glint and not a sheen
SMALL = 1e-6  # radiance that cannot matter


@dataclass(frozen=True)
class Scene:
    """A viewed head of P visible pixels under one light: ``surface``, unit ``light (3,)`` and the head's
    ``material``."""

    surface: Surface
    light: Tensor
    material: Material

    @cached_property
    def facing(self) -> Tensor:
        """Cosine between the surface and the light, ``(P,)``; negative where it is turned away."""
        return self.surface.normal @ self.light

    @cached_property
    def lamp(self) -> float:
        """How bright the lamp is: one at the side or above may be brighter than one at the camera."""
        _, y, z = self.light.tolist()
        return lamp_strength(y, z, self.material.side_light, self.material.top_light)


@dataclass
class LampLight:
    """The lamp's light at P pixels: ``facing (P,)``, the cosine at which it falls on them, and ``seen (P,)``, the share
    of the lamp that they see."""

    facing: Tensor
    seen: Tensor


class Effect:
    """One effect. It is simulated where :meth:`where` says that it can change a pixel, and nowhere else.

    An effect either changes the lamp's light (:meth:`attenuate`) or adds radiance to what that makes (:meth:`emit`).
    """

    name: str

    def where(self, scene: Scene) -> Tensor:
        """The pixels that the effect can change, ``(P,)`` bool, by a cheap conservative test; none: it is skipped."""
        raise NotImplementedError(f"{type(self).__name__}: expected a method where(scene)")

    def attenuate(self, scene: Scene, where: Tensor, light: LampLight, renderer: MeshRenderer) -> None:
        """Take from ``light``, in place, what does not reach the pixels ``where``."""

    def emit(self, scene: Scene, pixels: Tensor | slice, light: LampLight) -> Tensor | None:
        """Radiance that is added at ``pixels`` (a mask, or the slice of all), one value each; a white matte surface
        facing the light has 1."""
        return None


class AttachedShadow(Effect):
    """Surface that is turned from the light is black; one pixel of it calls for all, since the test is the work."""

    name = "attached"

    def where(self, scene: Scene) -> Tensor:
        """Everywhere, or nowhere."""
        return torch.full_like(scene.facing, not bool((scene.facing > 0).all()), dtype=torch.bool)

    def attenuate(self, scene: Scene, where: Tensor, light: LampLight, renderer: MeshRenderer) -> None:
        """No light falls from below the surface."""
        light.facing = light.facing.clamp_min(0)


class CastShadow(Effect):
    """Something stands in the way of the light."""

    name = "cast"

    def where(self, scene: Scene) -> Tensor:
        """Lit pixels that the head's relief might hide."""
        lit = scene.facing > 0
        return possible_shadows(scene.surface, scene.light, lit) if lit.any() else lit

    def attenuate(self, scene: Scene, where: Tensor, light: LampLight, renderer: MeshRenderer) -> None:
        """What a depth pass from the light says is hidden, softly."""
        light.seen[where] = visibility(scene.surface, scene.light, where, renderer)


class SpecularHighlight(Effect):
    """What the skin's surface reflects to the viewer."""

    name = "specular"

    def where(self, scene: Scene) -> Tensor:
        """Lit pixels whose normal lies near the half-way vector."""
        lit = scene.facing > 0
        if scene.material.specular <= 0:
            return torch.zeros_like(lit)
        reach = min(map(highlight_reach, (scene.material, of_eyes(scene.material))))
        return lit & (scene.surface.normal @ half_way(scene.light) > reach)

    def emit(self, scene: Scene, pixels: Tensor | slice, light: LampLight) -> Tensor:
        """Torrance and Sparrow's highlight of the part of the lamp that is seen."""
        normal, wet = scene.surface.normal[pixels], scene.surface.wet[pixels]
        reflected = highlight(normal, scene.light, scene.material)
        if scene.material.specular > 0:
            reflected[wet] = highlight(normal[wet], scene.light, of_eyes(scene.material))
        return light.seen[pixels] * scene.lamp * reflected


class AmbientFill(Effect):
    """Light from all around, more from the front."""

    name = "ambient"

    def where(self, scene: Scene) -> Tensor:
        """Everywhere, or nowhere."""
        return torch.full_like(scene.facing, scene.material.fill > 0, dtype=torch.bool)

    def emit(self, scene: Scene, pixels: Tensor | slice, light: LampLight) -> Tensor:
        """A fraction of what the albedo makes of the lamp."""
        surface = scene.surface
        return surface.albedo[pixels] * scene.material.fill * (0.5 + 0.5 * surface.normal[pixels, 2])


EFFECTS: dict[str, Effect] = {
    effect.name: effect for effect in (AttachedShadow(), CastShadow(), SpecularHighlight(), AmbientFill())
}
"""All effects by name, in the order in which they apply."""


def of_eyes(material: Material) -> Material:
    """A person's eyeballs: wet, and smoother than skin."""
    return replace(material, specular=WET, roughness=SMOOTH)


def half_way(light: Tensor) -> Tensor:
    """Half-way vector between the light and the viewer."""
    return torch.nn.functional.normalize(light + torch.tensor((0.0, 0.0, 1.0)), dim=0)


def highlight(normal: Tensor, light: Tensor, material: Material) -> Tensor:
    """Radiance that a rough dielectric surface reflects to the viewer (Torrance and Sparrow 1967): Beckmann facets,
    Schlick's Fresnel term and V grooves, scaled like the rest: a white matte surface facing the light has 1.

    Args:
        normal: ``(P, 3)``, facing the light.
        light: unit vector ``(3,)``; the viewer is at +z.
        material: reflectance at normal incidence and roughness.
    """
    half = half_way(light)
    to_half = (normal @ half).clamp_min(1e-3)
    to_light, to_viewer = (normal @ light).clamp_min(0), normal[:, 2].clamp_min(LEAST_VIEW)
    slope = (to_half**-2 - 1).clamp_min(0)
    facets = torch.exp(-slope / material.roughness**2) / (material.roughness**2 * to_half**4)
    fresnel = material.specular * (1 + (1 / REFLECTANCE - 1) * (1 - half[2]) ** 5)
    open_share = (2 * to_half / half[2].clamp_min(1e-3) * torch.minimum(to_light, to_viewer)).clamp_max(1)
    return fresnel * facets * open_share / (4 * to_viewer)


def highlight_reach(material: Material) -> float:
    """The least cosine between normal and half-way vector at which a highlight can show, whatever the light."""
    bound = material.specular / REFLECTANCE / (4 * LEAST_VIEW * material.roughness**2 * SMALL)
    slope = 0.0
    for _ in range(20):  # the fixed point of bound (1 + t)^2 exp(-t / m^2) = 1, from below
        slope = material.roughness**2 * max(0.0, math.log(bound * (1 + slope) ** 2))
    return (1 + slope) ** -0.5
