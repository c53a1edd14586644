"""Noise of the inputs, and what the predictive variance counts: gain, light, noise."""

import pytest
import torch
from conftest import shaded_people

from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.estimator import GaussianBelief, shared_errors
from facerelight.model.statistics import FaceStatistics

MODELS = ["pixel", "face"]


def half_a_degree_apart(light: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.stack((light, light + torch.tensor([0.0087, 0.0, 0.0]))), dim=-1)


@pytest.mark.parametrize("model", MODELS)
def test_rounded_images_under_nearly_one_light_do_not_hurt(
    statistics: FaceStatistics, lights: torch.Tensor, model: str
) -> None:
    sources = half_a_degree_apart(lights[4])
    every = shaded_people(16, torch.cat((sources, lights[9:10])), 0)[12:]
    rounded = (every * 255).round() / 255

    def error(inputs: int, noise: float) -> float:
        relighter = StatisticalRelighter(statistics, model, noise=noise)
        made = relighter.condition(rounded[:, :inputs], sources[:inputs]).mean(lights[9:10])
        return float((made - every[:, 2:]).square().mean().sqrt() * 255)

    assert error(2, 1.0) <= error(1, 1.0) + 0.2
    assert error(2, 0.0) > error(1, 0.0) + 0.2  # what noise is for


@pytest.mark.parametrize("model", MODELS)
def test_by_default_inputs_come_back_within_a_grey_level_and_noise_scales_with_exposure(
    people: torch.Tensor, lights: torch.Tensor, model: str
) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, brightness=True)
    relighter = StatisticalRelighter(statistics, model)
    made = relighter.condition(people[13:14, :1], lights[:1]).mean(lights[:1])
    assert 0 < (made - people[13:14, :1]).square().mean().sqrt() < 1 / 255
    finer = StatisticalRelighter(statistics, model, noise=0.5)
    scaled = finer.condition(people[13:14, :1], lights[:1], noise=torch.full((1, 1), 2.0 * 0.5 / 255))
    assert torch.allclose(scaled.mean(lights[:2]), relighter.condition(people[13:14, :1], lights[:1]).mean(lights[:2]))


@pytest.mark.parametrize("model", MODELS)
def test_variance_counts_the_gain_and_stays_below_the_prior(
    people: torch.Tensor, lights: torch.Tensor, model: str
) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, brightness=True)
    relighter = StatisticalRelighter(statistics, model)
    prior = relighter(people[12:13, :1], lights, source_lights=torch.zeros(1, 3))
    spread = float(statistics.gain_spread)
    assert (prior.variance >= spread**2 * prior.mean.square()).all()
    for gain in (0.6, 1.0, 1.6):
        posterior = relighter(gain * people[12:13, :1], lights, source_lights=lights[:1])
        assert (posterior.variance <= max(1.0, 1.2 * gain) ** 2 * prior.variance).all()
    noisy = relighter(people[12:13, :1], lights[:1], source_lights=lights[:1]).variance
    assert (noisy >= (1 / 255) ** 2 * 0.999).all()


def test_mle_knows_that_statistics_are_of_one_brightness(people: torch.Tensor, lights: torch.Tensor) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, brightness=True)
    relighter = StatisticalRelighter(statistics, noise=0)
    sources = lights[[0, 4, 9, 15]]
    images = people[12:13, [0, 4, 9, 15]]
    plain, bright = (relighter(g * images, lights[20:21], source_lights=sources, method="mle").mean for g in (1.0, 1.5))
    assert (bright / 1.5 - plain).abs().mean() * 255 < 0.5
    back = relighter(1.5 * images, sources, source_lights=sources, method="mle")
    assert (back.mean - 1.5 * images).abs().max() < 0.5 / 255
    assert back.variance.max() < 1e-6


def test_every_hypothesis_of_a_known_light_meets_the_unknown_one(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    tried = torch.full((1, 8, 2, 3), torch.nan)
    tried[0, :, 0] = lights[:8]
    posterior = StatisticalRelighter(statistics).condition(people[12:13, :2], tried, draws=12)
    kept = torch.stack([evidence.terms.light[0] for evidence in posterior.people[0].evidence])
    assert len(kept) == 16
    assert all(int((kept - light).norm(dim=1).lt(1e-5).sum()) == 2 for light in lights[:8])


def test_without_an_estimator_the_statistics_tell_the_light(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    keys = set(relighter.state_dict())
    made = relighter.condition(people[12:13, 3:4], draws=4).mean(lights[5:6])
    assert (made - people[12:13, 5:6]).square().mean().sqrt() < 0.1
    assert set(relighter.state_dict()) == keys


def test_lights_near_each_other_are_drawn_with_one_error(lights: torch.Tensor) -> None:
    near = torch.cat((half_a_degree_apart(lights[4]), -lights[4:5]))[None]
    factor = shared_errors(near)
    correlation = factor @ factor.mT
    assert torch.allclose(correlation.diagonal(dim1=1, dim2=2), torch.ones(1, 3), atol=1e-5)
    drawn = GaussianBelief(near, 0.1 * torch.eye(3)).draw(64, None, False) - near[:, None]
    assert (drawn[:, :, 0] - drawn[:, :, 1]).square().mean() < 1e-3 * drawn.square().mean()
    assert (drawn[:, :, 0] - drawn[:, :, 2]).square().mean() > drawn.square().mean()
