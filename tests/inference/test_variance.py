"""What means and variances are made of: gain, noise, temper, what a basis loses and what a mask hides, against slow
float64 NumPy; and that intervals hold for people of the model itself."""

import numpy as np
import pytest
import reference
import torch

from facerelight.geometry.lights import light_from_angles
from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.statistics import FaceStatistics

NOISE = 3.0  # grey levels: enough to be seen beside everything else
SOURCES = [0, 12, 21]
SMALL = (4, 4)  # pixels


@pytest.fixture(scope="module")
def uneven(people: torch.Tensor) -> torch.Tensor:
    """People of unlike brightness, 4 x 4 pixels."""
    gains = torch.linspace(-0.5, 0.5, 12)[torch.randperm(12, generator=torch.Generator().manual_seed(0))].exp()
    return people[:12, :, 1::6, 2::5] * 0.5 * gains[:, None, None, None]


@pytest.fixture(scope="module")
def unsure(uneven: torch.Tensor, lights: torch.Tensor) -> FaceStatistics:
    """Gains vary, the basis loses much, a pixel counts a seventh."""
    fitted = FaceStatistics.fit(uneven, lights, rank=5, face_rank=3, basis=3, temper=7.0, brightness=True).double()
    assert fitted.size == SMALL
    return fitted


def targets(lights: torch.Tensor) -> torch.Tensor:
    """Beside the first input, between the bootstrap's lights, and at one of them."""
    beside = torch.nn.functional.normalize(lights[SOURCES[0]] + torch.tensor([0.03, -0.02, 0.0]), dim=0)
    return torch.stack((beside, light_from_angles(30.0, 17.0), light_from_angles(-55.0, -20.0), lights[7])).double()


def known_gain(statistics: FaceStatistics, images: np.ndarray, sources: np.ndarray) -> tuple[float, float]:
    """By the reference, for images ``(K, P)``."""
    pixels = [reference.Pixel(statistics, y, x) for y in range(SMALL[0]) for x in range(SMALL[1])]
    expected = np.array([[pixel.mean(s) for pixel in pixels] for s in sources])
    noise = np.array([pixels[0].weights(s) @ statistics.gain_noise.numpy() for s in sources])
    return reference.gain(images, expected, float(statistics.gain_spread), noise, sources, NOISE / 255)


@pytest.mark.parametrize("bright", [0.5, 1.7])
@pytest.mark.parametrize("inputs", [1, 3])
@pytest.mark.parametrize("covariance", ["pixel", "face"])
def test_gain_and_noise_are_those_of_the_reference(
    unsure: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str, inputs: int, bright: float
) -> None:
    images = (people[13, SOURCES[:inputs], 1::6, 2::5] * 0.5 * bright).double()
    sources, wanted = lights[SOURCES[:inputs]].double(), targets(lights)
    out = StatisticalRelighter(unsure, covariance, noise=NOISE)(images[None], wanted, sources)  # type: ignore[arg-type]
    y, s = images.flatten(1).numpy(), sources.numpy()
    gain, spread = known_gain(unsure, y, s)
    assert abs(np.log(gain)) > 0.1
    whole = reference.Face(unsure)
    for q, target in enumerate(wanted.numpy()):
        if covariance == "face":
            mean, variance = whole.relight(y, s, target, gain, spread, NOISE / 255)
        else:
            places = [divmod(p, SMALL[1]) for p in range(SMALL[0] * SMALL[1])]
            each = [
                reference.Pixel(unsure, *at).relight(y[:, p], s, target, gain, spread, NOISE / 255)
                for p, at in enumerate(places)
            ]
            mean, variance = np.array(each).T
        assert np.allclose(out.mean[0, q].flatten(), np.maximum(mean, 0), atol=1e-5)
        assert np.allclose(out.variance[0, q].flatten(), variance, rtol=1e-4, atol=1e-8)


def test_the_prior_is_every_part_of_the_model(unsure: FaceStatistics, lights: torch.Tensor) -> None:
    """n, v, the code with what its basis loses, the gain and noise, added up."""
    wanted = targets(lights)
    relighter = StatisticalRelighter(unsure, "face", noise=NOISE)
    out = relighter(torch.rand(1, 1, *SMALL).double(), wanted, torch.zeros(1, 3)).variance.flatten(2)[0]
    whole, face = reference.Face(unsure), unsure.face
    of_lost = []
    for q, s in enumerate(wanted.numpy()):
        loadings, lost = whole.loadings(s)
        average = np.array([pixel.mean(s) for pixel in whole.pixels])
        local = np.array([pixel.covariance(s, s) for pixel in whole.pixels])
        parts = local + lost**2 + (loadings**2).sum(1) + float(unsure.gain_spread) ** 2 * average**2
        assert np.allclose(out[q], parts + (NOISE / 255) ** 2, rtol=1e-4)
        of_lost.append((lost**2 / parts).max())
    assert face is not None
    assert max(of_lost) > 0.02  # it counts here


