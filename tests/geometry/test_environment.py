"""Environment maps as light: against explicit sums over their pixels, turned and mirrored, and hard cases."""

import math

import pytest
import torch

from facerelight.geometry.environment import environment_light, even_light, map_directions, paint_environment
from facerelight.geometry.lights import angular_distance, even_hemisphere, light_from_angles
from facerelight.geometry.sources import LightMixture
from facerelight.geometry.studio import STUDIO, studio_lamps

NORMALS = torch.cat((even_hemisphere(40), -even_hemisphere(40))).double()


def irradiance(light: LightMixture) -> torch.Tensor:
    """Of white Lambertian surfaces that face ``NORMALS``, ``(80, 3)``."""
    return (NORMALS @ light.directions.double().T).clamp_min(0) @ light.weights.double()


def explicit(radiance: torch.Tensor) -> torch.Tensor:
    """The same, pixel by pixel of a map, so that what faces the camera gets 1."""
    height, width = radiance.shape[:2]
    lat = math.pi * (torch.arange(height).double() + 0.5) / height
    weights = (radiance.double() * lat.sin()[:, None, None]).flatten(0, 1)
    directions = map_directions(height, width).double().flatten(0, 1)
    front = float((weights.mean(1) * directions[:, 2].clamp_min(0)).sum())
    return (NORMALS @ directions.T).clamp_min(0) @ weights / front


@pytest.fixture(scope="module")
def sky() -> torch.Tensor:
    """A bright window, a blue sky and a warm floor."""
    directions = map_directions(64, 128).double()
    window = torch.exp(20 * (directions @ light_from_angles(50.0, 15.0).double() - 1))
    up = directions[..., 1].clamp_min(0)
    return window[..., None] * 5 + up[..., None] * torch.tensor([0.3, 0.5, 1.0]) + 0.05 * torch.tensor([1.0, 0.6, 0.3])


def test_it_is_the_sum_over_the_pixels(sky: torch.Tensor) -> None:
    found, expected = irradiance(environment_light(sky)), explicit(sky)
    assert float((found - expected).abs().max()) < 0.03 * float(expected.max())


@pytest.mark.parametrize("turn", [90.0, 180.0, -90.0])
def test_a_turned_map_is_turned_light(sky: torch.Tensor, turn: float) -> None:
    """By the turn, and by rolling the picture; strength is per map, and so only shares are compared."""
    rolled = torch.roll(sky, round(turn / 360 * 128), dims=1)
    one, other = environment_light(sky, turn=turn), environment_light(rolled)
    assert torch.allclose(irradiance(one), irradiance(other), rtol=1e-4)
    plain = environment_light(sky)
    back = light_from_angles(torch.tensor(turn), torch.tensor(0.0)).double()  # where the camera's axis went
    quarter = torch.stack((torch.tensor([back[2], 0, back[0] * -1]), torch.tensor([0.0, 1, 0]).double(), back))
    turned = plain.directions.double() @ torch.stack((torch.tensor([back[2], 0, -back[0]]), quarter[1], back))
    share = plain.weights.sum(1) / plain.weights.sum()
    moved = one.weights.sum(1) / one.weights.sum()
    assert torch.allclose(share.double() @ turned, moved.double() @ one.directions.double(), atol=1e-5)


def test_a_mirrored_map_is_mirrored_light(sky: torch.Tensor) -> None:
    plain, mirrored = environment_light(sky), environment_light(sky.flip(1))
    flip = torch.tensor((-1.0, 1.0, 1.0))
    for normal in NORMALS.float():
        one = (plain.directions @ normal).clamp_min(0) @ plain.weights
        other = (mirrored.directions @ (flip * normal)).clamp_min(0) @ mirrored.weights
        assert torch.allclose(one, other, rtol=1e-4)


def test_the_right_half_of_a_map_lights_from_image_left() -> None:
    radiance = torch.zeros(16, 32)
    radiance[8, 20] = 1.0
    light = environment_light(radiance)
    brightest = light.directions[light.weights[:, 0].argmax()]
    assert brightest[0] < -0.5


