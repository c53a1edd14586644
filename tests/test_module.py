"""What users of torch expect of a module: gradients, dtypes, states that load, and one device."""

import copy
import io
from collections.abc import Callable, Iterator

import pytest
import torch
from conftest import SIZE, shaded_people
from elsewhere import AWAY, Elsewhere

from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.estimator import LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifier import Classifier, SumClassifier
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.opencv import OpenCVClassifier
from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
from facerelight.recognition.subspaces import IncrementalSubspace
from facerelight.viewpoint.pose import ViewRelighter
from facerelight.viewpoint.regions import GroupRelighter, make_regions, random_groups
from facerelight.viewpoint.views import LightViews

MODELS = ("pixel", "face")
CLASSIFIERS: dict[str, Callable[[], Classifier]] = {
    "nearest": NearestNeighborClassifier,
    "cosine": lambda: NearestNeighborClassifier("cosine"),
    "l0": lambda: NearestNeighborClassifier("l0"),
    "vote": lambda: NearestNeighborClassifier(neighbors=3),
    "individual": lambda: IndividualPCAClassifier(2),
    "individual, cosine": lambda: IndividualPCAClassifier(2, metric="cosine", shift=1),
    "global": lambda: GlobalPCAClassifier(4),
    "gaussian": lambda: GaussianClassifier(2, 2),
}
TARGETS = torch.tensor([[0.3, 0.2, 0.9], [-0.5, 0.1, 0.8]])


# gradients


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "brightness"])
def tiny(request: pytest.FixtureRequest) -> FaceStatistics:
    """Six pixels, nine lights."""
    lights = even_hemisphere(9)
    people = shaded_people(8, lights, 5)[:, :, 4::9, 3::8]
    return FaceStatistics.fit(
        people, lights, rank=3, face_rank=3, basis=5, temper=2.0, brightness=request.param
    ).double()