@pytest.mark.parametrize("brightness", [False, True], ids=["plain", "brightness"])
@pytest.mark.parametrize("covariance", ["pixel", "face"])
def test_a_mask_hides_pixels_from_code_and_gain(
    people: torch.Tensor,
    uneven: torch.Tensor,
    unsure: FaceStatistics,
    lights: torch.Tensor,
    covariance: str,
    brightness: bool,
) -> None:
    """Against the reference with those pixels left out of what the whole face tells, its brightness read off the rest
    and less surely so; each still tells of itself."""
    statistics = unsure if brightness else FaceStatistics.fit(uneven, lights, rank=5, face_rank=3, basis=3).double()
    mask = torch.ones(1, *SMALL)
    mask[0, 0], mask[0, 1, 1] = 0, 0.4
    images = people[13, SOURCES[:2], 1::6, 2::5].double() * 0.5
    images[:, 0] = 0.9  # a hat
    sources, wanted = lights[SOURCES[:2]].double(), targets(lights)
    relighter = StatisticalRelighter(statistics, covariance, noise=NOISE)  # type: ignore[arg-type]
    out = relighter.condition(images[None], sources, mask=mask).mean(wanted)[0].flatten(1)
    plain = relighter.condition(images[None], sources).mean(wanted)[0].flatten(1)
    y, s, weight = images.flatten(1).numpy(), sources.numpy(), mask.flatten().double().numpy()
    whole, gain = reference.Face(statistics), 1.0
    pixels = [reference.Pixel(statistics, *divmod(p, SMALL[1])) for p in range(SMALL[0] * SMALL[1])]
    if brightness:
        expected = np.array([[pixel.mean(light) for pixel in pixels] for light in s])
        noise = np.array([pixels[0].weights(light) @ statistics.gain_noise.numpy() for light in s])
        for k, light in enumerate(s):  # a part of the face averages less out of what else people differ in
            of_code = whole.loadings(light)[0] if covariance == "face" else np.eye(16)
            part, all_of_it = (
                np.linalg.norm((w * expected[k]) @ of_code) / (w @ expected[k] ** 2) for w in (weight, np.ones(16))
            )
            noise[k] *= part / all_of_it
        gain, _ = reference.gain(y, expected, float(statistics.gain_spread), noise, s, NOISE / 255, weight)
    for q, target in enumerate(wanted.numpy()):
        if covariance == "face":
            mean, _ = whole.relight(y, s, target, gain, noise=NOISE / 255, weight=weight)
        else:
            mean = np.array([p.relight(y[:, i], s, target, gain, 0, NOISE / 255)[0] for i, p in enumerate(pixels)])
        assert np.allclose(out[q], np.maximum(mean, 0), atol=1e-5)
    assert ((out - plain).abs().max() > 0.01) == (brightness or covariance == "face")


