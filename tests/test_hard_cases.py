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
from facerelight.model.covariance import deviation_covariance, image_covariance, light_terms
from facerelight.model.learning import FitOptions
from facerelight.model.statistics import FaceStatistics
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


def case(name: str, promise: str) -> Callable:
    """Register a row of the table: what is hard, and what is promised."""

    def register(function: Callable) -> Callable:
        CASES[name] = (promise, function)
        return function

    return register


class World:
    """A relighter of one covariance model and dtype, its people and lights, and a reference in float64."""

    def __init__(
        self,
        statistics: FaceStatistics,
        people: torch.Tensor,
        lights: torch.Tensor,
        covariance: str,
        dtype: torch.dtype,
    ) -> None:
        estimator = KernelIlluminationEstimator.fit(people[:12], lights)
        self.relighter = StatisticalRelighter(
            copy.deepcopy(statistics), covariance, copy.deepcopy(estimator), noise=0
        ).to(dtype)
        self.exact = StatisticalRelighter(copy.deepcopy(statistics), covariance, estimator, noise=0).double()
        self.people, self.lights, self.covariance, self.dtype = people.to(dtype), lights.to(dtype), covariance, dtype

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


@case("identical input images and lights, K = 2 to 8", "as one of them, within 0.5 grey levels")
def identical_inputs(w: World) -> None:
    one = w.relight(w.people[12, :1], w.lights[:1], w.lights[9:10]).mean
    for k in (2, 8):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)  # an exactly singular covariance is nudged, and says so
            many = w.relight(w.people[12, :1].expand(k, -1, -1), w.lights[:1].expand(k, -1), w.lights[9:10]).mean
        assert (many - one).abs().max() < GREY


@case("two lights 1e-1 to 1e-8 rad apart", "within 2 grey levels of float64, finite")
def nearly_identical_lights(w: World) -> None:
    for exponent in range(-1, -9, -1):
        lights = torch.stack((w.lights[0], near(w.lights[0], 10.0**exponent)))
        images = w.people[12, :1].expand(2, -1, -1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            assert w.against_float64(images, lights, w.lights[9:10]) < 2 / 255


@case("contradictory images under lights 1e-2 to 1e-4 rad apart", "finite; at 1e-2 both returned within 2 grey levels")
def contradictory(w: World) -> None:
    images = torch.stack((w.people[12, 0] * 0.5, w.people[12, 0]))
    for angle in (1e-2, 1e-3, 1e-4):
        lights = torch.stack((w.lights[0], near(w.lights[0], angle)))
        out = w.relight(images, lights, torch.cat((lights, w.lights[9:10])))
        assert torch.isfinite(out.mean).all()
        assert angle < 1e-2 or (out.mean[0, :2] - images).abs().max() < 2 / 255


@case("K = 21 inputs", "inputs returned within 0.5 grey levels, variance below 1e-6")
def many_inputs(w: World) -> None:
    out = w.relight(w.people[12, :21], w.lights[:21], w.lights[:21])
    assert (out.mean[0] - w.people[12, :21]).abs().max() < GREY
    assert out.variance.max() < 1e-6


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


@case("all-black image, light known", "a dark face, finite")
def black_known(w: World) -> None:
    out = w.relight(torch.zeros(1, *SIZE, dtype=w.dtype), w.lights[:1], w.lights[:1])
    assert out.mean.abs().max() < GREY


@case("all-white, constant, saturated images", "finite, returned at their own light within 0.5 grey levels")
def white(w: World) -> None:
    for image in (torch.ones(SIZE), torch.full(SIZE, 0.3), (w.people[12, 0].float() * 4).clamp(0, 1)):
        out = w.relight(image[None].to(w.dtype), w.lights[:1], w.lights[[0, 9]])
        assert (out.mean[0, 0] - image.to(w.dtype)).abs().max() < GREY
        assert torch.isfinite(out.variance).all()


@case("one bright pixel in a black image", "finite; returned at its own light")
def bright_pixel(w: World) -> None:
    image = torch.zeros(1, *SIZE, dtype=w.dtype)
    image[0, 10, 10] = 1
    out = w.relight(image, w.lights[:1], w.lights[[0, 9]])
    assert (out.mean[0, 0] - image[0]).abs().max() < GREY
    assert torch.isfinite(out.mean).all()
    assert torch.isfinite(w.relight(image, None, w.lights[:1], draws=4).mean).all()


@case("white-noise images, K = 5", "returned at their own lights within 0.5 grey levels")
def noise(w: World) -> None:
    images = torch.rand(5, *SIZE, generator=torch.Generator().manual_seed(0)).to(w.dtype)
    out = w.relight(images, w.lights[:5], w.lights[:5])
    assert (out.mean[0] - images).abs().max() < GREY


@case("intensities of 1e-6", "returned within half of the brightest; a face as much under another light")
def faint(w: World) -> None:
    faint_image = w.people[12, :1] * 1e-6
    out, black = (w.relight(image, w.lights[:1], w.lights[[0, 9]]).mean[0] for image in (faint_image, faint_image * 0))
    assert (out[0] - faint_image[0]).abs().max() < 0.5 * faint_image.max()  # all black is further off
    assert 0.5 < (out - black).amax((1, 2)).min() / faint_image.max() < 2
    assert w.relighter.estimator(faint_image[None].float() * 100).direction.norm() > 0.9


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
    "finite, variance at least that near the bootstrap lights' edge, no error",
)
def behind(w: World) -> None:
    targets = torch.stack([light_from_angles(a, 0.0) for a in (90.0, -90.0, 120.0, 180.0)]).to(w.dtype)
    out = w.relight(w.people[12, :1], w.lights[:1], targets)
    assert torch.isfinite(out.mean).all()
    assert torch.isfinite(out.variance).all()
    assert torch.isfinite(w.relight(w.people[12, :1], targets[2:3], w.lights[:1]).mean).all()
    assert (out.mean >= 0).all()
    spread = out.variance[0]
    assert (spread[2] >= spread[0] * (1 - 1e-4) - 1e-9).all()
    assert (spread[3] >= spread[:2].amax(0) * (1 - 1e-4) - 1e-9).all()


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


