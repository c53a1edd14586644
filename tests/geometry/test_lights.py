import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from facerelight.geometry.lights import (
    angles_from_light,
    angular_distance,
    even_hemisphere,
    hemisphere_moments,
    hemisphere_quadrature,
    light_from_angles,
    merge_repeats,
    thesis_grid,
)


def test_signs() -> None:
    """Positive azimuth is image-left (-x), positive elevation is up."""
    assert torch.allclose(light_from_angles(30.0, 0.0), torch.tensor([-0.5, 0.0, math.sqrt(0.75)]), atol=1e-6)
    assert light_from_angles(0.0, 45.0)[1] > 0


@given(st.floats(-179, 179), st.floats(-89, 89))
def test_angles_round_trip(azimuth: float, elevation: float) -> None:
    light = light_from_angles(torch.tensor(azimuth, dtype=torch.float64), torch.tensor(elevation, dtype=torch.float64))
    back = angles_from_light(light)
    assert abs(float(back[0]) - azimuth) < 1e-6
    assert abs(float(back[1]) - elevation) < 1e-6


def test_poles_have_azimuth_zero() -> None:
    assert angles_from_light(light_from_angles(77.0, 90.0))[0] == 0


@pytest.mark.parametrize("elevation", [91.0, float("nan")])
def test_bad_angles(elevation: float) -> None:
    with pytest.raises(ValueError, match=r"elevation|angles"):
        light_from_angles(0.0, elevation)


def test_thesis_grid_repeats_its_poles() -> None:
    grid = thesis_grid()
    distinct, index = merge_repeats(grid)
    assert grid.shape == (101, 3)
    assert distinct.shape == (83, 3)
    assert torch.allclose(distinct[index], grid, atol=1e-6)


def test_even_hemisphere_is_even() -> None:
    lights = even_hemisphere(200)
    assert torch.allclose(lights[0], torch.tensor([0.0, 0.0, 1.0]))
    assert (lights[:, 2] >= 0).all()
    mean, second = hemisphere_moments()
    assert torch.allclose(lights.mean(0), mean, atol=0.01)
    assert torch.allclose(lights.T @ lights / 200, second, atol=0.01)


def test_quadrature_matches_monte_carlo_and_appendix_b() -> None:
    nodes, weights = hemisphere_quadrature(6)
    mean, second = hemisphere_moments()
    assert torch.allclose(weights @ nodes, mean, atol=1e-6)
    assert torch.allclose((nodes * weights[:, None]).T @ nodes, second, atol=1e-6)


def test_angular_distance_of_near_lights() -> None:
    a = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    b = torch.tensor([1e-8, 0.0, 1.0], dtype=torch.float64)
    assert abs(float(angular_distance(a, b)) - math.degrees(1e-8)) < 1e-12
    with pytest.raises(ValueError, match="non-zero"):
        angular_distance(a, 0 * a)
