"""Algorithms 1 and 2, the MLE case, incremental conditioning, and the properties of tables 3.1 and 3.2."""

import numpy as np
import pytest
import reference
import torch
from conftest import shaded_people

from facerelight.geometry.lights import light_from_angles
from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.covariance import deviation_covariance, image_covariance, prior_mean
from facerelight.model.light_terms import light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.gaussian import SequentialConditional, condition_gaussian
from facerelight.numerics.mixture import draw_mixture, histogram_mode, mixture_mode


def draw_images(
    statistics: FaceStatistics, lights: torch.Tensor, count: int, seed: int, normal: bool = True
) -> torch.Tensor:
    """Images of ``count`` people from the model itself, ``(count, K, P)`` float64: the properties hold for them exactly
    in expectation."""
    terms = light_terms(statistics, statistics.pixel, lights)
    make = image_covariance if normal else deviation_covariance
    covariance = make(statistics, statistics.pixel, terms, terms)
    root = torch.linalg.cholesky(covariance + 1e-12 * torch.eye(len(lights), dtype=torch.float64))
    noise = torch.randn(count, *root.shape[:2], 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return (root @ noise)[..., 0].mT + prior_mean(statistics, lights).double()


# ---- Algorithm 1


def test_mode_of_one_gaussian_is_its_mean_and_of_a_mixture_its_highest_peak() -> None:
    means, narrow = torch.tensor([[0.2, 0.7]]), torch.full((1, 2), 1e-4)
    assert (mixture_mode(means, narrow) - means[0]).abs().max() < 0.5 / 255
    two = torch.tensor([[0.2], [0.8]])
    assert mixture_mode(two, torch.tensor([[1e-4], [1e-2]])).item() == pytest.approx(0.2, abs=1 / 255)
    assert mixture_mode(two, torch.tensor([[1e-4], [1e-2]]), torch.tensor([0.001, 0.999])).item() == pytest.approx(
        0.8, abs=1 / 255
    )
    assert mixture_mode(two, torch.zeros(2, 1), torch.tensor([0.4, 0.6])).item() == pytest.approx(
        0.8, abs=1 / 255
    )  # no variance at all
    assert 0 <= mixture_mode(torch.tensor([[50.0]]), torch.tensor([[1e-6]])).item() <= 1  # every density underflows


def test_mode_equals_a_slow_reference() -> None:
    generator = np.random.default_rng(0)
    means, variances = generator.random((7, 20)), generator.uniform(1e-4, 1e-2, (7, 20))
    levels = np.arange(256) / 255
    density = (np.exp(-0.5 * (levels[:, None, None] - means) ** 2 / variances) / np.sqrt(variances)).sum(1)
    found = mixture_mode(torch.from_numpy(means), torch.from_numpy(variances))
    assert np.array_equal((found * 255).round().numpy(), density.argmax(0))


def test_histogram_form_comes_near_the_exact_form() -> None:
    """The thesis's way, within 3 grey levels at 100,000 draws a pixel; its filter leaves that much."""
    generator = torch.Generator().manual_seed(0)
    means = 0.5 + 0.03 * torch.randn(16, 60, generator=generator)
    variances = torch.rand(16, 60, generator=generator) * 0.004 + 0.002
    exact = mixture_mode(means, variances)
    near = histogram_mode(draw_mixture(means, variances, 6000, generator))
    few = histogram_mode(draw_mixture(means, variances, 5, generator))
    error = (near - exact).abs() * 255
    assert error.median() <= 3
    assert (few - exact).abs().mean() * 255 > error.mean()


def test_map_equals_expected_where_lights_are_known_and_differs_where_not(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    relighter = StatisticalRelighter(statistics, estimator=KernelIlluminationEstimator.fit(people[:12], lights))
    known = [
        relighter(people[12:13, :1], lights[5:6], source_lights=lights[:1], method=m).mean for m in ("expected", "map")
    ]
    assert torch.equal(*known)
    unknown = [relighter(people[12:13, 3:4], lights[5:6], method=m, draws=8).mean for m in ("expected", "map")]
    assert 0 < (unknown[0] - unknown[1]).abs().mean() < 0.05
    assert torch.allclose(unknown[1] * 255, (unknown[1] * 255).round(), atol=1e-3)  # grey levels


# ---- Algorithm 2


@pytest.mark.parametrize("inputs", [1, 2])
def test_quasi_random_lights_converge_faster(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, inputs: int
) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, estimator=estimator)
    image = people[12:13, 3 : 3 + inputs]

    def mean(drawn: torch.Tensor) -> torch.Tensor:
        return relighter.condition(image, drawn).mean(lights[20:21])

    converged = mean(estimator.sample(image, 1024))
    quasi = (mean(estimator.sample(image, 32)) - converged).square().mean().sqrt()
    seeds = [torch.Generator().manual_seed(s) for s in range(6)]
    independent = (
        torch.stack(
            [(mean(estimator.sample(image, 512, g, independent=True)) - converged).square().mean() for g in seeds]
        )
        .mean()
        .sqrt()
    )
    assert quasi < independent


# ---- the special case of a fixed n


def test_mle_equals_a_slow_reference(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    """(3.19), (3.20) and the kriging variance, per pixel in float64 NumPy."""
    sources, target = lights[[0, 4, 9, 15]], light_from_angles(20.0, 10.0)
    images = draw_images(statistics, sources, 1, 0)[0]
    out = StatisticalRelighter(statistics, noise=0)(
        images.float().view(1, 4, 24, 21), target[None], source_lights=sources, method="mle"
    )
    for y, x in ((0, 0), (11, 7), (23, 20)):
        pixel = reference.Pixel(statistics, y, x)
        s, s0 = sources.double().numpy(), target.double().numpy()

        def cov(a, b, pixel=pixel):
            return pixel.covariance(a, b) - a @ pixel.n_cov @ b

        sigma = np.array([[cov(a, b) for b in s] for a in s])
        r = np.array([cov(a, s0) for a in s])
        residual = images[:, y * 21 + x].numpy() - np.array([pixel.mean(a) - a @ pixel.n_mean for a in s])
        inverse = np.linalg.inv(sigma)
        precision = s.T @ inverse @ s
        n = np.linalg.solve(precision, s.T @ inverse @ residual)
        mean = s0 @ n + pixel.mean(s0) - s0 @ pixel.n_mean + r @ inverse @ (residual - s @ n)
        d = s0 - s.T @ inverse @ r
        variance = d @ np.linalg.solve(precision, d) + cov(s0, s0) - r @ inverse @ r
        assert abs(float(out.mean[0, 0, y, x]) - mean) < 2e-5
        assert abs(float(out.variance[0, 0, y, x]) - variance) < 2e-5


def test_mle_is_consistent_and_continuous(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    relighter = StatisticalRelighter(statistics, noise=0)
    sources = lights[[0, 4, 9, 15]]
    images = people[12:13, [0, 4, 9, 15]]
    out = relighter(images, sources, source_lights=sources, method="mle")
    assert (out.mean - images).abs().max() < 0.5 / 255
    assert out.variance.max() < 1e-6
    near = torch.nn.functional.normalize(sources + 1e-3, dim=-1)
    assert (relighter(images, near, source_lights=sources, method="mle").mean - images).abs().max() < 2 / 255


@pytest.mark.parametrize("angles", [[(0, 0)], [(0, 0), (40, 0)], [(-40, 0), (0, 0), (40, 0)], [(10, 10)] * 3])
def test_mle_wants_three_independent_lights(statistics: FaceStatistics, angles: list[tuple[float, float]]) -> None:
    """One, two, coplanar and repeated lights."""
    sources = torch.stack([light_from_angles(float(a), float(e)) for a, e in angles])
    with pytest.raises(ValueError, match=rf"got {len(angles)} with condition number"):
        StatisticalRelighter(statistics)(
            torch.rand(1, len(angles), 24, 21), sources[:1], source_lights=sources, method="mle"
        )


def test_methods_that_cannot_serve_say_so(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    relighter = StatisticalRelighter(statistics)
    with pytest.raises(ValueError, match="to be known"):
        relighter(torch.rand(1, 3, 24, 21), lights[:1], method="mle")
    with pytest.raises(ValueError, match="expected one of expected, map, mle"):
        relighter(torch.rand(1, 3, 24, 21), lights[:1], source_lights=lights[:3], method="best")


# ---- Appendix A


def test_one_image_at_a_time_equals_all_at_once(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    every = torch.cat((lights[20:21], lights[:6]))
    terms = light_terms(statistics, statistics.pixel, every)
    joint = image_covariance(statistics, statistics.pixel, terms, terms)
    residual = torch.randn(len(joint), 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.1
    x = SequentialConditional(torch.zeros(len(joint)), joint[:, 0, 0])
    before = joint[:, 0, 0]
    for k in range(1, 7):
        x.add(residual[:, k - 1], joint[:, 0, k], joint[:, k, k], joint[:, k, 1:k])
        assert (x.variance <= before + 1e-15).all()  # more inputs never increase it
        before = x.variance
        zero = torch.zeros(len(joint), 1)
        batch = condition_gaussian(
            zero,
            torch.zeros(k),
            joint[:, :1, :1],
            joint[:, :1, 1 : k + 1],
            joint[:, 1 : k + 1, 1 : k + 1],
            residual[:, :k],
        )
        assert torch.allclose(x.mean, batch.mean[:, 0], atol=1e-9)
        assert torch.allclose(x.variance, batch.covariance[:, 0, 0], atol=1e-12)


# ---- tables 3.1 and 3.2


@pytest.mark.parametrize(
    ("method", "inputs"), [*(("expected", k) for k in (1, 2, 3, 5, 10, 21)), *(("mle", k) for k in (3, 5, 10, 21))]
)
def test_parsimony(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, method: str, inputs: int
) -> None:
    """Any number of inputs will do, and tells more than none; from three on for the MLE case, which refuses fewer
    (above)."""
    relighter, target = StatisticalRelighter(statistics), light_from_angles(25.0, 10.0)[None]
    truth = shaded_people(16, target, 0)[12:]  # the same people
    out = relighter(people[12:16, :inputs], target, source_lights=lights[:inputs], method=method)
    average = relighter(people[12:16, :1], target, source_lights=torch.zeros(1, 3)).mean
    assert torch.isfinite(out.mean).all()
    assert (out.variance >= (1 / 255) ** 2 * 0.999).all()  # of a new image
    assert (out.mean - truth).norm() < 0.5 * (average - truth).norm()


def test_zero_mean_error(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    """Lemma 4, on 4,000 people of the model: the mean error is zero within four standard errors of it."""
    every = torch.cat((lights[20:21], lights[:2]))
    images = draw_images(statistics, every, 4000, 1)
    terms = light_terms(statistics, statistics.pixel, every)
    joint = image_covariance(statistics, statistics.pixel, terms, terms)
    gain = torch.linalg.solve(joint[:, 1:, 1:], joint[:, 1:, :1])[..., 0]  # (P, 2)
    residual = images - prior_mean(statistics, every).double()
    error = residual[:, 0] - torch.einsum("nkp,pk->np", residual[:, 1:], gain)
    relighter = StatisticalRelighter(statistics, noise=0)
    person = images[:1, 1:].float().view(1, 2, 24, 21)
    made = relighter.condition(person, lights[:2]).people[0].mean(lights[20:21]).flatten().double()
    assert torch.allclose(images[0, 0] - made, error[0], atol=1e-5)  # the same estimator as the package's
    spread = error.std(0) / len(error) ** 0.5
    assert (error.mean(0).abs() / spread).max() < 4.5  # the largest of 504 pixels
    expected = relighter(person, lights[20:21], source_lights=lights[:2]).variance.flatten().double()
    assert (error.var(0) / expected).log().abs().max() < 0.15  # and the variance is the one promised


def test_mle_is_progressive(statistics: FaceStatistics, lights: torch.Tensor) -> None:
    """Lemma 6 as it can be proved: Var[n_MLE] never grows with K, in the Loewner order; nor does the image's variance
    (Lemma 7)."""
    images = torch.zeros(12, 24, 21)
    before, variance = None, None
    for inputs in range(3, 13):
        fixed = MaximumLikelihood(statistics, images[:inputs], lights[:inputs])
        covariance = fixed.normal_covariance()
        out = fixed.render(lights[20])[1]
        if before is not None:
            growth = torch.linalg.eigvalsh(covariance - before).amax(-1)
            assert (growth <= 1e-6 * before.diagonal(dim1=1, dim2=2).sum(-1)).all()
            assert (out <= variance * (1 + 1e-5) + 1e-9).all()
        before, variance = covariance, out


def test_map_of_n_is_biased_for_one_person_and_better_on_average(
    statistics: FaceStatistics, lights: torch.Tensor
) -> None:
    """Lemma 9: for a fixed person the known-light estimate is pulled to the mean face; over people its mean square
    error falls with K."""
    person = statistics.n_mean.flatten(1) + 2 * torch.einsum(
        "dcp,c->dp", statistics.pixel.n_factor.flatten(2), torch.ones(3)
    )
    relighter = StatisticalRelighter(statistics, noise=0)
    target = lights[20:21]
    errors = []
    for inputs in (1, 3):
        deviation = draw_images(statistics, torch.cat((target, lights[:inputs])), 400, 3, normal=False)
        average = torch.cat((target, lights[:inputs])) @ statistics.n_mean.flatten(1)
        images = deviation - average + torch.cat((target, lights[:inputs])) @ person  # n held fixed, v drawn
        made = relighter(
            images[:, 1:].float().unflatten(-1, (24, 21)), target, source_lights=lights[:inputs]
        ).mean.flatten(1)
        error = images[:, 0] - made
        errors.append(float(error.mean(0).abs().mean()))
        assert (error.mean(0).abs() / (error.std(0) / 20)).median() > 4  # not zero on average: not Progressive
    images = draw_images(statistics, torch.cat((target, lights[:8])), 400, 4)
    square = []
    for inputs in (1, 2, 4, 8):
        made = relighter(
            images[:, 1 : inputs + 1].float().unflatten(-1, (24, 21)), target, source_lights=lights[:inputs]
        ).mean.flatten(1)
        square.append(float((images[:, 0] - made).square().mean()))
    assert square == sorted(square, reverse=True)


def test_two_steps_equal_one(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    """Theorem 12, and Lemmas 10, 11 with the covariance they leave out: rendering from n_MAP and v_MAP gives the same
    mean and variance."""
    sources, target = lights[[2, 7, 11]], light_from_angles(25.0, -10.0)[None]
    images = people[12, [2, 7, 11]].flatten(1).double()
    pixel = statistics.pixel
    terms, goal = light_terms(statistics, pixel, sources), light_terms(statistics, pixel, target)
    of_v = deviation_covariance(statistics, pixel, terms, terms)
    cross = deviation_covariance(statistics, pixel, terms, goal)
    root = pixel.n_factor.flatten(2).permute(2, 0, 1).double()
    s, s0 = sources.double(), target[0].double()
    mean_n = statistics.n_mean.flatten(1).T.double()
    residual = (images - statistics.weights(sources).double() @ statistics.v_mean.flatten(1).double()).T[..., None]
    inverse = torch.linalg.inv(of_v)
    n_cov = torch.linalg.inv(s.T @ inverse @ s + torch.linalg.inv(root @ root.mT))  # Lemma 10
    n_map = n_cov @ (s.T @ inverse @ residual + torch.linalg.inv(root @ root.mT) @ mean_n[..., None])  # (3.28)
    v_map = cross.mT @ inverse @ (residual - s @ n_map)
    average = (statistics.weights(target) @ statistics.v_mean.flatten(1))[0].double()
    mean = (n_map[..., 0] @ s0) + average + v_map[:, 0, 0]
    d = s0[:, None] - s.T @ inverse @ cross
    own = deviation_covariance(statistics, pixel, goal, goal)[:, 0, 0] - (cross.mT @ inverse @ cross)[:, 0, 0]
    variance = (d.mT @ n_cov @ d)[:, 0, 0] + own
    out = StatisticalRelighter(statistics, noise=0)(images.float().view(1, 3, 24, 21), target, source_lights=sources)
    assert torch.allclose(out.mean.flatten().double(), mean, atol=2e-5)
    assert torch.allclose(out.variance.flatten().double(), variance, atol=2e-5)
