"""The light told by the model: against a dense Gaussian, against the kernel estimator, and its samples' calibration."""

import pytest
import torch
from conftest import shaded_people

from facerelight.geometry.lights import angular_distance, even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.statistics import FaceStatistics


@pytest.fixture(scope="module")
def estimator(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> LikelihoodIlluminationEstimator:
    return LikelihoodIlluminationEstimator(statistics, count=120).calibrate(people[12:], lights)


def test_likelihood_is_that_of_a_dense_gaussian(
    estimator: LikelihoodIlluminationEstimator, people: torch.Tensor
) -> None:
    """``N(g mean, g^2 D (I + A A^T / T) D)`` at the fitted gain, written out; differences over the grid within 1e-3 of
    log likelihood."""
    image = people[13, 7]
    ours = estimator.log_likelihood(image[None])[0]
    y = image.flatten()[estimator.places].double()
    temper = max(1.0, 100 / 8064 * len(y))
    dense = []
    for mean, std, white in zip(
        estimator.mean.double(), estimator.std.double(), estimator.loadings.double(), strict=True
    ):
        gain = ((y / std) @ (mean / std)) / (mean / std).square().sum()
        gain = gain.clamp_min(1e-3)
        root = gain * std
        covariance = root[:, None] * (torch.eye(len(y), dtype=torch.float64) + white @ white.T / temper) * root
        dense.append(torch.distributions.MultivariateNormal(gain * mean, covariance).log_prob(y))
    dense = torch.stack(dense)
    difference = (ours - dense) - (ours - dense).mean()
    assert difference.abs().max() < 1e-3 * dense.abs().max()
    assert int(ours.argmax()) == int(dense.argmax())


def test_finds_the_light_of_new_people_whatever_their_brightness(
    estimator: LikelihoodIlluminationEstimator, people: torch.Tensor, lights: torch.Tensor
) -> None:
    strangers = shaded_people(4, lights, 9)
    found = estimator(strangers).direction
    error = angular_distance(found, lights.expand_as(found))
    kernel = KernelIlluminationEstimator.fit(people[:12], lights)(strangers).direction
    assert error.median() < 10
    assert error.median() < angular_distance(kernel, lights.expand_as(kernel)).median()
    assert torch.allclose(estimator(0.3 * strangers).direction, found, atol=1e-3)


def test_true_lights_lie_where_the_samples_do(estimator: LikelihoodIlluminationEstimator, lights: torch.Tensor) -> None:
    """The 90 % circle of the samples holds 75 to 100 % of the true lights of 8 strangers under 30 lights."""
    strangers = shaded_people(8, lights, 11)
    drawn = estimator.sample(strangers, 64)  # (B, M, K, 3)
    middle = estimator(strangers).direction
    radius = angular_distance(drawn, middle[:, None].expand_as(drawn)).quantile(0.9, dim=1)
    inside = angular_distance(middle, lights.expand_as(middle)) <= radius
    assert 0.75 <= float(inside.float().mean()) <= 1


def test_samples_repeat_and_follow_the_posterior(
    estimator: LikelihoodIlluminationEstimator, people: torch.Tensor
) -> None:
    image = people[14:15, 5:6]
    a, b = estimator.sample(image, 256), estimator.sample(image, 256)
    assert torch.equal(a, b)
    probability = estimator.posterior(image[0])[0]
    expected = torch.nn.functional.normalize(probability.float() @ estimator.grid, dim=0)
    assert angular_distance(torch.nn.functional.normalize(a[0, :, 0].mean(0), dim=0), expected) < 3
    free = estimator.sample(image, 4000, torch.Generator().manual_seed(1), independent=True)
    assert angular_distance(torch.nn.functional.normalize(free[0, :, 0].mean(0), dim=0), expected) < 3


def test_black_image_has_no_light_and_masked_pixels_do_not_count(
    estimator: LikelihoodIlluminationEstimator, people: torch.Tensor
) -> None:
    black = torch.zeros(1, 1, 24, 21)
    assert torch.equal(estimator(black).direction, torch.zeros(1, 1, 3))
    assert torch.equal(estimator.sample(black, 4), torch.zeros(1, 4, 1, 3))
    mask = torch.ones(1, 24, 21)
    mask[:, :6] = 0
    image = people[13:14, 4:5].clone()
    spoiled = image.clone()
    spoiled[:, :, :6] = 3.0
    assert torch.allclose(estimator(image, mask).direction, estimator(spoiled, mask).direction, atol=1e-5)


def test_serves_the_relighter_in_the_kernel_estimators_place(
    estimator: LikelihoodIlluminationEstimator, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    relighter = StatisticalRelighter(statistics, "face", estimator)
    target = even_hemisphere(5)
    unknown = relighter.condition(people[12:13, :1], draws=16).mean(target)
    known = relighter.condition(people[12:13, :1], lights[:1]).mean(target)
    assert (unknown - known).abs().mean() < 0.05
