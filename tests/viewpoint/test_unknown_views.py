"""Views that are not known: Algorithms 1 and 2 over groups and over views (5.4, 5.5), and poses drawn."""

from dataclasses import replace

import pytest
import torch

from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.numerics.mixture import mixture_mode
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter
from facerelight.viewpoint.pose_sampler import PoseBelief, PoseSampler, views_about
from facerelight.viewpoint.regions import GroupRelighter, group_by_correlation, make_regions
from facerelight.viewpoint.views import LightViews

SIZE = (24, 21)


class Listed:
    """A sampler that says what it is told."""

    def __init__(self, drawn: torch.Tensor) -> None:
        self.drawn = drawn

    def sample(self, images, count, generator=None, independent=False) -> torch.Tensor:
        assert len(images) == len(self.drawn)
        return self.drawn[:, :count]


@pytest.fixture(scope="module")
def views(statistics) -> LightViews:
    return LightViews(statistics)


def drawn_lights(lights: torch.Tensor) -> torch.Tensor:
    """Three draws of two lights for two persons, ``(2, 3, 2, 3)``."""
    return torch.stack((lights[[0, 5, 3, 7, 9, 2]].view(3, 2, 3), lights[[4, 6, 8, 1, 0, 2]].view(3, 2, 3)))


@pytest.mark.parametrize(("r_out", "r_in"), [(1, 1), (3, 3), (1, 4), (2, 5)])
@pytest.mark.parametrize("model", ["groups", "views"])
def test_algorithms_1_and_2_are_the_mode_and_the_mean_of_the_draws(
    views: LightViews, people: torch.Tensor, lights: torch.Tensor, model: str, r_out: int, r_in: int
) -> None:
    samples = people[:12].flatten(0, 1).flatten(1)
    regions = make_regions(group_by_correlation(samples, r_out), samples, r_in)
    relighter = GroupRelighter(views, regions) if model == "groups" else ViewRelighter(views, r_out)
    images, drawn = people[12:14, :2], drawn_lights(lights)
    expected = relighter(images, None, lights[11], sampler=Listed(drawn), draws=3)
    probable = relighter(images, None, lights[11], "map", sampler=Listed(drawn), draws=3)
    for b in range(2):
        parts = [relighter(images[b : b + 1], list(drawn[b, m]), lights[11]) for m in range(3)]
        means, variances = (torch.stack([part[i].flatten() for part in parts]).double() for i in (0, 1))
        mean = means.mean(0)
        assert torch.allclose(expected.mean[b].flatten().double(), mean, atol=1e-5)
        total = (variances + (means - mean).square()).mean(0)
        assert torch.allclose(expected.variance[b].flatten().double(), total, rtol=1e-3, atol=1e-7)
        mode = mixture_mode(means, variances)
        agree = (probable.mean[b].flatten().double() - mode).abs() < 0.1 / 255
        assert agree.float().mean() > 0.99  # but for levels that are equally probable to rounding
        assert torch.equal(probable.variance[b], expected.variance[b])
    assert (probable.mean - expected.mean).abs().max() > 2 / 255


@pytest.mark.parametrize("model", ["groups", "views"])
def test_known_lights_are_kept_and_dark_images_say_nothing(
    views: LightViews, people: torch.Tensor, lights: torch.Tensor, model: str
) -> None:
    groups = make_regions(group_by_correlation(people[:12].flatten(0, 1).flatten(1), 3))
    relighter = GroupRelighter(views, groups) if model == "groups" else ViewRelighter(views, 3)
    images, drawn = people[12:13, :2], drawn_lights(lights)[:1]
    for unknown in (None, torch.full((3,), torch.nan)):
        half = relighter(images, [lights[0], unknown], lights[11], sampler=Listed(drawn), draws=1)
        known = relighter(images, [lights[0], drawn[0, 0, 1]], lights[11])
        assert torch.allclose(half.mean, known.mean, atol=1e-6)
    drawn = drawn.clone()
    drawn[:, :, 1] = 0  # a light of zero, as estimators find in black images
    one = relighter(images, [lights[0], None], lights[11], sampler=Listed(drawn), draws=2)
    assert torch.allclose(one.mean, relighter(images[:, :1], [lights[0]], lights[11]).mean, atol=1e-6)
    nothing = relighter(images, None, lights[11], sampler=Listed(0 * drawn), draws=2)
    average = views.fields([lights[11]]).mean.view(1, *SIZE)
    assert torch.allclose(nothing.mean, average, atol=1e-6)
    assert nothing.variance.mean() > 1.2 * one.variance.mean()


def test_a_light_estimator_is_a_sampler(views: LightViews, people: torch.Tensor, lights: torch.Tensor) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    samples = people[:12].flatten(0, 1).flatten(1)
    relighter = GroupRelighter(views, make_regions(group_by_correlation(samples, 6)))
    images, truth = people[12:14, 3:4], people[12:14, 9]
    for method in ("expected", "map"):
        made = relighter(images, None, lights[9], method, estimator, draws=4)  # type: ignore[arg-type]
        average = views.fields([lights[9]]).mean.view(1, *SIZE)
        assert (made.mean - truth).square().mean() < (average - truth).square().mean()
    again = relighter(images, None, lights[9], "expected", estimator, draws=4)
    other = relighter(
        images, None, lights[9], "expected", estimator, draws=4, generator=torch.Generator().manual_seed(5)
    )
    assert torch.equal(again.mean, relighter(images, None, lights[9], sampler=estimator, draws=4).mean)
    assert not torch.equal(again.mean, other.mean)


