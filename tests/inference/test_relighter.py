import numpy as np
import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from facerelight.geometry.lights import angular_distance
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.covariance import image_covariance
from facerelight.model.light_terms import light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.sampling import quasi_normal

MODELS = ["pixel", "face"]


def random_lights(count: int, seed: int) -> torch.Tensor:
    lights = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    lights[:, 2] = lights[:, 2].abs()
    return torch.nn.functional.normalize(lights, dim=-1)


@pytest.mark.parametrize("inputs", [1, 2, 5])
def test_matches_slow_reference(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, inputs: int
) -> None:
    """(3.16), (3.17) per pixel in float64, at bootstrap lights and between them, mean and variance."""
    sources, targets = random_lights(inputs, 1), torch.cat((random_lights(3, 2), lights[4:5]))
    images = torch.rand(1, inputs, 24, 21) * 0.5
    out = StatisticalRelighter(statistics, noise=0)(images, targets, source_lights=sources)
    for y, x in ((0, 0), (11, 7), (23, 20)):
        pixel = reference.Pixel(statistics, y, x)
        for q, target in enumerate(targets):
            mean, variance = pixel.relight(
                images[0, :, y, x].double().numpy(), sources.double().numpy(), target.double().numpy()
            )
            assert abs(float(out.mean[0, q, y, x]) - max(mean, 0)) < 1e-5
            assert abs(float(out.variance[0, q, y, x]) - variance) < 1e-5


def test_face_model_matches_joint_gaussian(people: torch.Tensor, lights: torch.Tensor) -> None:
    """With temper 1, conditioning by code and residual equals conditioning the full joint Gaussian over all pixels at
    once."""
    small = people[:12, :, ::6, ::6]
    statistics = FaceStatistics.fit(small, lights, rank=4, face_rank=3, temper=1.0, basis=30).double()
    sources, target = lights[2:4].double(), lights[9:10].double()
    images = small[12:13, :2].double() if len(small) > 12 else torch.rand(1, 2, *small.shape[2:], dtype=torch.float64)
    out = StatisticalRelighter(statistics, "face", noise=0)(images, target, source_lights=sources)

    from facerelight.model.covariance import image_covariance, prior_mean
    from facerelight.model.light_terms import light_terms, loadings_at

    every = torch.cat((sources, target))
    terms = light_terms(statistics, statistics.face.residual, every, statistics.face)
    local = image_covariance(statistics, statistics.face.residual, terms, terms)  # (P, 3, 3)
    loadings = loadings_at(statistics.face, terms)  # (3, k, P)
    pixels = local.shape[0]
    joint = torch.einsum("akp,bkq->apbq", loadings, loadings)
    for p in range(pixels):
        joint[:, p, :, p] += local[p]
    joint = joint.reshape(3 * pixels, 3 * pixels)
    mean = prior_mean(statistics, every).flatten()
    seen = 2 * pixels
    gain = torch.linalg.solve(joint[:seen, :seen], joint[:seen, seen:]).T
    expected = mean[seen:] + gain @ (images.flatten() - mean[:seen])
    variance = (joint[seen:, seen:] - gain @ joint[:seen, seen:]).diagonal()
    assert torch.allclose(out.mean.flatten(), expected.clamp_min(0), atol=1e-6)
    assert torch.allclose(out.variance.flatten(), variance, atol=1e-6)


@pytest.mark.parametrize("covariance", MODELS)
@pytest.mark.parametrize("inputs", [1, 2, 5, 21])
def test_consistency(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str, inputs: int
) -> None:
    """Theorem 3: an input light as target gives that input back, without variance, and the output is continuous
    there."""
    relighter = StatisticalRelighter(statistics, covariance, noise=0)
    images, sources = people[13:14, :inputs], lights[:inputs]
    posterior = relighter.condition(images, sources)
    out = posterior.render(sources)
    assert (out.mean - images).abs().max() < 0.5 / 255
    assert out.variance.max() < 1e-6
    nearby = torch.nn.functional.normalize(sources + 1e-3, dim=-1)
    assert (posterior.mean(nearby) - images).abs().max() < 2 / 255


@pytest.mark.parametrize("covariance", MODELS)
def test_consistency_holds_with_an_unknown_gain(people: torch.Tensor, lights: torch.Tensor, covariance: str) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, brightness=True)
    images = people[13:14, :3] * 1.3
    out = StatisticalRelighter(statistics, covariance, noise=0)(images, lights[:3], source_lights=lights[:3])
    assert (out.mean - images).abs().max() < 0.5 / 255
    assert out.variance.max() < 1e-6


