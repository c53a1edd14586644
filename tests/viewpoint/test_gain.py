"""Brightness and noise where several pixels or views are modelled at a time: as
:class:`~facerelight.inference.relighter.StatisticalRelighter` has them."""

from typing import Any

import pytest
import torch
from conftest import shaded_people

from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.viewpoint.pose import ViewRelighter
from facerelight.viewpoint.regions import GroupRelighter, make_regions, random_groups
from facerelight.viewpoint.views import LightViews

PIXELS = 24 * 21
MODELS = ["groups", "views"]


@pytest.fixture(scope="module")
def bright(people: torch.Tensor, lights: torch.Tensor) -> FaceStatistics:
    """People whose brightness is an unknown of its own; a correlation factor of full rank, as fields have."""
    return FaceStatistics.fit(people[:12], lights, rank=29, brightness=True)


@pytest.fixture(scope="module")
def views(bright: FaceStatistics) -> LightViews:
    return LightViews(bright)


def relighter(views: LightViews, model: str, **options: Any) -> GroupRelighter | ViewRelighter:
    regions = make_regions(random_groups(PIXELS, 4, torch.Generator().manual_seed(0)))
    return GroupRelighter(views, regions, **options) if model == "groups" else ViewRelighter(views, 4, **options)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("inputs", [1, 3])
def test_one_pixel_a_group_is_the_single_pixel_model_with_its_gain(
    bright: FaceStatistics, views: LightViews, people: torch.Tensor, lights: torch.Tensor, inputs: int, noise: float
) -> None:
    regions = make_regions([torch.tensor([p]) for p in range(PIXELS)])
    images = torch.stack((people[13, :inputs], 1.6 * people[14, :inputs]))
    target = light_from_angles(12.0, 5.0)
    group = GroupRelighter(views, regions, noise=noise)(images, lights[:inputs], target)
    single = StatisticalRelighter(bright, noise=noise)(images, target[None], source_lights=lights[:inputs])
    assert torch.allclose(group.mean, single.mean[:, 0], atol=1e-5)
    assert torch.allclose(group.variance, single.variance[:, 0], rtol=1e-3, atol=1e-7)
    assert float(bright.gain_spread) > 0.02


@pytest.mark.parametrize("model", MODELS)
def test_a_brighter_photograph_gives_a_brighter_face(
    views: LightViews, people: torch.Tensor, lights: torch.Tensor, model: str
) -> None:
    exact = relighter(views, model, noise=0)
    plain, brighter = (exact(g * people[12:13, :4], lights[:4], lights[20]).mean for g in (1.0, 1.5))
    assert (brighter / 1.5 - plain).abs().mean() * 255 < 0.5
    back = exact(1.5 * people[12:13, :4], lights[:4], lights[2])
    assert (back.mean - 1.5 * people[12:13, 2]).abs().max() < 0.5 / 255
    assert back.variance.max() < 1e-6


@pytest.mark.parametrize("model", MODELS)
def test_the_variance_counts_gain_and_noise(
    views: LightViews, people: torch.Tensor, lights: torch.Tensor, model: str
) -> None:
    image = people[12:13, :1]
    seen = relighter(views, model)(image, lights[:1], lights[0])
    assert (seen.variance >= 0.999 / 255**2).all()
    assert (seen.mean - image[:, 0]).square().mean().sqrt() < 1 / 255
    known = views.fields([lights[9], lights[0]])
    gain = known.gains(image.flatten(2), 1 / 255)
    with_gain = relighter(views, model)(image, lights[:1], lights[9]).variance
    views.statistics.gain_spread *= 1e-3  # hardly a gain, and so read with hardly a doubt
    try:
        without = relighter(views, model)(image / gain.value.float(), lights[:1], lights[9]).variance
    finally:
        views.statistics.gain_spread *= 1e3
    assert float(gain.spread) > 0
    assert with_gain.mean() > without.mean() * float(gain.value) ** 2


@pytest.mark.parametrize("model", MODELS)
def test_rounded_images_under_nearly_one_light_do_not_hurt(views: LightViews, lights: torch.Tensor, model: str) -> None:
    sources = torch.nn.functional.normalize(lights[4] + torch.tensor([[0.0, 0, 0], [0.0087, 0, 0]]), dim=1)
    every = shaded_people(14, torch.cat((sources, lights[9:10])), 0)[12:]
    rounded = (every * 255).round() / 255

    def error(inputs: int, noise: float) -> float:
        made = relighter(views, model, noise=noise)(rounded[:, :inputs], sources[:inputs], lights[9]).mean
        return float((made - every[:, 2]).square().mean().sqrt() * 255)

    assert error(2, 1.0) <= error(1, 1.0) + 0.2
    assert error(2, 0.0) > error(1, 0.0) + 0.2  # what noise is for


def test_noise_is_a_number_of_grey_levels(views: LightViews) -> None:
    for model in MODELS:
        for wrong in (-1.0, float("nan")):
            with pytest.raises(ValueError, match="noise: expected grey levels"):
                relighter(views, model, noise=wrong)
