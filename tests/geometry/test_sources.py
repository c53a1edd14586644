"""Lamps, fill and their sums, against their definitions."""

import math

import numpy as np
import pytest
import torch

from facerelight.geometry.lights import angles_from_light, light_from_angles
from facerelight.geometry.sources import FILL_STRENGTH, Lamp, LightMixture, fill_light, scene_light
from facerelight.numerics.luminance import LUMINANCE

POINTS = {0: 1, 1: 1, 5: 7, 15: 13, 40: 24, 90: 24}


@pytest.mark.parametrize("size", sorted(POINTS))
def test_points_lie_on_the_lamps_disc(size: float) -> None:
    """Unit directions within the disc, spread evenly over it: half of them within half its area."""
    generator = np.random.default_rng(int(size))
    for azimuth, elevation in ((0, 0), (0, 90), (180, -90), *generator.uniform(-90, 90, (10, 2))):
        light = Lamp(float(azimuth), float(elevation), size, power=2.5).light()
        towards = light_from_angles(float(azimuth), float(elevation))
        assert len(light.directions) == POINTS[size]
        assert torch.allclose(light.directions.norm(dim=1), torch.ones(POINTS[size]), atol=1e-5)
        away = torch.rad2deg(torch.arccos((light.directions @ towards).clamp(-1, 1)))
        assert away.max() <= size + 0.05
        if POINTS[size] > 1:
            assert away.max() > 0.9 * size
            assert abs(int((away < size / math.sqrt(2)).sum()) - POINTS[size] / 2) <= 1
            aside = (light.directions.mean(0) - towards * (light.directions @ towards).mean()).norm()
            assert float(aside) < 0.12 * math.radians(size)
        else:
            assert away.max() < 0.05
        assert (light.size == size).all()
        assert (light.source == 0).all()


def test_colour_keeps_luminance() -> None:
    """Power alone says how strong a lamp is; the colour's own scale is nothing."""
    generator = np.random.default_rng(0)
    luminance = torch.tensor(LUMINANCE)
    for _ in range(20):
        colour = tuple(generator.uniform(0, 3, 3).tolist())
        power, size = float(generator.uniform(0, 4)), float(generator.uniform(0, 90))
        weights = Lamp(20, 10, size, power, colour).light().weights
        assert float((weights @ luminance).sum()) == pytest.approx(power, rel=1e-5)
        assert torch.allclose(weights, Lamp(20, 10, size, power, tuple(7 * c for c in colour)).light().weights)
        assert torch.allclose(weights[0] * colour[0], weights[0, 0] * torch.tensor(colour), rtol=1e-4)
    assert sum(LUMINANCE) == pytest.approx(1)


def test_white() -> None:
    assert Lamp(30).light().white
    assert Lamp(30, colour=(0.3, 0.3, 0.3)).light().white
    assert not Lamp(30, colour=(1, 0.9, 0.8)).light().white
    assert scene_light([Lamp(30), Lamp(-30)], 0.2).white
    assert not scene_light([Lamp(30), Lamp(-30, colour=(1, 0, 0))], 0.2).white


def test_fill_is_a_dome() -> None:
    """As strong as it says, from all around the front, brighter above: 1 from the zenith to 0.2 from the nadir."""
    for strength in (0.1, 1.0):
        light = fill_light(strength)
        assert float(light.weights[:, 0].sum()) == pytest.approx(strength * FILL_STRENGTH, rel=1e-5)
        assert light.white
        assert (light.directions[:, 2] >= 0).all()
        middle = light.directions.mean(0)
        assert abs(float(middle[0])) < 0.05
        assert abs(float(middle[1])) < 0.05
        share = light.weights[:, 0] / (0.6 + 0.4 * light.directions[:, 1])
        assert torch.allclose(share, share[:1].expand_as(share), rtol=1e-4)


def test_scene_is_the_sum_of_its_sources() -> None:
    """Each at 1 - fill of its power, the fill on top; every source keeps its own number."""
    lamps = [Lamp(45, 0, 5, 2.0), Lamp(-45, 10, 15, 1.0, (1, 0.5, 0.2)), Lamp(0, 30, 1)]
    light = scene_light(lamps, 0.25)
    counts = [7, 13, 1, 24]
    assert len(light.directions) == len(light.weights) == len(light.size) == sum(counts)
    numbers = light.source.tolist()
    assert len(set(numbers)) == 4
    parts = torch.split(torch.arange(sum(counts)), counts)
    for part, lamp in zip(parts[:3], lamps, strict=True):
        assert len({numbers[i] for i in part}) == 1
        assert torch.equal(light.directions[part], lamp.light().directions)
        assert torch.allclose(light.weights[part], 0.75 * lamp.light().weights)
    assert torch.allclose(light.weights[parts[3]], fill_light(0.25).weights)
    assert len(scene_light(lamps, 0).directions) == 21
    assert not scene_light(lamps, 1).weights[:21].any()


def test_mixtures_keep_their_own_sources_apart() -> None:
    two = scene_light([Lamp(40), Lamp(-40)])
    assert sorted(set(two.source.tolist())) == [0, 1]
    four = scene_light([two, Lamp(10), two])
    assert [len(set(part.tolist())) for part in (four.source[:14], four.source[14:21], four.source[21:])] == [2, 1, 2]
    assert len(set(four.source.tolist())) == 5
    assert isinstance(four, LightMixture)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"azimuth": math.nan}, "azimuth: expected degrees"),
        ({"azimuth": math.inf}, "azimuth: expected degrees"),
        ({"azimuth": 181}, "azimuth: expected degrees"),
        ({"elevation": math.nan}, "elevation: expected degrees"),
        ({"elevation": -math.inf}, "elevation: expected degrees"),
        ({"elevation": 90.5}, "elevation: expected degrees"),
        ({"size": math.nan}, "size: expected an angular radius"),
        ({"size": -1}, "size: expected an angular radius"),
        ({"size": 90.1}, "size: expected an angular radius"),
        ({"power": -0.1}, "power: expected a finite number"),
        ({"power": math.nan}, "power: expected a finite number"),
        ({"power": math.inf}, "power: expected a finite number"),
        ({"colour": (0, 0, 0)}, "colour: expected three"),
        ({"colour": (1, 1)}, "colour: expected three"),
        ({"colour": (1, -1, 1)}, "colour: expected three"),
        ({"colour": (1, math.nan, 1)}, "colour: expected three"),
    ],
)
def test_bad_lamps_are_refused(arguments: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Lamp(**arguments)


@pytest.mark.parametrize("fill", [-0.01, 1.01, math.nan, math.inf])
def test_bad_fill_is_refused(fill: float) -> None:
    with pytest.raises(ValueError, match="fill: expected a share"):
        scene_light([Lamp()], fill)


def test_no_lights_are_refused() -> None:
    with pytest.raises(ValueError, match="lights: expected at least one Lamp"):
        scene_light([])


def test_lamps_at_the_ends_of_their_ranges() -> None:
    for lamp in (Lamp(180, 90, 90), Lamp(-180, -90, 0, 0.0), Lamp(0, 0, 0, 1e6)):
        light = lamp.light()
        assert torch.isfinite(light.directions).all()
        assert torch.isfinite(light.weights).all()
    azimuth, elevation = angles_from_light(Lamp(-120, -20, 0).light().directions[0])
    assert (float(azimuth), float(elevation)) == pytest.approx((-120, -20), abs=1e-3)