@pytest.mark.parametrize("bright", [0.5, 1.7])
def test_a_fixed_normal_counts_gain_and_noise_too(
    unsure: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, bright: float
) -> None:
    """(3.19), (3.20) with the gain divided out, its spread times the image of black inputs, and noise."""
    chosen = [0, 5, 12, 21]
    images = people[13, chosen, 1::6, 2::5].double() * 0.5 * bright
    sources, wanted = lights[chosen].double(), targets(lights)
    sigma = torch.full((4, 1), NOISE / 255).double()
    out = MaximumLikelihood(unsure, images, sources, sigma, new_noise=NOISE / 255).relight(wanted)
    y, s = images.flatten(1).numpy(), sources.numpy()
    gain, spread = known_gain(unsure, y, s)
    for p in (0, 6, 15):
        pixel = reference.Pixel(unsure, *divmod(p, SMALL[1]))

        def of_v(a: np.ndarray, b: np.ndarray, pixel: reference.Pixel = pixel) -> float:
            return pixel.covariance(a, b) - a @ pixel.n_cov @ b

        inverse = np.linalg.inv(np.array([[of_v(a, b) for b in s] for a in s]) + (NOISE / 255 / gain) ** 2 * np.eye(4))
        precision = s.T @ inverse @ s
        average = np.array([pixel.mean(a) - a @ pixel.n_mean for a in s])
        for q, target in enumerate(wanted.numpy()):
            r = np.array([of_v(a, target) for a in s])
            means = []
            for x in (y[:, p] / gain - average, -average):
                n = np.linalg.solve(precision, s.T @ inverse @ x)
                means.append(target @ n + pixel.mean(target) - target @ pixel.n_mean + r @ inverse @ (x - s @ n))
            d = target - s.T @ inverse @ r
            left = d @ np.linalg.solve(precision, d) + of_v(target, target) - r @ inverse @ r
            variance = gain**2 * (left + spread**2 * means[1] ** 2) + (NOISE / 255) ** 2
            assert abs(float(out.mean[q].flatten()[p]) - max(gain * means[0], 0)) < 1e-5
            assert float(out.variance[q].flatten()[p]) == pytest.approx(variance, rel=1e-3)


@pytest.mark.parametrize("covariance", ["pixel", "face"])
def test_an_unknown_light_and_an_unknown_gain_together(
    people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    """Mean of the variances under each light drawn, each with its own gain, plus the variance of the means."""
    gains = torch.linspace(0.6, 1.5, 12)[:, None, None, None]
    statistics = FaceStatistics.fit(people[:12] * 0.6 * gains, lights, rank=6, face_rank=4, brightness=True)
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, covariance, estimator)  # type: ignore[arg-type]
    image = people[12:13, 3:4] * 0.9
    out = relighter(image, lights[5:7], draws=6)
    each = [relighter.condition(image, light).people[0] for light in estimator.sample(image, 6)[0]]
    means, variances = (torch.stack([getattr(e, w)(lights[5:7]) for e in each]) for w in ("mean", "variance"))
    assert torch.allclose(out.variance[0].flatten(1), variances.mean(0) + means.var(0, correction=0), atol=1e-6)
    assert (out.variance[0].flatten(1) > variances.mean(0)).float().mean() > 0.99


def test_intervals_hold_for_people_of_the_model(unsure: FaceStatistics, lights: torch.Tensor) -> None:
    """Drawn from the per-pixel model, each with a gain and rounding noise: 95 % intervals hold 92 to 98 %, for the
    prior and from one image."""
    wanted = torch.cat((lights[:1].double(), targets(lights)[1:3]))
    places = [divmod(p, SMALL[1]) for p in range(SMALL[0] * SMALL[1])]
    pixels = [reference.Pixel(unsure, *at) for at in places]
    generator = np.random.default_rng(0)
    count, s = 150, wanted.numpy()
    gains = np.exp(float(unsure.gain_spread) * generator.standard_normal(count))
    drawn = np.empty((count, 3, len(pixels)))
    for p, pixel in enumerate(pixels):
        covariance = np.array([[pixel.covariance(a, b) for b in s] for a in s]) + 1e-12 * np.eye(3)
        mean = np.array([pixel.mean(a) for a in s])
        drawn[:, :, p] = generator.multivariate_normal(mean, covariance, count)
    drawn = gains[:, None, None] * drawn + NOISE / 255 * generator.standard_normal(drawn.shape)
    images = torch.from_numpy(drawn).unflatten(2, SMALL)
    average = np.array([pixel.mean(s[0]) for pixel in pixels])
    noise = np.log(drawn[:, 0] / gains[:, None] @ average).std()  # of a gain read off these sixteen pixels
    statistics = FaceStatistics(unsure.lights.float())
    statistics.load_state_dict(unsure.state_dict())
    statistics = statistics.double()
    statistics.gain_noise.fill_(float(noise))
    relighter = StatisticalRelighter(statistics, noise=NOISE)
    for source in (torch.zeros(1, 3), lights[:1]):
        posterior = relighter.condition(images[:, :1].clamp_min(0), source).people
        inside = []
        for person, truth in zip(posterior, images.flatten(2), strict=True):
            mean = torch.stack([c.weight @ c.mean for c in map(person.components, wanted[1:])])
            variance = person.variance(wanted[1:])
            inside.append(((truth[1:] - mean).abs() < 1.96 * variance.sqrt()).double().mean())
        assert 0.92 < float(torch.stack(inside).mean()) < 0.98
