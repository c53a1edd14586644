"""Shadows and shading of analytic shapes, and of random heights against rays marched in tiny steps."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from facerelight.geometry.lights import light_from_angles
from facerelight.geometry.sources import Lamp
from facerelight.photo.bust.frame import BUST, FINE, Grid
from facerelight.photo.bust.shading import (
    COARSE_BIAS,
    DEPTH,
    FINE_BIAS,
    REACH,
    WRAP,
    BustShading,
    horizon,
    visible_share,
)
from facerelight.photo.bust.surface import BELOW, Bust

DENSITY = 32
MARCH = {"first": 0.03, "growth": 1.035, "bias": FINE_BIAS}


def light_at(azimuth: float, elevation: float) -> np.ndarray:
    return light_from_angles(float(azimuth), float(elevation)).numpy()


@pytest.mark.parametrize("degrees", [0, 90, 180, 270, 45, 200])
@pytest.mark.parametrize("high", [0.3, 1.0, 2.5])
def test_horizon_of_a_wall(degrees: float, high: float) -> None:
    """atan(height / distance), the distance known to one step and a pixel, in any direction; none away from it."""
    towards = float(np.cos(np.deg2rad(degrees))), float(np.sin(np.deg2rad(degrees)))
    x, y = Grid(3.0, 3.0, -3.0, DENSITY).places()
    distance = 1.0 - (x * towards[0] + y * towards[1])  # to the wall, one unit off the middle
    height = np.where(distance < 0, high, 0).astype(np.float32)
    near = np.hypot(x, y) < 0.8
    found, distance = horizon(height, DENSITY, towards, **MARCH)[near], distance[near]
    farther = distance + 0.03 + 0.035 * distance + 1 / DENSITY
    assert (found <= np.arctan(high / (distance - 1.5 / DENSITY))).all()
    assert (found >= np.arctan((high - FINE_BIAS) / farther) - 1e-3).all()
    assert np.degrees(np.abs(found - np.arctan(high / distance)).mean()) < 2
    away = horizon(height, DENSITY, (-towards[0], -towards[1]), **MARCH)[near]
    assert np.abs(away).max() < 0.01


def test_horizon_ends_at_its_reach_and_at_the_border() -> None:
    """A wall farther off than the reach shades nothing; beyond the picture nothing is."""
    x, _ = Grid(5.0, 0.5, -0.5, DENSITY).places()
    height = np.where(x > 4.0, 3.0, 0.0).astype(np.float32)
    found = horizon(height, DENSITY, (1.0, 0.0), **MARCH)[DENSITY // 2]
    at = np.searchsorted(x[0], [4.0 - REACH - 0.3, 4.0 - REACH + 0.4])
    assert abs(found[at[0]]) < 0.01
    assert found[at[1]] > 0.5
    flat = horizon(np.zeros((40, 40), np.float32), DENSITY, (0.0, 1.0), **MARCH)
    assert flat[0].max() < -1  # beyond the upper border it falls away
    assert abs(flat[5:]).max() < 0.04


def test_small_steps_shade_nothing() -> None:
    x, _ = Grid(1.0, 0.2, -0.2, DENSITY).places()
    for rise, shaded in ((0.04, False), (0.5, True)):
        ends = horizon(np.where(x > 0, rise, 0).astype(np.float32), DENSITY, (1.0, 0.0), 0.08, 1.06, COARSE_BIAS)
        assert bool((ends > 0).any()) == shaded


def test_horizon_against_rays_in_tiny_steps() -> None:
    """Smooth random heights; 3 degrees for 99 of 100 places."""
    generator = np.random.default_rng(1)
    x, y = Grid(2.0, 2.0, -2.0, DENSITY).places()
    height = np.zeros_like(x)
    for _ in range(12):
        place, width = generator.uniform(-1.5, 1.5, 2), generator.uniform(0.2, 0.6)
        height = height + generator.uniform(-0.5, 1) * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / width**2)
    height = height.astype(np.float32)
    rows, columns = np.mgrid[40:90:3, 40:90:3]
    for degrees in generator.uniform(0, 360, 4):
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        steps = np.arange(0.03, REACH, 0.006)[:, None, None]
        there = map_coordinates(
            height, (rows - steps * s * DENSITY, columns + steps * c * DENSITY), order=1, mode="constant", cval=BELOW
        )
        truth = np.arctan(((there - height[rows, columns] - FINE_BIAS) / steps).max(0))
        gap = np.degrees(np.abs(horizon(height, DENSITY, (float(c), float(s)), **MARCH)[rows, columns] - truth))
        assert np.quantile(gap, 0.99) < 3
        assert gap.mean() < 0.5


def test_visible_share_of_a_disc() -> None:
    ends = np.deg2rad(np.linspace(-40, 90, 131)).astype(np.float32)
    light = light_at(0, 30)[[2, 0, 1]]  # 30 degrees above the plane, towards +x
    assert np.degrees(np.arctan2(light[2], np.hypot(light[0], light[1]))) == pytest.approx(30, abs=1e-4)
    widths = []
    for size in (1.0, 5.0, 20.0):
        share = visible_share(ends, light, size)
        assert share[70] == pytest.approx(0.5, abs=1e-3)  # the horizon halves it
        assert (np.diff(share) <= 0).all()
        assert (share[np.degrees(ends) < 30 - size - 0.1] == 1).all()
        assert (share[np.degrees(ends) > 30 + size + 0.1] == 0).all()
        between = (share > 0) & (share < 1)
        widths.append(int(between.sum()))
    assert widths[0] < widths[1] < widths[2]
    assert widths[2] == pytest.approx(40, abs=2)
    assert set(np.round(visible_share(ends, light, 0.0), 3)) == {0.0, 0.5, 1.0}
    assert np.allclose(visible_share(ends, 7 * light, 5), visible_share(ends, light, 5), atol=1e-5)
    assert (visible_share(np.zeros(3, np.float32), light_at(0, -30)[[2, 0, 1]], 5) == 0).all()


def bust_of(surface) -> Bust:
    """From a function of x and y to height, normal and where the person is."""
    height, normal, inside = surface(*BUST.places())
    fine, fine_normal, _ = surface(*FINE.places())
    inside = inside.astype(np.float32)
    return Bust(normal, height, inside, fine, fine_normal)


def ball(x: np.ndarray, y: np.ndarray):
    """Of radius 1.5."""
    inside = np.hypot(x, y) < 1.5
    z = np.sqrt(np.clip(1.5**2 - x**2 - y**2, 0, None))
    normal = np.where(inside[..., None], np.stack((x, y, z), -1) / 1.5, 0)
    return np.where(inside, z, BELOW).astype(np.float32), normal.astype(np.float32), inside


def step(x: np.ndarray, y: np.ndarray):
    """A floor, and a wall one unit high at x > 0."""
    normal = np.zeros((*x.shape, 3), np.float32)
    normal[..., 2] = 1
    return np.where(x > 0, 1.0, 0.0).astype(np.float32), normal, np.ones(x.shape, bool)


@pytest.mark.parametrize(("azimuth", "elevation"), [(90, 0), (-90, 0), (0, 80), (0, -80), (50, 30)])
def test_ball_is_bright_where_the_lamp_stands(azimuth: float, elevation: float) -> None:
    """+90 is image-left. On the lit half the shading is Lambert's, on the other it is dark."""
    light = light_at(azimuth, elevation)
    shading = BustShading(bust_of(ball))
    for grid, image in (
        (BUST, shading.shade(light, 5)),
        (FINE, shading.fine_lambert(light) * shading.fine_visibility(light, 5)),
    ):
        x, y = grid.places()
        inside = np.hypot(x, y) < 1.35
        facing = np.stack((x, y, np.sqrt(np.clip(2.25 - x**2 - y**2, 0, None))), -1) @ light / 1.5
        lit, dark = inside & (facing > 0.25), inside & (facing < -0.25)
        assert np.abs(image - facing)[lit].max() < 0.04
        assert not dark.any() or image[dark].max() == 0
    if (azimuth, elevation) == (90, 0):
        x, y = FINE.places()
        left, right = ((np.hypot(x - side, y) < 0.3) for side in (-0.9, 0.9))
        assert image[left].mean() > 0.5
        assert image[right].max() == 0