@pytest.mark.parametrize("covariance", MODELS)
@pytest.mark.parametrize("what", ["mean", "variance", "forward"])
def test_gradients_are_those_of_differences(tiny: FaceStatistics, covariance: str, what: str) -> None:
    """With respect to the images and to the lights of both, near an input light too."""
    generator = torch.Generator().manual_seed(0)
    relighter = StatisticalRelighter(tiny, covariance)
    sources = torch.tensor([[0.1, 0.2, 0.95], [0.6, -0.2, 0.7]]).double()
    targets = torch.cat((TARGETS.double(), sources[:1] + 0.03))
    images = 0.2 + 0.5 * torch.rand(1, 2, *tiny.size, generator=generator, dtype=torch.float64)

    def render(x: torch.Tensor, to: torch.Tensor, given: torch.Tensor) -> torch.Tensor:
        if what == "forward":
            return torch.stack(tuple(relighter(x, to, given)))
        return getattr(relighter.condition(x, given), what)(to)

    inputs = tuple(tensor.requires_grad_() for tensor in (images, targets, sources))
    assert torch.autograd.gradcheck(render, inputs, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("covariance", MODELS)
def test_gradients_are_finite_where_terms_vanish(people: torch.Tensor, lights: torch.Tensor, covariance: str) -> None:
    """At the bootstrap lights of a model of full rank and full basis nothing is left to the narrow kernel."""
    statistics = FaceStatistics.fit(people[:6], lights, rank=30, face_rank=4, basis=30)
    images = people[12:13, :2].clone().requires_grad_()
    sources, targets = lights[:2].clone().requires_grad_(), lights[:4].clone().requires_grad_()
    out = StatisticalRelighter(statistics, covariance)(images, targets, sources)
    (out.mean.sum() + out.variance.sum()).backward()
    for tensor in (images, sources, targets):
        assert tensor.grad is not None
        assert torch.isfinite(tensor.grad).all()
        assert tensor.grad.any()


@pytest.mark.parametrize("covariance", MODELS)
def test_the_graph_does_not_change_the_answer(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    relighter = StatisticalRelighter(statistics, covariance)
    images, targets = people[12:13, :3], lights[2:9]
    plain = relighter(images, targets, lights[:3])
    graph = relighter(images.clone().requires_grad_(), targets, lights[:3])
    assert graph.mean.requires_grad
    assert graph.variance.dtype == plain.variance.dtype
    assert torch.allclose(graph.mean, plain.mean, atol=1e-6)
    assert torch.equal(graph.variance, plain.variance)


# dtypes


def estimators(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> dict[str, LightEstimator]:
    return {
        "kernel": KernelIlluminationEstimator.fit(people[:12], lights),
        "likelihood": LikelihoodIlluminationEstimator(statistics, count=40),
        "amounts": SoftLightEstimator(statistics, pixels=100),
    }


@pytest.mark.parametrize("given", [torch.float32, torch.float64])
@pytest.mark.parametrize("held", [torch.float32, torch.float64])
def test_the_dtype_of_the_images_comes_back(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, held: torch.dtype, given: torch.dtype
) -> None:
    statistics = copy.deepcopy(statistics).to(held)
    images, targets, known = people[12:14, :2].to(given), lights[4:6].to(given), lights[:2].to(given)
    exact = StatisticalRelighter(copy.deepcopy(statistics).double(), "face")
    for name, estimator in estimators(statistics.float(), people, lights).items():
        relighter = StatisticalRelighter(copy.deepcopy(statistics), "face", estimator).to(held)
        for method in ("expected", "map"):
            for sources in (known, None):
                out = relighter(images, targets, sources, method, draws=3)
                assert out.mean.dtype == out.variance.dtype == given, (name, method)
        assert relighter(people[12:13, [0, 7, 12]].to(given), targets, lights[[0, 7, 12]], "mle").mean.dtype == given
        posterior = relighter.condition(images, known)
        assert {getattr(posterior, each)(targets).dtype for each in ("mean", "mode", "variance")} == {given}
        assert posterior.code().dtype == held
        assert estimator(images).direction.dtype == estimator.sample(images, 3).dtype == given
    assert torch.allclose(
        relighter(images, targets, known).mean.double(),
        exact(images.double(), targets.double(), known.double()).mean,
        atol=1e-4,
    )


def test_a_module_converted_and_back_still_answers(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    for estimator in estimators(statistics, people, lights).values():
        found = estimator(people[12:14, :2]).direction
        there = copy.deepcopy(estimator).double()
        assert torch.allclose(there(people[12:14, :2].double()).direction.float(), found, atol=1e-3)
        assert torch.allclose(there.float()(people[12:14, :2]).direction, found, atol=1e-3)
    double = copy.deepcopy(statistics).double()
    assert LikelihoodIlluminationEstimator(double, count=40)(people[12:14, :2]).direction.shape == (2, 2, 3)
    fitted = FaceStatistics(lights).double()
    for person in people[:5]:
        fitted.update(person)
    assert {tensor.dtype for tensor in fitted.solve().state_dict().values()} == {torch.float64}
    views = LightViews(fitted)
    groups = GroupRelighter(views, make_regions(random_groups(SIZE[0] * SIZE[1], 60)))
    for relighter in (groups, ViewRelighter(views, 2)):
        for dtype in (torch.float32, torch.float64):
            assert relighter(people[12:13, :1].to(dtype), [lights[0]], lights[3]).mean.dtype == dtype


@pytest.mark.parametrize("name", CLASSIFIERS)
def test_classifiers_keep_the_dtype(people: torch.Tensor, name: str) -> None:
    images, labels = people[:4, :6].flatten(0, 1), [i for i in range(4) for _ in range(6)]
    probes = people[4:6, :3].flatten(0, 1)
    single = CLASSIFIERS[name]().fit(images, labels)
    double = CLASSIFIERS[name]().fit(images.double(), labels)
    scores = single.decision_function(probes)
    assert scores.dtype == torch.float32
    assert single.decision_function(probes.double()).dtype == torch.float64
    assert double.decision_function(probes.double()).dtype == torch.float64
    assert {b.dtype for b in double.buffers() if b.is_floating_point()} == {torch.float64}
    converted = copy.deepcopy(single).double()
    for other in (double, converted):
        assert torch.allclose(other.decision_function(probes.double()).float(), scores, rtol=1e-3, atol=1e-3)
    assert torch.allclose(converted.float().decision_function(probes), scores, rtol=1e-3, atol=1e-3)


# states


def through_a_file(state: dict) -> dict:
    file = io.BytesIO()
    torch.save(state, file)
    return torch.load(io.BytesIO(file.getvalue()), weights_only=True)


@pytest.mark.parametrize("name", [*CLASSIFIERS, "sum"])
def test_a_classifier_is_loaded_into_a_fresh_and_into_a_fitted_one(people: torch.Tensor, name: str) -> None:
    images, labels = people[:4, :6].flatten(0, 1), [f"person {i}" for i in range(4) for _ in range(6)]
    others = people[5:8, :5, 2:, 1:].flatten(0, 1)

    def made(fit_to: torch.Tensor | None, names: list) -> Classifier:
        if name == "sum":
            parts = [NearestNeighborClassifier(), IndividualPCAClassifier(2)]
            return SumClassifier([part.fit(images if fit_to is None else fit_to, names or labels) for part in parts])
        return CLASSIFIERS[name]() if fit_to is None else CLASSIFIERS[name]().fit(fit_to, names)

    learned = made(images, labels)
    learned.calibrate(images, 0.2)
    state = through_a_file(learned.state_dict())
    probes = people[4:6, :3].flatten(0, 1)
    for other in (made(None, []), made(others, [f"other {i}" for i in range(3) for _ in range(5)])):
        other.load_state_dict(state)
        assert other.classes_ == learned.classes_
        assert torch.equal(other.decision_function(probes), learned.decision_function(probes))
        assert other.predict(probes) == learned.predict(probes)
        with pytest.raises(ValueError, match="images"):
            other.decision_function(others)


def test_opencv_says_what_to_do(people: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="call fit instead"):
        OpenCVClassifier("lbph").load_state_dict(OpenCVClassifier("lbph").fit(people[:2, 0], [0, 1]).state_dict())


@pytest.mark.parametrize("covariance", MODELS)
def test_statistics_and_relighters_are_loaded_into_fresh_ones(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, covariance: str
) -> None:
    state = through_a_file(statistics.state_dict())
    other_lights = even_hemisphere(12)
    fresh = FaceStatistics(other_lights)
    other = FaceStatistics.fit(shaded_people(5, other_lights, 3)[:, :, 2:], other_lights, rank=2, face_rank=1)
    plain = FaceStatistics.fit(people[:5], lights, rank=2)
    images, targets = people[12:13, :2], lights[4:6]
    expected = StatisticalRelighter(statistics, covariance)(images, targets, lights[:2])
    before = other.key
    for empty in (fresh, other, plain):
        empty.load_state_dict(state)
        assert empty.key == statistics.key != before
        out = StatisticalRelighter(empty, covariance)(images, targets, lights[:2])
        assert torch.equal(out.mean, expected.mean)
        assert torch.equal(out.variance, expected.variance)
        with pytest.raises(RuntimeError, match="fit anew"):
            empty.update(people[0])
    again = FaceStatistics.fit(people[:5], lights, rank=2, face_rank=2)
    again.load_state_dict(FaceStatistics.fit(people[:6], lights, rank=3).state_dict())
    assert again.face is None
    relighter = StatisticalRelighter(statistics, covariance, KernelIlluminationEstimator.fit(people[:12], lights))
    few = StatisticalRelighter(
        FaceStatistics.fit(people[:5], lights, rank=2, face_rank=2),
        covariance,
        KernelIlluminationEstimator.fit(people[:5], lights, thumbnail=(12, 10)),
    )
    few.load_state_dict(through_a_file(relighter.state_dict()))
    assert torch.equal(few(images, targets, draws=3).mean, relighter(images, targets, draws=3).mean)


def test_likelihoods_and_incremental_subspaces_are_loaded(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor
) -> None:
    learned = LikelihoodIlluminationEstimator(statistics, count=40)
    small = LikelihoodIlluminationEstimator(FaceStatistics.fit(people[:4, :, 4:], lights, rank=2), count=20, pixels=50)
    small.load_state_dict(through_a_file(learned.state_dict()))
    assert torch.equal(small(people[12:13, :2]).direction, learned(people[12:13, :2]).direction)
    space, fresh = IncrementalSubspace(20), IncrementalSubspace(20)
    for row in torch.rand(5, 20):
        space.add(row)
    fresh.load_state_dict(space.state_dict())
    assert torch.equal(fresh.basis, space.basis)


# devices


def test_the_second_device_refuses_the_first() -> None:
    with Elsewhere():
        away = torch.rand(3, 3).to(AWAY)
        assert (away @ away + 1).device == AWAY
        assert torch.equal((away * 2).cpu(), away.cpu() * 2)
        assert torch.eye(3, device=AWAY).sum().item() == 3
        with pytest.raises(RuntimeError, match="same device"):
            away @ torch.rand(3, 3)


@pytest.fixture(params=["emulated", "a GPU"])
def second(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """A device that is not the CPU, for the length of a test."""
    if request.param == "a GPU":
        if not torch.cuda.is_available():
            pytest.skip("needs a GPU")
        yield torch.device("cuda", 0)
    else:
        with Elsewhere():
            yield AWAY


@pytest.mark.parametrize("covariance", MODELS)
@pytest.mark.parametrize("brightness", [False, True])
def test_everything_stays_on_one_device(
    people: torch.Tensor, lights: torch.Tensor, covariance: str, brightness: bool, second: torch.device
) -> None:
    statistics = FaceStatistics.fit(people[:6], lights, rank=3, face_rank=3, brightness=brightness)
    kernel = KernelIlluminationEstimator.fit(people[:6], lights)
    images, masks = people[12:14, [0, 7, 12]], torch.ones(2, *SIZE)
    sources, targets = lights[[0, 7, 12]], lights[[0, 4]]
    likelihood = LikelihoodIlluminationEstimator(statistics, count=20)
    here = [
        StatisticalRelighter(statistics, covariance, kernel)(images, targets, s, m, draws=2)
        for s, m in ((sources, "expected"), (None, "expected"), (None, "map"), (sources, "mle"))
    ]
    away = [tensor.to(second) for tensor in (images, targets, sources, masks)]
    relighter = StatisticalRelighter(statistics, covariance, kernel).to(second)
    there = [
        relighter(away[0], away[1], s, m, draws=2)
        for s, m in ((away[2], "expected"), (None, "expected"), (None, "map"), (away[2], "mle"))
    ]
    for a, b in zip(here, there, strict=True):
        assert b.mean.device == b.variance.device == second
        assert torch.allclose(b.mean.cpu(), a.mean, atol=1e-5)
        assert torch.allclose(b.variance.cpu(), a.variance, atol=1e-5)
    masked = relighter.condition(away[0], away[2], mask=away[3])
    assert masked.mean(away[1]).device == second
    if covariance == "face":
        assert masked.code().device == second
    assert relighter.condition(away[0], away[2], register=True).mean(away[1]).device == second
    moved = likelihood.to(second)
    assert moved(away[0], away[3]).direction.device == moved.sample(away[0], 3).device == second
    made = LikelihoodIlluminationEstimator(relighter.statistics, count=20)
    assert made(away[0]).direction.device == second


def test_fits_stay_on_one_device(people: torch.Tensor, lights: torch.Tensor, second: torch.device) -> None:
    images, labels = people[:4, :6].flatten(0, 1), [i for i in range(4) for _ in range(6)]
    learned = FaceStatistics.fit(people[:6].to(second), lights.to(second), rank=3, face_rank=2)
    assert {tensor.device for tensor in learned.state_dict().values()} == {second}
    kernel = KernelIlluminationEstimator.fit(people[:6].to(second), lights.to(second))
    assert kernel(people[12:13, :2].to(second)).direction.device == second
    for name, make in CLASSIFIERS.items():
        if name == "gaussian":
            make = lambda: GaussianClassifier(1, 2)  # noqa: E731  k-means is SciPy's
        classifier = make().fit(images.to(second), labels)
        assert classifier.decision_function(images.to(second)).device == second, name
        assert len(classifier.predict(images.to(second))) == 24