@pytest.mark.parametrize("covariance", MODELS)
def test_consistency_between_bootstrap_lights(statistics: FaceStatistics, covariance: str) -> None:
    sources = random_lights(4, 3)
    images = torch.rand(1, 4, 24, 21) * 0.6
    out = StatisticalRelighter(statistics, covariance, noise=0)(images, sources, source_lights=sources)
    assert (out.mean - images).abs().max() < 0.5 / 255
    assert out.variance.max() < 1e-6


@pytest.mark.parametrize("covariance", MODELS)
def test_black_image_under_unknown_light_is_the_average_face(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, covariance, estimator)
    out = relighter(torch.zeros(1, 1, 24, 21), lights[:1])
    average = people[:12, 0].mean(0)
    assert (out.mean[0, 0] - average).abs().max() < 0.03  # the kernel blurs v a little between lights
    zero = relighter(torch.rand(1, 1, 24, 21), lights[:1], source_lights=torch.zeros(1, 3))
    assert torch.equal(out.mean, zero.mean)
    known = relighter(torch.zeros(1, 1, 24, 21), lights[:1], source_lights=lights[:1])
    assert known.mean.mean() < 0.01  # under a known light, black is evidence of a dark face


@pytest.mark.parametrize("covariance", MODELS)
def test_variance_never_exceeds_the_prior(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    relighter = StatisticalRelighter(statistics, covariance)
    prior = relighter(people[12:13, :1], lights, source_lights=torch.zeros(1, 3)).variance
    for inputs in (1, 3, 8):
        posterior = relighter(people[12:13, :inputs], lights, source_lights=lights[:inputs]).variance
        assert (posterior <= prior + 1e-6).all()
        assert (posterior >= 0).all()


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10_000), count=st.integers(1, 12), residual=st.booleans())
def test_covariances_are_semidefinite(statistics: FaceStatistics, seed: int, count: int, residual: bool) -> None:
    lights = random_lights(count, seed)
    pixel, face = (statistics.face.residual, statistics.face) if residual else (statistics.pixel, None)
    terms = light_terms(statistics, pixel, lights, face)
    covariance = image_covariance(statistics, pixel, terms, terms).double()
    values = torch.linalg.eigvalsh(covariance)
    assert values.min() > -1e-6 * values.max()


