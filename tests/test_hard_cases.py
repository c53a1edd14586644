"""Hard cases, each a row with the promise it keeps; the table of tests/README.md is printed from them
(``python tests/test_hard_cases.py``)."""

import copy
import warnings
from collections.abc import Callable

import pytest
import torch
from conftest import SIZE, shaded_people

from facerelight.geometry.lights import even_hemisphere, light_from_angles, thesis_grid
from facerelight.inference.posterior import Relit
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.covariance import deviation_covariance, image_covariance, prior_mean
from facerelight.model.learning import FitOptions
from facerelight.model.light_terms import light_terms
from facerelight.model.statistics import FaceLoadings, FaceStatistics
from facerelight.model.subjects import face_operators
from facerelight.numerics.gaussian import (
    NotPositiveDefiniteError,
    NumericalWarning,
    condition_gaussian,
    positive_variance,
    safe_cholesky,
)
from facerelight.numerics.kernels import kernel_weights
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
from facerelight.recognition.subspaces import IncrementalSubspace

CASES: dict[str, tuple[str, Callable]] = {}
MODELS = [("pixel", torch.float32), ("pixel", torch.float64), ("face", torch.float32), ("face", torch.float64)]
GREY = 0.5 / 255
NOISE = 1 / 255  # the default, in radiance


def case(name: str, promise: str) -> Callable:
    """Register a row of the table: what is hard, and what is promised."""

    def register(function: Callable) -> Callable:
        CASES[name] = (promise, function)
        return function

    return register


class World:
    """A relighter of one covariance model and dtype, its people and lights, and a reference in float64.

    Inputs have the package's default noise; ``noiseless`` is the same world without, where Consistency is exact.
    """

    def __init__(
        self,
        statistics: FaceStatistics,
        people: torch.Tensor,
        lights: torch.Tensor,
        covariance: str,
        dtype: torch.dtype,
        **noise: float,
    ) -> None:
        estimator = KernelIlluminationEstimator.fit(people[:12], lights)
        self.relighter = StatisticalRelighter(
            copy.deepcopy(statistics), covariance, copy.deepcopy(estimator), **noise
        ).to(dtype)
        self.exact = StatisticalRelighter(copy.deepcopy(statistics), covariance, estimator, **noise).double()
        self.people, self.lights, self.covariance, self.dtype = people.to(dtype), lights.to(dtype), covariance, dtype
        self.noiseless = self if noise else World(statistics, people, lights, covariance, dtype, noise=0)

    def relight(self, images: torch.Tensor, sources: torch.Tensor | None, targets: torch.Tensor, **options):
        return self.relighter(images[None], targets, source_lights=sources, **options)

    def against_float64(self, images: torch.Tensor, sources: torch.Tensor, targets: torch.Tensor) -> float:
        """Largest difference of the mean from the float64 model's."""
        exact = self.exact(images[None].double(), targets.double(), source_lights=sources.double()).mean
        return float((self.relight(images, sources, targets).mean.double() - exact).abs().max())