@case("degenerate light-error covariance", "samples equal the estimate; rank one: on its great circle; both finite")
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
    assert (drawn - found).norm(dim=1).max() > 0.1
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


@case(
    "pixels with zero variance over people",
    "finite; the pixel's own mean within 10 grey levels at every light; Consistency holds there too",
)
def zero_variance(w: World) -> None:
    people = w.people[:12].clone()
    people[:, :, :4] = 0.25
    fitted(w, people, w.lights)
    face = {"face_rank": 3} if w.covariance == "face" else {}
    statistics = FaceStatistics.fit(people.float(), w.lights.float(), rank=4, **face).to(w.dtype)
    image = w.people[12:13, :1].clone()
    relighter = StatisticalRelighter(statistics, w.covariance, noise=0)
    out = relighter(image, w.lights[:1], source_lights=w.lights[:1])
    assert (out.mean - image).abs().max() < GREY
    image[:, :, :4] = 0.25
    for light in (w.lights[:1], torch.zeros(1, 3, dtype=w.dtype)):  # seen, and not seen
        assert (relighter(image, w.lights, source_lights=light).mean[0, :, :4] - 0.25).abs().max() < 10 / 255


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


@case("all subjects identical", "finite; variance at its floor")
def identical_subjects(w: World) -> None:
    out = relit_by(w, w.people[:1].expand(8, -1, -1, -1), w.lights)
    assert out.variance.max() < 2 * FitOptions().floor ** 2 + GREY**2  # and the noise of a new image


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


@case("fewer exemplars than dimensions, identical or black exemplars", "finite scores; who can be told apart is")
def few_exemplars(w: World) -> None:
    for images in (torch.rand(2, 8, 8), torch.ones(2, 8, 8), torch.zeros(2, 8, 8)):
        for make in (IndividualPCAClassifier(9), GlobalPCAClassifier(9), NearestNeighborClassifier()):
            classifier = make.fit(images.to(w.dtype), ["a", "b"])
            assert torch.isfinite(classifier.decision_function(torch.rand(3, 8, 8))).all()
            assert classifier.predict(images) == ["a", "b"] or torch.equal(images[0], images[1])


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
