"""The kernel estimator against slow NumPy, and its error against what it truly makes; errors of several lights."""

import copy

import numpy as np
import pytest
import torch
from conftest import SIZE, shaded_people

from facerelight.geometry.lights import angular_distance, light_from_angles
from facerelight.light.estimator import GaussianBelief, shared_errors
from facerelight.light.kernel import KernelIlluminationEstimator


def regressed(point: np.ndarray, points: np.ndarray, lights: np.ndarray, neighbours: int) -> np.ndarray:
    """(4.4): lights by how near their images are, each reaching to its own neighbour."""
    between = np.sqrt(((points[:, None] - points[None]) ** 2).sum(2))
    widths = np.sort(between, 1)[:, neighbours]
    kernel = np.exp(-0.5 * ((point - points) ** 2).sum(1) / widths**2)
    mean = (kernel[:, None] * lights).sum(0)
    return mean / np.linalg.norm(mean)


def unit(images: np.ndarray) -> np.ndarray:
    rows = images.reshape(len(images), -1)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def test_bias_and_error_are_those_of_people_left_out(people: torch.Tensor, lights: torch.Tensor) -> None:
    """Every person in turn, in float64; what comes out is the regression with the bias taken off."""
    few, s = people[:4, ::3], lights[::3].double().numpy()
    estimator = KernelIlluminationEstimator.fit(few, lights[::3], fraction=0.1, thumbnail=SIZE, folds=4)
    errors = []
    for out in range(4):
        others = few[[i for i in range(4) if i != out]].double().numpy()
        points, there = unit(others.reshape(-1, *SIZE)), np.tile(s, (3, 1))
        for point, light in zip(unit(few[out].double().numpy()), s, strict=True):
            errors.append(light - regressed(point, points, there, round(0.1 * len(points))))
    error = np.array(errors)
    assert np.allclose(estimator.bias, error.mean(0), atol=1e-4)
    assert np.allclose(estimator.error_factor @ estimator.error_factor.T, np.cov(error.T), atol=1e-4)
    assert np.abs(error.mean(0)).max() > 0.01
    every = unit(few.double().numpy().reshape(-1, *SIZE))
    probe = people[8, 4:5].double().numpy()
    found = regressed(unit(probe)[0], every, np.tile(s, (4, 1)), round(0.1 * len(every))) + error.mean(0)
    made = estimator(people[8:9, 4:5]).direction[0, 0]
    assert np.allclose(made, found / np.linalg.norm(found), atol=1e-4)


def test_the_bias_is_taken_off_new_people() -> None:
    """Lights of one side alone: a regression draws to their middle, and the bias leads back as far as the sphere
    lets it."""
    rim = torch.stack([light_from_angles(float(a), 0.0) for a in range(15, 90, 6)])
    estimator = KernelIlluminationEstimator.fit(shaded_people(20, rim, 3), rim, fraction=0.15)
    strangers, plain = shaded_people(30, rim, 4), copy.deepcopy(estimator)
    plain.bias.zero_()
    error = [(rim - each(strangers).direction).mean((0, 1)) for each in (plain, estimator)]
    assert error[0].norm() > 0.02
    assert error[1].norm() < 0.7 * error[0].norm()


def test_the_error_learned_is_the_error_made(lights: torch.Tensor) -> None:
    """Over strangers, component by component within a quarter; and the draws spread as much."""
    estimator = KernelIlluminationEstimator.fit(shaded_people(30, lights, 5), lights)
    strangers = shaded_people(30, lights, 6)
    error = (lights - estimator(strangers).direction).flatten(0, 1)
    learned = estimator.error_factor.square().sum(1).sqrt()
    assert torch.allclose(learned, error.std(0), rtol=0.25)
    belief = estimator.locate(strangers[:1, :1])
    drawn = belief.draw(40_000, torch.Generator().manual_seed(0), True)[0, :, 0] - belief.direction[0, 0]
    assert torch.allclose(drawn.T.cov(), estimator.error_factor @ estimator.error_factor.T, atol=3e-4, rtol=0.03)


def test_errors_go_together_as_lights_are_near() -> None:
    """Correlations at 11, 40 and 75 degrees, and of the draws; a light that is known to no error has none."""
    angles = (0.0, 11.0, 40.0, 75.0)
    lights = torch.stack([light_from_angles(angle, 0.0) for angle in angles]).double()
    factor = shared_errors(lights[None])[0]
    correlation = factor @ factor.T
    for other, expected in ((1, 0.98), (2, 0.77), (3, 0.44)):
        chord = 2 * np.sin(np.deg2rad(angles[other]) / 2)
        assert float(correlation[0, other]) == pytest.approx(np.exp(-0.5 * (chord / 0.95) ** 2), abs=1e-4)
        assert float(correlation[0, other]) == pytest.approx(expected, abs=0.01)
    root = torch.tensor([[0.1, 0.0, 0.0], [0.03, 0.2, 0.0], [0.0, 0.0, 0.05]]).double()
    drawn = GaussianBelief(lights[None], root).draw(40_000, torch.Generator().manual_seed(0), True)[0] - lights
    for a in range(4):
        for b in range(4):
            shared = torch.einsum("mi,mj->ij", drawn[:, a], drawn[:, b]) / len(drawn)
            assert torch.allclose(shared, correlation[a, b] * (root @ root.T), atol=1.2e-3)
    same = GaussianBelief(lights[None], 0 * root).draw(3, None, False)
    assert angular_distance(same[0], lights.expand(3, -1, -1)).max() < 1e-3