@pytest.fixture(scope="module", params=MODELS, ids=[f"{m}-{str(d)[6:]}" for m, d in MODELS])
def world(
    request: pytest.FixtureRequest, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> World:
    return World(statistics, people, lights, *request.param)


def near(light: torch.Tensor, angle: float) -> torch.Tensor:
    """A light ``angle`` radians from ``light``."""
    side = torch.linalg.cross(light, torch.tensor([0.0, 1.0, 0.3], dtype=light.dtype))
    return torch.nn.functional.normalize(light + angle * side / side.norm(), dim=-1)


# ---- inputs


@case("identical input images and lights, K = 2 to 8", "as one of them, within 0.5 grey levels, with noise and without")
def identical_inputs(w: World) -> None:
    for world in (w, w.noiseless):
        one = world.relight(w.people[12, :1], w.lights[:1], w.lights[9:10]).mean
        for k in (2, 8):
            with warnings.catch_warnings():
                warnings.simplefilter("error" if world is w else "ignore", NumericalWarning)  # singular without noise
                many = world.relight(w.people[12, :1].expand(k, -1, -1), w.lights[:1].expand(k, -1), w.lights[9:10])
            assert (many.mean - one).abs().max() < GREY


@case(
    "two lights 1e-1 to 1e-8 rad apart",
    "within 0.1 grey levels of float64, and without noise within 2, finite",
)
def nearly_identical_lights(w: World) -> None:
    for exponent in range(-1, -9, -1):
        lights = torch.stack((w.lights[0], near(w.lights[0], 10.0**exponent)))
        images = w.people[12, :1].expand(2, -1, -1)
        assert w.against_float64(images, lights, w.lights[9:10]) < 0.1 / 255
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            assert w.noiseless.against_float64(images, lights, w.lights[9:10]) < 2 / 255


@case(
    "contradictory images under lights 1e-2 to 1e-4 rad apart",
    "their middle within 3 grey levels at their lights, at most 5 beyond what either gives at another from 1e-3 on;"
    " without noise finite, and at 1e-2 both returned within 2",
)
def contradictory(w: World) -> None:
    images = torch.stack((w.people[12, 0] * 0.5, w.people[12, 0]))
    for angle in (1e-2, 1e-3, 1e-4):
        lights = torch.stack((w.lights[0], near(w.lights[0], angle)))
        targets = torch.cat((lights, w.lights[9:10]))
        out = w.relight(images, lights, targets).mean[0]
        assert (out[:2] - images.mean(0)).abs().max() < 3 / 255
        each = torch.stack([w.relight(images[i : i + 1], lights[i : i + 1], targets).mean[0, 2] for i in (0, 1)])
        assert angle > 1e-3 or (out[2] > each.amin(0) - 5 / 255).all()
        assert angle > 1e-3 or (out[2] < each.amax(0) + 5 / 255).all()
        noiseless = w.noiseless.relight(images, lights, targets).mean[0]
        assert torch.isfinite(noiseless).all()
        assert angle < 1e-2 or (noiseless[:2] - images).abs().max() < 2 / 255


@case(
    "K = 21 inputs",
    "without noise returned within 0.5 grey levels, variance below 1e-6; with it within 0.5 (RMS), variance from once"
    " to twice the noise's",
)
def many_inputs(w: World) -> None:
    images, lights = w.people[12, :21], w.lights[:21]
    out = w.noiseless.relight(images, lights, lights)
    assert (out.mean[0] - images).abs().max() < GREY
    assert out.variance.max() < 1e-6
    noisy = w.relight(images, lights, lights)
    assert (noisy.mean[0] - images).square().mean().sqrt() < GREY
    assert noisy.variance.min() > 0.999 * NOISE**2
    assert noisy.variance.max() < 2.001 * NOISE**2


@case("K = 101 inputs, the thesis's poles ten times each", "finite, within 1 grey level of float64")
def hundred_and_one_inputs(w: World) -> None:
    grid = thesis_grid().to(w.dtype)
    images = shaded_people(1, grid.float(), 7)[0].to(w.dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        assert w.against_float64(images, grid, w.lights[9:10]) < 1 / 255


@case("all-black image, light unknown", "exactly the prior mean and variance")
def black(w: World) -> None:
    zero = torch.zeros(1, *SIZE, dtype=w.dtype)
    out = w.relight(zero, None, w.lights[:3], draws=4)
    prior = w.relight(zero, torch.zeros(1, 3, dtype=w.dtype), w.lights[:3])
    assert torch.equal(out.mean, prior.mean)
    assert torch.equal(out.variance, prior.variance)


@case("all-black image, light known", "a dark face: below 1 grey level at its light, darker than the average at others")
def black_known(w: World) -> None:
    zero, targets = torch.zeros(1, *SIZE, dtype=w.dtype), w.lights[[0, 3, 9]]
    out = w.relight(zero, w.lights[:1], targets)
    prior = w.relight(zero, torch.zeros(1, 3, dtype=w.dtype), targets)
    assert out.mean[0, 0].max() < 1 / 255
    assert (out.mean[0].mean((1, 2)) < 0.7 * prior.mean[0].mean((1, 2))).all()
    assert torch.isfinite(out.variance).all()
    assert (out.variance <= prior.variance * (1 + 1e-5)).all()


def returned(w: World, images: torch.Tensor, lights: torch.Tensor) -> None:
    """Without noise to half a grey level; with it finite, and nearer than the average face."""
    out = w.noiseless.relight(images, lights, torch.cat((lights, w.lights[9:10])))
    assert (out.mean[0, :-1] - images).abs().max() < GREY
    assert torch.isfinite(out.mean).all()
    assert torch.isfinite(out.variance).all()
    noisy = w.relight(images, lights, torch.cat((lights, w.lights[9:10])))
    prior = w.relight(images, torch.zeros_like(lights), lights).mean[0]
    assert (noisy.mean[0, :-1] - images).norm() < 0.3 * (prior - images).norm()
    assert torch.isfinite(noisy.mean).all()
    assert torch.isfinite(noisy.variance).all()


@case(
    "all-white, constant, saturated images",
    "finite; without noise returned at their own light within 0.5 grey levels, with it within 1 (RMS)",
)
def white(w: World) -> None:
    for image in (torch.ones(SIZE), torch.full(SIZE, 0.3), (w.people[12, 0].float() * 4).clamp(0, 1)):
        image = image[None].to(w.dtype)
        returned(w, image, w.lights[:1])
        noisy = w.relight(image, w.lights[:1], w.lights[:1]).mean[0]
        assert (noisy - image).square().mean().sqrt() < 1 / 255


@case("one bright pixel in a black image", "finite; without noise returned at its own light, with it within 1 (RMS)")
def bright_pixel(w: World) -> None:
    image = torch.zeros(1, *SIZE, dtype=w.dtype)
    image[0, 10, 10] = 1
    returned(w, image, w.lights[:1])
    assert (w.relight(image, w.lights[:1], w.lights[:1]).mean[0] - image).square().mean().sqrt() < 1 / 255
    assert torch.isfinite(w.relight(image, None, w.lights[:1], draws=4).mean).all()


@case("white-noise images, K = 5", "finite; without noise returned at their own lights within 0.5 grey levels")
def noise(w: World) -> None:
    returned(w, torch.rand(5, *SIZE, generator=torch.Generator().manual_seed(0)).to(w.dtype), w.lights[:5])


@case(
    "intensities of 1e-6",
    "without noise returned within a fiftieth of the brightest (half in float32), under another light a face as faint;"
    " at 1e-4 the light is found as at 1",
)
def faint(w: World) -> None:
    faint_image = w.people[12, :1] * 1e-6
    out, black = (
        w.noiseless.relight(image, w.lights[:1], w.lights[[0, 9]]).mean[0] for image in (faint_image, faint_image * 0)
    )
    least = 0.5 if w.dtype == torch.float32 else 0.02
    assert (out[0] - faint_image[0]).abs().max() < least * faint_image.max()  # all black is further off
    assert 0.5 < (out - black).amax((1, 2)).min() / faint_image.max() < 2
    other, bright = (out - black)[1], w.noiseless.relight(faint_image * 1e6, w.lights[:1], w.lights[9:10]).mean[0, 0]
    assert (other.sum() / (1e-6 * bright.sum())).log().abs() < 1
    found = w.relighter.estimator(torch.stack((faint_image * 100, faint_image * 1e6))).direction[:, 0]
    assert (found[0] - found[1]).norm() < 1e-3


@case("intensities of 255 or 65535 as float", "refused: ValueError with a hint")
def byte_range(w: World) -> None:
    for scale in (255, 65535):
        with pytest.raises(ValueError, match="divide by 255"):
            w.relight(w.people[12, :1] * scale, w.lights[:1], w.lights[:1])


@case("NaN or infinity in an image", "refused: ValueError")
def not_a_number(w: World) -> None:
    for bad in (torch.nan, torch.inf):
        image = w.people[12, :1].clone()
        image[0, 3, 3] = bad
        with pytest.raises(ValueError, match="NaN or infinity"):
            w.relight(image, w.lights[:1], w.lights[:1])


@case("some inputs dark, some not (zero lights)", "as without the dark ones")
def zero_lights(w: World) -> None:
    lights = w.lights[:3].clone()
    lights[1] = 0
    with_dark = w.relight(w.people[12, :3], lights, w.lights[9:10])
    without = w.relight(w.people[12, [0, 2]], w.lights[[0, 2]], w.lights[9:10])
    assert torch.allclose(with_dark.mean, without.mean, atol=1e-6)


# ---- lights


@case("lights at the poles", "finite; azimuth does not matter there")
def poles(w: World) -> None:
    up = torch.stack([light_from_angles(a, 90.0) for a in (-90.0, 0.0, 77.0)]).to(w.dtype)
    out = w.relight(w.people[12, :1], w.lights[:1], up)
    assert (out.mean[0, 0] - out.mean[0, 2]).abs().max() < 1e-5


@case(
    "lights in the image plane and behind the face",
    "finite, mean never negative, variance behind never below that at the nearest edge, and on the axis at left, right,"
    " above and below, whatever is known; only an input's own light is known better",
)
def behind(w: World) -> None:
    image, known = w.people[12, :1], w.lights[:1]
    around = torch.arange(0.0, 360.0, 45.0).deg2rad()
    edge = torch.stack((around.cos(), around.sin(), torch.zeros(8)), 1).to(w.dtype)
    axis = torch.tensor([[0.0, 0.0, -1.0]], dtype=w.dtype)
    flat = FaceStatistics.fit(w.people[:12].float(), w.lights.float(), rank=4, face_rank=3, brightness=True)
    gains = StatisticalRelighter(flat.to(w.dtype), w.covariance)
    for relighter in (w.relighter, gains):
        for source, method in ((known, "expected"), (torch.zeros_like(known), "expected"), (axis, "expected")):
            at_edge = relighter(image[None], edge, source, method).variance[0]
            for depth in (0.01, 0.5, 1.0):
                targets = torch.nn.functional.normalize((1 - depth**2) ** 0.5 * edge + depth * axis, dim=1)
                out = relighter(image[None], targets, source, method)
                assert torch.isfinite(out.mean).all()
                assert (out.mean >= 0).all()
                least = at_edge[::2].amax(0) if depth == 1 else at_edge
                if source is not axis:
                    assert (out.variance[0] >= least * (1 - 1e-3) - 1e-9).all()
            assert (relighter(image[None], edge, source, method).mean >= 0).all()
    assert w.noiseless.relight(image, axis, axis).variance.max() < 1e-6  # seen from there, it is known there
    for source in (axis, edge[:1]):
        assert torch.isfinite(w.relight(image, source, w.lights[:1]).mean).all()
    unknown = w.relighter.condition(image[None], draws=4)
    assert (unknown.mode(edge) >= 0).all()
    assert (unknown.variance(axis) >= unknown.variance(edge[::2]).amax(1) * (1 - 1e-3)).all()


@case("lights in the image plane and behind the face, n fixed", "the same for n by maximum likelihood")
def behind_mle(w: World) -> None:
    chosen = [0, 1, 2, 3]  # from the front, and so none of them near a target
    around = torch.arange(0.0, 360.0, 45.0).deg2rad()
    edge = torch.stack((around.cos(), around.sin(), torch.zeros(8)), 1).to(w.dtype)
    axis = torch.tensor([[0.0, 0.0, -1.0]], dtype=w.dtype)
    at_edge = w.relight(w.people[12, chosen], w.lights[chosen], edge, method="mle").variance[0]
    for depth in (0.01, 0.5, 1.0):
        targets = torch.nn.functional.normalize((1 - depth**2) ** 0.5 * edge + depth * axis, dim=1)
        out = w.relight(w.people[12, chosen], w.lights[chosen], targets, method="mle")
        assert (out.mean >= 0).all()
        least = at_edge[::2].amax(0) if depth == 1 else at_edge
        assert (out.variance[0] >= least * (1 - 1e-3) - 1e-9).all()


@case("zero, NaN or infinite target lights", "refused: ValueError")
def bad_targets(w: World) -> None:
    for bad in (torch.zeros(1, 3), torch.full((1, 3), torch.nan), torch.tensor([[0.0, torch.inf, 1.0]])):
        with pytest.raises(ValueError, match="lights"):
            w.relight(w.people[12, :1], w.lights[:1], bad.to(w.dtype))


@case("lights that are not unit vectors", "as unit vectors")
def long_lights(w: World) -> None:
    a = w.relight(w.people[12, :1], w.lights[:1] * 1e-3, w.lights[9:10] * 1e4).mean
    assert torch.allclose(a, w.relight(w.people[12, :1], w.lights[:1], w.lights[9:10]).mean, atol=1e-5)


@case("1,000 target lights at once", "equal to one by one")
def many_targets(w: World) -> None:
    targets = even_hemisphere(1000).to(w.dtype)
    posterior = w.relighter.condition(w.people[12:13, :2], w.lights[:2])
    together = posterior.mean(targets)
    assert torch.allclose(together[:, 500:501], posterior.mean(targets[500:501]), atol=1e-5)


@case("kernel weights that all underflow", "a normalised limit: the nearest wins")
def underflow(w: World) -> None:
    weights = kernel_weights(torch.tensor([[1e6, 1e6 + 1, 4e6]], dtype=w.dtype), 1e-2)
    assert weights.tolist() == [[1.0, 0.0, 0.0]]
    narrow = copy.deepcopy(w.relighter.statistics)
    narrow.light_widths.fill_(1e-4)
    assert torch.allclose(narrow.weights(even_hemisphere(50).to(w.dtype)).sum(-1), torch.ones(50, dtype=w.dtype))


@case(
    "degenerate light-error covariance",
    "samples equal the estimate; rank one: on its great circle, as far along it as the error says; both finite",
)
def degenerate_error(w: World) -> None:
    estimator = copy.deepcopy(w.relighter.estimator)
    image = w.people[12:13, 3:4]
    estimator.error_factor.zero_()
    drawn = estimator.sample(image, 8)
    assert torch.allclose(drawn, estimator(image).direction[:, None].expand_as(drawn), atol=1e-5)
    estimator.error_factor[0, 0] = 0.3
    found, drawn = estimator(image).direction[0, 0], estimator.sample(image, 8)[0, :, 0]
    pole = torch.linalg.cross(found, torch.tensor([1.0, 0.0, 0.0], dtype=w.dtype))
    assert (drawn @ pole).abs().max() < 1e-6  # a great circle through the estimate
    drawn = estimator.sample(image, 256)[0, :, 0]
    along = torch.linalg.lstsq(torch.stack((found, found.new_tensor([1.0, 0, 0])), 1), drawn.T).solution  # (2, M)
    step = along[1] / along[0]  # before it was put on the sphere
    assert step.mean().abs() < 0.02
    assert 0.285 < step.std() < 0.315
    assert torch.isfinite(
        StatisticalRelighter(w.relighter.statistics, w.covariance, estimator)(image, w.lights[:1], draws=8).mean
    ).all()


@case("MLE: one, two, coplanar, repeated, collinear lights", "refused: ValueError with count and condition number")
def mle_lights(w: World) -> None:
    flat = torch.stack([light_from_angles(a, 0.0) for a in (-40.0, 0.0, 20.0, 60.0)]).to(w.dtype)
    for lights in (flat[:1], flat[:2], flat, flat[:1].expand(3, -1)):
        with pytest.raises(ValueError, match="condition number"):
            w.relight(w.people[12, : len(lights)], lights, w.lights[:1], method="mle")


@case("MLE: nearly coplanar lights (1 degree off)", "finite, within 2 grey levels of float64")
def mle_nearly_flat(w: World) -> None:
    angles = ((-40.0, 0.0), (0.0, 1.0), (40.0, 0.0), (20.0, -1.0))
    lights = torch.stack([light_from_angles(*a) for a in angles]).to(w.dtype)
    images = shaded_people(1, lights.float(), 9)[0].to(w.dtype)
    exact = w.exact(images[None].double(), w.lights[9:10].double(), source_lights=lights.double(), method="mle").mean
    assert (w.relight(images, lights, w.lights[9:10], method="mle").mean.double() - exact).abs().max() < 2 / 255


# ---- bootstraps


def fitted(w: World, images: torch.Tensor, lights: torch.Tensor, **options) -> torch.Tensor:
    """Relit image and finiteness of a fit to an odd bootstrap."""
    return relit_by(w, images, lights, **options).mean


def relit_by(w: World, images: torch.Tensor, lights: torch.Tensor, **options) -> Relit:
    """Mean and variance of a fit to an odd bootstrap; finite, and not negative."""
    face = {"face_rank": 3} if w.covariance == "face" else {}
    statistics = FaceStatistics.fit(images.float(), lights.float(), **{"rank": 4, **face, **options}).to(w.dtype)
    out = StatisticalRelighter(statistics, w.covariance)(
        w.people[12:13, :1], w.lights[9:10], source_lights=w.lights[:1]
    )
    assert torch.isfinite(out.mean).all()
    assert torch.isfinite(out.variance).all()
    assert (out.variance >= 0).all()
    return out


@case("N = 2 subjects", "finite, variance not negative")
def two_subjects(w: World) -> None:
    fitted(w, w.people[:2], w.lights)


@case("one subject", "refused: ValueError")
def one_subject(w: World) -> None:
    with pytest.raises(ValueError, match="at least 2 subjects"):
        fitted(w, w.people[:1], w.lights)


@case("J = 3 lights, 3 K > N", "finite, variance not negative")
def three_lights(w: World) -> None:
    chosen = torch.tensor([0, 12, 25])
    fitted(w, w.people[:4, chosen], w.lights[chosen])


@case("lights of the bootstrap in one plane", "refused: ValueError")
def flat_bootstrap(w: World) -> None:
    flat = torch.stack([light_from_angles(a, 0.0) for a in (-60.0, -20.0, 20.0, 60.0)])
    with pytest.raises(ValueError, match="linearly independent"):
        FaceStatistics.fit(w.people[:5, :4].float(), flat)


@case("rank >= N - 1, for v and for the whole face", "finite, variance not negative")
def large_rank(w: World) -> None:
    options = {"face_rank": 50} if w.covariance == "face" else {}
    fitted(w, w.people[:6], w.lights, rank=200, **options)


@case("rank 0: no correlation over lights", "finite; face rank 0 is exactly the per-pixel model")
def rank_zero(w: World) -> None:
    fitted(w, w.people[:6], w.lights, rank=0)
    assert FaceStatistics.fit(w.people[:6].float(), w.lights.float(), rank=0).pixel.v_factor.shape[1] == 0
    rows = w.people[:6].flatten(1).double()
    operators = face_operators(rows @ rows.T, 0)
    assert operators.loadings.shape == (0, 6)
    residual = operators.residual.double()
    centring = torch.eye(6, dtype=torch.float64) - 1 / 6
    assert torch.allclose(residual.T @ residual / 6, centring / 5, atol=1e-6)  # the sample covariance's weights
    plain = FaceStatistics.fit(w.people[:6].float(), w.lights.float(), rank=5, floor=1e-5)
    left = torch.einsum("ab,b...->a...", operators.residual, w.people[:6].float())  # about a mean of zero
    # everybody twice, which is divided by 11, where 12 is right
    apart = FaceStatistics.fit(torch.cat((left, -left)) + 1, w.lights.float(), rank=5, floor=1e-5)
    for name in ("n_factor", "v_std"):
        getattr(apart.pixel, name).mul_((11 / 12) ** 0.5)
    size, count = plain.size, len(w.lights)
    nothing = (torch.zeros(0, 3, *size), torch.zeros(0, 4, *size), torch.eye(4, count), torch.zeros(count, *size))
    plain.face = FaceLoadings(*nothing, torch.tensor(100.0), apart.pixel)
    plain.to(w.dtype)
    outs = [
        StatisticalRelighter(plain, c)(w.people[12:13, :2], w.lights[7:12], w.lights[:2]) for c in ("pixel", "face")
    ]
    assert torch.allclose(outs[0].mean, outs[1].mean, atol=0.1 / 255)
    assert torch.allclose(outs[0].variance, outs[1].variance, rtol=1e-2)


@case(
    "pixels with zero variance over people",
    "finite; their own mean, as the kernel over lights has it, within 0.1 grey levels at any light, and with a narrow"
    " kernel within 0.1 of the pixel itself; Consistency holds there too",
)
def zero_variance(w: World) -> None:
    people = w.people[:12].clone()
    people[:, :, :4] = 0.25
    fitted(w, people, w.lights)
    face = {"face_rank": 3} if w.covariance == "face" else {}
    every = even_hemisphere(200).to(w.dtype)
    image = w.people[12:13, :1].clone()
    for width in (None, 0.2):
        statistics = FaceStatistics.fit(people.float(), w.lights.float(), rank=4, kernel_width=width, **face).to(
            w.dtype
        )
        exact = StatisticalRelighter(statistics, w.covariance, noise=0)(image, w.lights[:1], source_lights=w.lights[:1])
        assert (exact.mean - image).abs().max() < GREY
        constant = image.clone()
        constant[:, :, :4] = 0.25
        average = prior_mean(statistics, every).unflatten(1, SIZE)[:, :4]
        for light in (w.lights[:1], torch.zeros(1, 3, dtype=w.dtype)):  # seen, and not seen
            relighter = StatisticalRelighter(statistics, w.covariance)
            # beside the input's own light a pixel follows what was seen
            far = (every - w.lights[0]).norm(dim=1) > 0.5
            out = relighter(constant, every[far], source_lights=light).mean[0, :, :4]
            assert (out - average[far].clamp_min(0)).abs().max() < 0.1 / 255
            if width:
                out = relighter(constant, w.lights, source_lights=light).mean[0, :, :4]
                assert (out - 0.25).abs().max() < 0.1 / 255


@case("a tenth of the images missing", "within 6 grey levels (RMS) of the complete bootstrap's")
def missing_images(w: World) -> None:
    gone = torch.rand(12, 30, generator=torch.Generator().manual_seed(0)) < 0.1
    images = w.people[:12].clone()
    images[gone] = torch.nan
    with_gaps = fitted(w, images, w.lights, valid=~gone)
    assert (with_gaps - fitted(w, w.people[:12], w.lights)).square().mean().sqrt() < 6 / 255


@case("a light without any image", "refused: ValueError")
def missing_light(w: World) -> None:
    valid = torch.ones(12, 30, dtype=torch.bool)
    valid[:, 3] = False
    with pytest.raises(ValueError, match="every light"):
        fitted(w, w.people[:12], w.lights, valid=valid)


@case("one subject ten times", "finite, variance not negative")
def repeated_subject(w: World) -> None:
    fitted(w, torch.cat((w.people[:5], w.people[:1].expand(9, -1, -1, -1))), w.lights)


@case("all subjects identical", "finite; variance at its floor, and the noise of a new image")
def identical_subjects(w: World) -> None:
    out = relit_by(w, w.people[:1].expand(8, -1, -1, -1), w.lights)
    assert out.variance.max() < 1.2 * FitOptions().floor ** 2 + NOISE**2
    assert out.variance.min() > 0.5 * FitOptions().floor ** 2 + NOISE**2


@case(
    "an outlier: one subject 15 times as bright",
    "with brightness as without it, within 0.1 grey levels (RMS); else twice as unsure, and at most 5 times as far off",
)
def outlier(w: World) -> None:
    people, truth = w.people[:12].clone(), w.people[12, 9]
    people[3] *= 15
    for brightness in (True, False):
        spoilt, clean = (relit_by(w, x, w.lights, brightness=brightness) for x in (people, w.people[:12]))
        far = [float((out.mean[0, 0] - truth).square().mean().sqrt()) for out in (spoilt, clean)]
        if brightness:
            assert (spoilt.mean - clean.mean).square().mean().sqrt() < 0.1 / 255
        else:
            assert far[0] < 5 * far[1]
            assert spoilt.variance.mean().sqrt() > 2 * clean.variance.mean().sqrt()


@case("repeated lights in the bootstrap", "merged: equal to the distinct ones")
def repeated_lights(w: World) -> None:
    twice = torch.cat((w.lights, w.lights[:3]))
    images = torch.cat((w.people[:12], w.people[:12, :3]), 1)
    assert torch.allclose(fitted(w, images, twice), fitted(w, w.people[:12], w.lights), atol=1e-5)


# ---- factorisations


@case("singular, indefinite and NaN covariances", "jitter for the singular member alone, named errors for the others")
def factorisation(w: World) -> None:
    singular = torch.ones(3, 3, dtype=w.dtype)
    with pytest.warns(NumericalWarning, match="1 of 2"):
        safe_cholesky(torch.stack((torch.eye(3, dtype=w.dtype), singular)))
    with pytest.raises(NotPositiveDefiniteError, match="semidefinite"):
        safe_cholesky(-torch.eye(2, dtype=w.dtype))
    with pytest.raises(NotPositiveDefiniteError, match="NaN"):
        safe_cholesky(torch.full((2, 2), torch.nan, dtype=w.dtype))


@case("covariances scaled by 1e-30 to 1e30", "the same relative answer")
def scaled_covariances(w: World) -> None:
    one = torch.tensor([[1.0, 0.5], [0.5, 1.0]], dtype=torch.float64)
    for scale in (1e-30, 1e-12, 1.0, 1e12, 1e30):
        out = condition_gaussian(
            torch.zeros(1), torch.zeros(1), scale * one[:1, :1], scale * one[:1, 1:], scale * one[1:, 1:], torch.ones(1)
        )
        assert float(out.mean) == pytest.approx(0.5)


@case("negative variances", "rounding set to zero quietly, more than that counted and warned")
def negative_variances(w: World) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert positive_variance(torch.tensor([1.0, -1e-9], dtype=w.dtype), torch.ones(2)).tolist() == [1.0, 0.0]
    with pytest.warns(NumericalWarning, match="1 of 2 variances"):
        positive_variance(torch.tensor([1.0, -0.1], dtype=w.dtype), torch.ones(2))


@case("covariances over 60 lights, half of them 1e-6 rad from the others", "semidefinite to rounding")
def semidefinite(w: World) -> None:
    lights = even_hemisphere(30).to(w.dtype)
    lights = torch.cat((lights, torch.stack([near(light, 1e-6) for light in lights])))
    statistics = w.relighter.statistics
    pixel, face = (statistics.face.residual, statistics.face) if w.covariance == "face" else (statistics.pixel, None)
    terms = light_terms(statistics, pixel, lights, face)
    for make in (image_covariance, deviation_covariance):
        values = torch.linalg.eigvalsh(make(statistics, pixel, terms, terms))
        assert (values[:, 0] > -1e-12 * values[:, -1]).all()
    own = deviation_covariance(statistics, pixel, terms, terms).diagonal(dim1=1, dim2=2).T
    variance = statistics.weights(lights) @ pixel.v_std.flatten(1).square() + terms.lost[:, 0].square()
    assert torch.allclose(own, variance.double(), rtol=1e-4)  # the correlation's diagonal is 1


# ---- recognition


@case("10,000 incremental SVD updates with duplicates", "orthogonal to 1e-5")
def incremental_svd(w: World) -> None:
    pool = torch.randn(100, 40, generator=torch.Generator().manual_seed(0))[:, :] @ torch.randn(40, 40)
    space = IncrementalSubspace(40, error=1e-4, capacity=20)
    for index in range(10_000 if w.covariance == "pixel" and w.dtype == torch.float32 else 500):
        space.add(pool[index % 100].to(w.dtype))
    assert (space.basis.T @ space.basis - torch.eye(space.basis.shape[1])).abs().max() < 1e-5


@case(
    "fewer exemplars than dimensions, identical or black exemplars",
    "finite scores; who can be told apart is, through noise and in any order; who cannot has the same score",
)
def few_exemplars(w: World) -> None:
    generator = torch.Generator().manual_seed(0)
    apart = torch.rand(2, 8, 8, generator=generator)
    half = torch.zeros(2, 8, 8)
    half[0, :4], half[1, 4:] = 1, 1
    probes = torch.rand(3, 8, 8, generator=generator).to(w.dtype)
    for images in (apart, half, torch.ones(2, 8, 8), torch.zeros(2, 8, 8)):
        images = images.to(w.dtype)
        same = torch.equal(images[0], images[1])
        seen = (images + 0.05 * torch.rand(2, 8, 8, generator=generator)).to(w.dtype)
        for make in (IndividualPCAClassifier, GlobalPCAClassifier, NearestNeighborClassifier):
            one, other = (
                (make() if make is NearestNeighborClassifier else make(9)).fit(images[order], names)
                for order, names in (([0, 1], ["a", "b"]), ([1, 0], ["b", "a"]))
            )
            scores = one.decision_function(torch.cat((probes, images, seen)))
            assert torch.isfinite(scores).all()
            if same:
                assert torch.allclose(scores[:, 0], scores[:, 1], atol=1e-5)
            else:
                for asked in (images, seen):
                    assert one.predict(asked) == other.predict(asked) == ["a", "b"]


@case("an empty gallery, NaN exemplars, one label too few", "refused: ValueError")
def bad_galleries(w: World) -> None:
    for images, labels in (
        (torch.rand(0, 8, 8), []),
        (torch.full((2, 8, 8), torch.nan), ["a", "b"]),
        (torch.rand(2, 8, 8), ["a"]),
    ):
        with pytest.raises(ValueError, match="expected"):
            IndividualPCAClassifier().fit(images.to(w.dtype), labels)


@pytest.mark.parametrize("name", CASES, ids=[name.replace(" ", "-") for name in CASES])
def test_hard_case(world: World, name: str) -> None:
    CASES[name][1](world)


def test_the_table_is_long_enough() -> None:
    assert len(CASES) >= 40


def _plain_weights(squared: torch.Tensor, width: torch.Tensor | float) -> torch.Tensor:
    """The kernel without log space: 0 / 0 where every weight underflows."""
    kernel = torch.exp(-0.5 * squared / torch.as_tensor(width, dtype=squared.dtype) ** 2)
    return kernel / kernel.sum(-1, keepdim=True)


MUTATIONS = {
    "jitter": ("facerelight.numerics.gaussian.JITTER_STEPS", (), "singular, indefinite and NaN covariances"),
    "log-space kernel": ("test_hard_cases.kernel_weights", _plain_weights, "kernel weights that all underflow"),
    "completion of the correlation": (
        "test_hard_cases.light_terms",
        None,
        "covariances over 60 lights, half of them 1e-6 rad from the others",
    ),
    "measurement variance": ("facerelight.model.covariance.MEASUREMENT", 0.0, "two lights 1e-1 to 1e-8 rad apart"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_rows_fail_without_what_they_test(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each safeguard, taken away, makes its row fail: the table tests something."""
    where, mutant, row = MUTATIONS[name]
    real = light_terms
    if mutant is None:

        def mutant(*arguments):
            terms = real(*arguments)
            return terms._replace(narrow=torch.zeros_like(terms.narrow), lost=torch.zeros_like(terms.lost))

    world = World(statistics, people, lights, "pixel", torch.float32)
    CASES[row][1](world)
    monkeypatch.setattr(where, mutant)
    monkeypatch.setattr(warnings, "filters", [("ignore", None, Warning, None, 0)])
    with pytest.raises((AssertionError, RuntimeError, pytest.fail.Exception)):
        CASES[row][1](world)


if __name__ == "__main__":
    print("| hard case | promise |\n|---|---|")
    for name, (promise, _) in CASES.items():
        print(f"| {name} | {promise} |")