def test_batch_of_people_equals_one_by_one_and_order_does_not_matter(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    together = relighter(people[12:15, :3], lights[5:7], source_lights=lights[:3])
    for index in range(3):
        alone = relighter(people[12 + index : 13 + index, :3], lights[5:7], source_lights=lights[:3])
        assert torch.equal(alone.mean[0], together.mean[index])
    order = [2, 0, 1]
    shuffled = relighter(people[12:15, order], lights[5:7], source_lights=lights[order])
    assert torch.allclose(shuffled.mean, together.mean, atol=1e-5)


def test_inputs_are_not_changed_and_draws_repeat(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, estimator=estimator)
    images, targets = people[12:13, 3:4].clone(), lights[:2].clone()
    first = relighter(images, targets, draws=8)
    second = relighter(images, targets, draws=8)
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(images, people[12:13, 3:4])
    assert torch.equal(targets, lights[:2])
    seeded = [relighter(images, targets, draws=8, generator=torch.Generator().manual_seed(5)).mean for _ in range(2)]
    assert torch.equal(*seeded)


def test_algorithm_2_is_the_mean_over_light_samples(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    """Mean of the conditional means; mean of the variances plus variance of the means."""
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, "face", estimator)
    image = people[12:13, 3:4]
    drawn = estimator.sample(image, 6)[0]
    out = relighter(image, lights[:2], draws=6)
    each = [relighter(image, lights[:2], source_lights=light) for light in drawn]
    means = torch.stack([e.mean for e in each])
    assert torch.allclose(out.mean, means.mean(0), atol=1e-5)
    expected = torch.stack([e.variance for e in each]).mean(0) + means.var(0, correction=0)
    assert torch.allclose(out.variance, expected, atol=1e-5)


def test_some_lights_known_some_not(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, estimator=estimator, noise=0)
    mixed = lights[:2].clone()
    mixed[1] = torch.nan
    out = relighter(people[12:13, :2], lights[:1], source_lights=mixed, draws=4)
    assert (out.mean[0, 0] - people[12, 0]).abs().max() < 0.5 / 255


@pytest.mark.parametrize("covariance", MODELS)
def test_dtype_and_state_dict(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    import copy

    relighter = StatisticalRelighter(copy.deepcopy(statistics), covariance)
    names = set(relighter.state_dict())
    assert {"statistics.n_mean", "statistics.v_mean", "statistics.pixel.v_factor", "statistics.face.v"} <= names
    single = relighter(people[12:13, :2], lights[3:5], source_lights=lights[:2]).mean
    double = relighter.double()(
        people[12:13, :2].double(), lights[3:5].double(), source_lights=lights[:2].double()
    ).mean
    assert double.dtype == torch.float64
    assert torch.allclose(single.double(), double, atol=1e-5)


def test_estimator_finds_held_out_lights(people: torch.Tensor, lights: torch.Tensor) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    found = estimator(people[12:]).direction
    assert angular_distance(found, lights.expand_as(found)).median() < 12  # half the spacing of the lights
    assert torch.equal(estimator(people[12:] * 3).direction, found) or torch.allclose(
        estimator(people[12:] * 3).direction, found, atol=1e-4
    )
    samples = estimator.sample(people[12:13, :2], 64)
    assert samples.shape == (1, 64, 2, 3)
    assert torch.allclose(samples.norm(dim=-1), torch.ones(1, 64, 2), atol=1e-5)


def test_quasi_random_points_are_normal_and_even() -> None:
    points = quasi_normal(256, 3)
    assert points.mean(0).abs().max() < 0.02
    assert torch.allclose(points.T @ points / 256, torch.eye(3), atol=0.08)


def test_bad_input(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    relighter = StatisticalRelighter(statistics)
    good = torch.rand(1, 1, 24, 21)
    with pytest.raises(ValueError, match=r"expected \(B, K, 24, 21\)"):
        relighter(torch.rand(1, 1, 20, 21), lights, source_lights=lights[:1])
    with pytest.raises(ValueError, match="divide by 255"):
        relighter(good * 255, lights, source_lights=lights[:1])
    with pytest.raises(ValueError, match="NaN"):
        relighter(good * torch.nan, lights, source_lights=lights[:1])
    with pytest.raises(ValueError, match="floating"):
        relighter((good * 255).byte(), lights, source_lights=lights[:1])
    with pytest.raises(ValueError, match="source lights"):
        relighter(good, lights, source_lights=lights[:2])
    with pytest.raises(ValueError, match="noise"):
        StatisticalRelighter(statistics, noise=-1)
    with pytest.raises(ValueError, match="noise"):
        relighter.condition(good, lights[:1], noise=torch.ones(2, 1))
    with pytest.raises(ValueError, match="covariance"):
        StatisticalRelighter(statistics, "both")  # type: ignore[arg-type]


def test_save_pretrained(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, tmp_path) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    StatisticalRelighter(statistics, "face", estimator).save_pretrained(tmp_path)
    back = StatisticalRelighter.from_pretrained(tmp_path)
    assert back.covariance == "face"
    image = people[12:13, :1]
    again = StatisticalRelighter(statistics, "face", estimator)(image, lights[:1], draws=4).mean
    assert torch.allclose(back(image, lights[:1], draws=4).mean, again, atol=1e-6)


def test_more_inputs_help_on_average(people: torch.Tensor, lights: torch.Tensor, statistics: FaceStatistics) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    errors = [
        float((relighter.condition(people[12:, :k], lights[:k]).mean(lights[20:]) - people[12:, 20:]).square().mean())
        for k in (1, 3, 9)
    ]
    assert errors[0] > errors[1] > errors[2]
    prior = float((people[12:, 20:] - people[:12, 20:].mean(0)).square().mean())
    assert errors[0] < 0.7 * prior
    assert np.isfinite(errors).all()


def test_what_a_light_needs_is_worked_out_once(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel weights of the input lights once in a conditioning, those of the target lights once in a render."""
    asked: list[int] = []
    weights = FaceStatistics.weights

    def counted(self: FaceStatistics, wanted: torch.Tensor) -> torch.Tensor:
        asked.append(len(wanted))
        return weights(self, wanted)

    monkeypatch.setattr(FaceStatistics, "weights", counted)
    posterior = StatisticalRelighter(statistics, "face").condition(people[12:13, [1, 9]], lights[[1, 9]])
    assert asked == [2]
    posterior.mean(lights[:5])
    assert asked == [2, 5]
