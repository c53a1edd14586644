"""How bright the lamp is by where it stands."""

import numpy as np
import pytest
import torch
import trimesh

from facerelight.bootstrap.domain import Domain, Material
from facerelight.bootstrap.effects import Scene
from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.look.skin import Look
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.bootstrap.surface import Surface, view_surface
from facerelight.geometry.lights import light_from_angles


def test_a_lamp_at_the_side_is_brighter_as_the_domain_says() -> None:
    """On a ball, matte and glossy: by ``1 + side_light (1 - cos)`` of its angle from the camera, whatever it lights;
    what comes from all around stays."""
    mesh = trimesh.creation.icosphere(4, radius=20)
    zeros = np.zeros(len(mesh.vertices), np.float32)
    head = Head(mesh.vertices, mesh.faces, np.array(mesh.vertices) / 20 + (0, 0, 5), zeros, np.zeros((3, 3)))
    with MeshRenderer(64, 64, extent=40) as renderer:
        surface = view_surface(renderer, head, Look.random(np.random.default_rng(0), Domain(texture=0.0)))
        for azimuth in (0.0, 60.0, 90.0, 120.0):
            light = light_from_angles(azimuth, 0.0)
            images = {}
            for side in (0.0, 0.4):
                for fill in (0.0, 0.1):
                    skin = Material(0.03, 0.3, fill, side_light=side)
                    images[side, fill] = shade(surface, light, skin, plan_effects(surface, light, skin), renderer)
            lit = images[0.0, 0.0] > 0.01
            ratio = (images[0.4, 0.0] / images[0.0, 0.0])[lit]
            assert lit.sum() > 200
            assert torch.allclose(ratio, torch.full_like(ratio, 1 + 0.4 * (1 - np.cos(np.deg2rad(azimuth)))), atol=1e-4)
            around = [images[side, 0.1] - images[side, 0.0] for side in (0.0, 0.4)]
            assert torch.allclose(around[0], around[1], atol=1e-5)


@pytest.mark.parametrize(("elevation", "brightness"), [(90.0, 1.2), (30.0, 1.1), (0.0, 1.0), (-90.0, 0.8)])
def test_a_lamp_above_is_brighter_as_the_domain_says(elevation: float, brightness: float) -> None:
    light = light_from_angles(0.0, elevation)
    one = torch.zeros(1)
    surface = Surface(one.expand(1, 3), light[None], one, one > 0, one.long(), (1, 1), None)  # type: ignore[arg-type]
    scene = Scene(surface, light, Material(0.03, 0.3, 0.0, top_light=0.2))
    assert scene.lamp == pytest.approx(brightness, abs=1e-6)


def test_people_carry_the_domains_lamps() -> None:
    material = Look.random(np.random.default_rng(0), Domain(side_light=0.37, top_light=0.12)).material
    assert (material.side_light, material.top_light) == pytest.approx((0.37, 0.12))