def test_a_constant_map_is_even_light() -> None:
    even, constant = irradiance(even_light()), irradiance(environment_light(torch.full((20, 40, 3), 7.5)))
    assert torch.allclose(even, constant, rtol=0.02)
    assert torch.allclose(even, torch.ones_like(even), atol=0.03)  # whatever way a surface faces


def test_exposure_is_in_stops(sky: torch.Tensor) -> None:
    assert torch.allclose(environment_light(sky, exposure=1).weights, 2 * environment_light(sky).weights)


@pytest.mark.parametrize(
    ("radiance", "said"),
    [
        (torch.zeros(16, 32), "some light"),
        (torch.full((16, 32), torch.nan), "NaN"),
        (-torch.ones(16, 32), "negative"),
        (torch.full((16, 32), torch.inf), "infinite"),
        (torch.ones(4, 8), "at least 8 x 16"),
        (torch.ones(16, 32, 4), r"\(H, W, 3\)"),
        (torch.cat((torch.ones(16, 4), torch.zeros(16, 24), torch.ones(16, 4)), 1), "in front"),
    ],
    ids=["black", "nan", "negative", "infinite", "small", "alpha", "behind"],
)
def test_maps_that_cannot_be_used(radiance: torch.Tensor, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        environment_light(radiance)


def test_one_bright_pixel_keeps_its_place() -> None:
    """A sun is where it is, however large the cell."""
    radiance = torch.full((64, 128), 1e-4)
    radiance[20, 85] = 1e6
    light = environment_light(radiance)
    at = map_directions(64, 128)[20, 85]
    brightest = light.directions[light.weights[:, 0].argmax()]
    assert float(torch.rad2deg(torch.acos((brightest @ at.float()).clamp(-1, 1)))) < 0.1
    assert torch.isfinite(light.weights).all()


@pytest.mark.parametrize("name", STUDIO)
def test_set_ups_have_a_mirror_image(name: str) -> None:
    lamps, mirrored = studio_lamps(name), studio_lamps(name, mirrored=True)
    assert [lamp.azimuth for lamp in mirrored] == [-lamp.azimuth for lamp in lamps]
    assert sum(lamp.power for lamp in lamps if abs(lamp.azimuth) < 90) < 2  # those behind light the rim alone
    assert max(lamp.power for lamp in lamps) < 2


def test_an_unknown_set_up_is_named() -> None:
    with pytest.raises(ValueError, match="rembrandt"):
        studio_lamps("paramount")


@pytest.mark.parametrize("height", [32, 128])
def test_a_painted_light_is_read_as_itself(height: int) -> None:
    lights, facing = even_hemisphere(64), even_hemisphere(200)
    generator = torch.Generator().manual_seed(height)
    for towards in ((-0.6, 0.3, 0.7), (0.9, 0.1, 0.2), (0.0, 0.9, 0.4)):
        middle = torch.nn.functional.normalize(torch.tensor(towards), dim=0)
        amounts = torch.exp(8 * (lights @ middle - 1)) + 0.02
        weights = amounts[:, None] * (1 + 0.4 * torch.rand(64, 3, generator=generator))
        light = LightMixture(lights, weights, torch.full((64,), 20.0), torch.zeros(64, dtype=torch.long))
        read = environment_light(paint_environment(light, height))
        given, found = ((facing @ one.directions.T).clamp_min(0) @ one.weights for one in (light, read))
        found = found * (given.sum() / found.sum())
        assert (found - given).square().mean().sqrt() < 0.02 * given.square().mean().sqrt()
        vectors = (one.weights.mean(1) @ one.directions for one in (light, read))
        assert float(angular_distance(*vectors)) < 0.2


def test_what_cannot_be_painted() -> None:
    with pytest.raises(ValueError, match="at least 8 rows, got 4"):
        paint_environment(even_light(), 4)
    with pytest.raises(ValueError, match="expected some light"):
        paint_environment(even_light()._replace(weights=torch.zeros(80, 3)))