def test_the_most_probable_image_over_candidate_poses(posed: BootstrapViews) -> None:
    """(5.4) written out: the mode of the readings' mixture, weighted with their evidence."""
    strangers = BootstrapViews(replace(posed.config, heads=2), posed.folder, first=posed.config.heads)
    candidates = [View(20.0), View(30.0), View(40.0)]
    images = strangers.images(View(30.0))[:, None]
    relighter = ViewRelighter(posed, 6, temper=1000.0)
    expected, probable = (relighter(images, [candidates], View(), method) for method in ("expected", "map"))
    parts = [relighter(images, [view], View()) for view in candidates]
    for b in range(2):
        means, variances = (torch.stack([part[i][b].flatten() for part in parts]).double() for i in (0, 1))
        weight = expected.weight[b].double()
        mode = mixture_mode(means, variances, weight)
        agree = (probable.mean[b].flatten().double() - mode).abs() < 0.1 / 255
        assert agree.float().mean() > 0.99
        assert torch.allclose(weight @ means, expected.mean[b].flatten().double(), atol=1e-5)
    assert torch.equal(expected.weight, probable.weight)
    with pytest.raises(ValueError, match="expected one of expected, map"):
        relighter(images, [candidates], View(), "mle")  # type: ignore[arg-type]


def test_poses_are_drawn_where_they_are_probable_and_integrated_over(posed: BootstrapViews) -> None:
    strangers = BootstrapViews(replace(posed.config, heads=3), posed.folder, first=posed.config.heads)
    truth, candidates = View(30.0), [View(-30.0), View(0.0), View(20.0), View(30.0)]
    images = strangers.images(truth)[:, None]
    sampler = PoseSampler(posed, candidates, rank=6)
    belief = sampler.locate(images)
    assert torch.allclose(belief.probability.sum(2), torch.ones(3, 1).double())
    assert (belief.probability.argmax(2) == 3).all()
    drawn = sampler.sample(images, 8)
    assert [len(person) for person in drawn] == [8] * 3
    for person, probability in zip(drawn, belief.probability[:, 0], strict=True):
        share = torch.tensor([sum(one[0] == view for one in person) / 8 for view in candidates])
        assert (share - probability).abs().max() <= 2 / 8
    assert sampler.sample(images, 8) == drawn
    relighter = ViewRelighter(posed, 6)
    by_draws = relighter(images, None, View(), sampler=sampler, draws=8)
    by_sum = relighter(images, [candidates], View())  # the same integral as a sum over all candidates
    average = posed.images(View()).mean(0)
    error = (by_draws.mean - strangers.images(View())).square().mean()
    assert error < (average - strangers.images(View())).square().mean()
    assert (by_draws.mean - by_sum.mean).square().mean() < 0.1 * (average - by_sum.mean).square().mean()


def test_draws_follow_the_belief() -> None:
    views = [View(float(azimuth)) for azimuth in range(4)]
    probability = torch.tensor([[[0.1, 0.2, 0.3, 0.4], [1.0, 0.0, 0.0, 0.0]]], dtype=torch.float64)
    for independent, tolerance in ((False, 0.01), (True, 0.05)):
        drawn = PoseBelief(probability, views).draw(1000, torch.Generator().manual_seed(0), independent)[0]
        share = [sum(one[0] == view for one in drawn) / 1000 for view in views]
        assert torch.allclose(torch.tensor(share), probability[0, 0].float(), atol=tolerance)
        assert all(one[1] == views[0] for one in drawn)


def test_candidates_lie_about_a_rough_guess() -> None:
    guess = View(20.0, -4.5, (10.0, 0.0))
    views = views_about(guess, (8.0, 0.0), 400)
    azimuth = torch.tensor([view.azimuth for view in views])
    assert abs(azimuth.mean() - 20) < 0.5
    assert 7 < azimuth.std() < 9
    assert torch.equal(azimuth, azimuth.round())
    assert {(view.elevation, view.light) for view in views} == {(-4.5, (10.0, 0.0))}
    assert all(abs(view.azimuth) <= 90 for view in views_about(View(85.0), (20.0, 5.0), 50))


def test_bad_samplers(views: LightViews, posed: BootstrapViews, people: torch.Tensor, lights: torch.Tensor) -> None:
    relighter = ViewRelighter(views, 2)
    with pytest.raises(ValueError, match="a sampler"):
        relighter(people[:1, :1], None, lights[0])
    with pytest.raises(ValueError, match="draws: expected at least 1"):
        relighter(people[:1, :1], None, lights[0], sampler=Listed(lights[None, :1, None]), draws=0)
    with pytest.raises(ValueError, match="give None and a sampler"):
        GroupRelighter(views, make_regions([torch.arange(504)]))(people[:1, :1], [lights[:2]], lights[0])
    with pytest.raises(ValueError, match="count: expected at least 1"):
        PoseSampler(posed, [View()]).sample(torch.zeros(1, 1, 48, 42), 0)
    with pytest.raises(ValueError, match="try views_about"):
        PoseSampler(posed, [])
    with pytest.raises(ValueError, match="spreads of 0 or more"):
        views_about(View(), (-1.0, 0.0))
    nobody = relighter(people[:0, :1], None, lights[0], sampler=Listed(lights[:0]), draws=2)
    assert nobody.mean.shape == (0, *SIZE)