def test_lambert_is_wrapped_but_slightly() -> None:
    """1 facing the lamp, 0 just behind the terminator, linear between."""
    shading = BustShading(bust_of(ball))
    light = light_at(90, 0)
    x, y = FINE.places()
    inside = np.hypot(x, y) < 1.45
    wanted = np.clip((-x / 1.5 + WRAP) / (1 + WRAP), 0, None)
    assert 0 < WRAP < 0.05
    assert np.abs(shading.fine_lambert(light) - wanted)[inside].max() < 1e-4
    assert shading.fine_lambert(light)[inside].max() < 1


def test_cast_shadow_of_a_wall() -> None:
    """A lamp 30 degrees above the floor, behind the wall: dark up to 1 / tan 30 = 1.73 units from it, lit beyond."""
    shading = BustShading(bust_of(step))
    light = light_at(-60, 0)  # from image-right, where the wall stands
    edge = -1 / np.tan(np.deg2rad(30))
    x, y = FINE.places()
    seen, middle = shading.fine_visibility(light, 1), np.abs(y + 1) < 1
    dark, lit = (x > edge + 0.2) & (x < -0.1), (x < edge - 0.4) & (x > -2.2)
    soft = np.hypot(x / 1.6, (y + 0.9) / 2.3) < 0.8  # where shadows are drawn sharply
    assert seen[dark & middle & soft].max() < 0.02
    assert seen[(x > 0.1) & (x < 1) & middle].min() > 0.98
    x, y = BUST.places()
    floor = (WRAP + 0.5) / (1 + WRAP)
    shade, middle = shading.shade(light, 1), np.abs(y + 1) < 1
    dark, lit = (x > edge + 0.4) & (x < -0.2), (x < edge - 0.5) & (x > -3)
    assert np.abs(shade[dark & middle] / floor - (1 - DEPTH)).max() < 0.05
    assert np.abs(shade[dark & middle] / floor - (1 - DEPTH)).mean() < 0.005
    assert np.abs(shade[lit & middle] / floor - 1).max() < 0.02
    other = shading.shade(light_at(60, 0), 1)
    assert other[dark & middle].min() > 0.98 * floor


