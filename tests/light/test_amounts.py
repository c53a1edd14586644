"""The amounts of many lights told by the model: against a dense Gaussian, against least squares, and their samples."""

import pytest
import torch

from facerelight.geometry.lights import angular_distance, light_from_angles
from facerelight.geometry.sums import LightSum
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.evidence import NOISE, ImageEvidence
from facerelight.light.soft import fit_soft_light
from facerelight.model.covariance import image_covariance
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.model.statistics import FaceStatistics


@pytest.fixture(scope="module")
def estimator(statistics: FaceStatistics) -> SoftLightEstimator:
    return SoftLightEstimator(statistics)


def mixed(
    people: torch.Tensor, lights: torch.Tensor, *angles: tuple[float, float]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Photographs ``(N, 1, H, W)`` of people under lobes about some angles, and their amounts."""
    towards = torch.stack([light_from_angles(*pair) for pair in angles])
    amounts = torch.exp(-6 * torch.cdist(lights, towards).square()).sum(1)
    amounts = amounts / amounts.sum()
    return torch.einsum("j,njhw->nhw", amounts, people)[:, None], amounts


def evidence(estimator: SoftLightEstimator, photos: torch.Tensor) -> ImageEvidence:
    return estimator.model.look(photos[:, 0], torch.ones_like(photos[:, 0]))


def test_the_likelihood_is_that_of_a_dense_gaussian(
    estimator: SoftLightEstimator, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photo, amounts = mixed(people[12:13], lights, (50, 10))
    tried = torch.stack((amounts, amounts.flip(0), torch.full_like(amounts, 0.05))).double()
    image = evidence(estimator, photo.expand(3, -1, -1, -1))
    ours = estimator.model.log_likelihood(image, tried)
    face, places = statistics.face, estimator.model.places
    temper = max(1.0, 100 / 8064 * len(places))
    dense = []
    for row in tried.float():
        terms = light_terms(statistics, face.residual, LightSum(lights, row[None]), face)
        variance = image_covariance(statistics, face.residual, terms, terms)[places, 0, 0] + NOISE**2
        white = loadings_at(face, terms)[0][:, places].T.double()
        covariance = torch.diag(variance) + white @ white.T / temper
        mean = terms.mean[0, places].double()
        dense.append(torch.distributions.MultivariateNormal(mean, covariance).log_prob(image.seen[0]))
    difference = ours - torch.stack(dense)
    assert float((difference - difference[0]).abs().max()) < 1e-2


def test_the_slope_is_that_of_differences(
    estimator: SoftLightEstimator, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photos, amounts = mixed(people[12:14], lights, (40, 20), (-60, 0))
    image = evidence(estimator, photos)
    tried = (amounts.double() + 0.01).expand(2, -1).clone().requires_grad_()
    estimator.model.log_likelihood(image, tried).sum().backward()
    slope, information = estimator.model.slope(image, tried.detach())
    assert torch.allclose(slope, tried.grad, rtol=1e-6, atol=1e-6 * float(slope.abs().max()))
    assert float(torch.linalg.eigvalsh(information).min()) > -1e-6 * float(information.abs().max())


@pytest.mark.parametrize("angles", [[(50, 10)], [(60, 0), (-60, 20)], [(0, 50)]], ids=["window", "two", "overhead"])
def test_it_is_nearer_than_least_squares(
    estimator: SoftLightEstimator,
    statistics: FaceStatistics,
    people: torch.Tensor,
    lights: torch.Tensor,
    angles: list[tuple[float, float]],
) -> None:
    """Relit faces are, for people who were not learned from."""
    photos, amounts = mixed(people[12:], lights, *angles)
    found = estimator.amounts(photos)
    assert angular_distance(found.vector[:, 0], (amounts @ lights).expand(4, 3)).median() < 12
    rough = torch.stack(
        [fit_soft_light(statistics.mean_images(), photo[0], torch.ones_like(photo[0])) for photo in photos]
    )
    relighter = StatisticalRelighter(statistics, "face")
    errors = [
        float((relighter.condition(photos, given).mean(lights) - people[12:]).square().mean())
        for given in (found, LightSum(lights, rough[:, None]))
    ]
    assert errors[0] < errors[1]


def test_photographs_do_not_disturb_each_other(
    estimator: SoftLightEstimator, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photos = torch.cat([mixed(people[12:14], lights, angle)[0] for angle in ((50, 10), (-30, 30))])
    together = estimator.amounts(photos).amounts
    alone = torch.cat([estimator.amounts(photo[None]).amounts for photo in photos])
    assert torch.allclose(together, alone, atol=2e-3 * float(alone.max()))


def test_brightness_is_part_of_the_amounts(
    estimator: SoftLightEstimator, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photo, _ = mixed(people[12:13], lights, (50, 10))
    bright, dark = estimator.amounts(photo).amounts.sum(), estimator.amounts(0.25 * photo).amounts.sum()
    assert 3 < float(bright / dark) < 5.5


def test_samples_lie_about_the_most_probable_amounts(
    estimator: SoftLightEstimator, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photo, _ = mixed(people[12:13], lights, (50, 10))
    found, drawn = estimator.amounts(photo), estimator.sample_sums(photo, 512)
    assert drawn.amounts.shape == (1, 512, 1, 30)
    assert (drawn.amounts > 0).all()
    middle = drawn.amounts.mean(1)
    assert float((middle - found.amounts).abs().sum() / found.amounts.sum()) < 0.2
    assert torch.equal(drawn.amounts, estimator.sample_sums(photo, 512).amounts)


def test_the_unsureness_of_the_light_is_in_the_variance(
    estimator: SoftLightEstimator, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    photo, _ = mixed(people[12:13], lights, (50, 10))
    relighter = StatisticalRelighter(statistics, "face", estimator)
    known = relighter.condition(photo, estimator.amounts(photo)).variance(lights[:3])
    unsure = relighter.condition(photo, draws=8).variance(lights[:3])
    assert float(unsure.mean()) > float(known.mean())


def test_one_known_and_one_unknown_light(
    estimator: SoftLightEstimator, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    sources = torch.stack((lights[3], torch.full((3,), torch.nan)))
    posterior = StatisticalRelighter(statistics, "face", estimator).condition(people[12:13, :2], sources, draws=4)
    assert torch.isfinite(posterior.mean(lights[:2])).all()
    assert torch.isfinite(posterior.variance(lights[:2])).all()


def test_statistics_without_loadings_do_as_well(people: torch.Tensor, lights: torch.Tensor) -> None:
    plain = FaceStatistics.fit(people[:12], lights, rank=4)
    photo, amounts = mixed(people[12:13], lights, (50, 10))
    found = SoftLightEstimator(plain).amounts(photo)
    assert float(angular_distance(found.vector[0, 0], amounts @ lights)) < 25