def test_shadow_ends_where_it_should() -> None:
    """A wall one unit high under lamps at 40, 45 and 55 degrees: half light at 1 / tan of them, within 0.08 units."""
    shading = BustShading(bust_of(step))
    row = int((FINE.top + 0.9) * FINE.density)
    x = FINE.places()[0][row]
    for rise in (40, 45, 55):
        seen = shading.fine_visibility(light_at(rise - 90, 0), 1)[row]
        first = np.flatnonzero((x < -0.05) & (seen < 0.5))[0]
        assert x[first] == pytest.approx(-1 / np.tan(np.deg2rad(rise)), abs=0.08)


def test_larger_lamps_cast_softer_shadows() -> None:
    """The lighter half of the shadow's edge, from 10 to 90 of 100, widens with the lamp."""
    shading = BustShading(bust_of(step))
    light, row = light_at(-30, 0), int((FINE.top + 0.9) * FINE.density)
    x = FINE.places()[0][row]
    widths = []
    for size in (1, 6, 15):
        seen = shading.fine_visibility(light, size)[row]
        edge = (x > -1.5) & (x < -0.05) & (seen > 0.1) & (seen < 0.9)
        widths.append(int(edge.sum()))
    assert widths[0] < 0.6 * widths[1] < 0.4 * widths[2]


def test_lamp_at_the_camera_sees_all() -> None:
    """What the camera sees it lights: nothing is marched, and a small lamp's picture is the one of the full march."""
    bust = bust_of(ball)
    quick, full = BustShading(bust), BustShading(bust, exhaustive=True)
    light = np.array((0.0, 0.0, 1.0), np.float32)
    x, y = FINE.places()
    inside = np.hypot(x, y) < 1.4
    assert (quick.fine_visibility(light, 1) == 1).all()
    quick.shade(light, 1)
    assert quick.marches == 0
    assert np.abs(full.fine_visibility(light, 1) - 1)[inside].max() < 1e-3
    x, y = BUST.places()
    assert np.abs(full.shade(light, 1) - quick.shade(light, 1))[np.hypot(x, y) < 1.2].max() < 1e-3
    assert full.marches > 0
    behind = np.array((0.0, 0.0, -1.0), np.float32)
    quick.fine_visibility(behind, 1)
    assert quick.marches == 1
    assert quick.fine_visibility(behind, 1)[inside[: FINE.size[0]]].max() == 0


def test_horizons_are_marched_once() -> None:
    shading = BustShading(bust_of(ball))
    light = light_at(60, 20)
    first = shading.fine_visibility(light, 5), shading.shade(light, 20)
    marched = shading.marches
    assert marched == 3  # one fine, two coarse neighbours
    again = shading.fine_visibility(light, 5), shading.shade(light, 20)
    assert shading.marches == marched
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))


def test_between_marched_azimuths() -> None:
    """The coarse horizon, marched on a smaller map in some directions and interpolated, is near the fine one."""
    bust = bust_of(ball)
    shading = BustShading(bust)
    x, y = BUST.places()
    inside = np.hypot(x, y) < 1.4
    for turn in (0, np.pi / 8, np.pi / 16, -2.0):
        towards = float(np.cos(turn)), float(np.sin(turn))
        truth = horizon(bust.height, BUST.density, towards, 0.08, 1.06, COARSE_BIAS)
        gap = np.degrees(np.abs(shading._horizon(turn) - truth))[inside]
        assert gap.max() < 12  # at the ball's own outline
        assert np.quantile(gap, 0.99) < 6
        assert gap.mean() < 1


@pytest.mark.parametrize("light", [(-1, 0, 0), (0, 0, -1), (0, 1, 0), (0, -1, 0), (0, 0, 1)])
@pytest.mark.parametrize("size", [0, 90])
def test_any_lamp_is_finite(light: tuple[float, float, float], size: float) -> None:
    shading = BustShading(bust_of(ball))
    vector = np.array(light, np.float32)
    for image in (shading.shade(vector, size), shading.fine_visibility(vector, size), shading.fine_lambert(vector)):
        assert np.isfinite(image).all()
        assert image.min() >= 0
        assert image.max() <= 1.001


def test_points_of_a_lamp_agree_with_its_middle() -> None:
    """A lamp's disc of points averages to the lamp's own direction."""
    points = Lamp(40, 20, size=15).light().directions.numpy().mean(0)
    middle = points / np.linalg.norm(points)
    assert np.degrees(np.arccos(middle @ light_at(40, 20))) < 1.5
