"""Every public callable is fed the same zoo of bad tensors: a named error or the documented answer, never a number out
of nonsense, and never torch's own complaint."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SIZE, MeanColour, marked_face

from facerelight.geometry.lights import angles_from_light, light_from_angles
from facerelight.inference.detail import keep_detail
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.light.soft import fit_soft_light
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.checks import check_index, check_unit
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifier import Classifier, SumClassifier
from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer
from facerelight.recognition.gallery.gallery import Gallery
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
from facerelight.train.cross_validation import choose_face_options
from facerelight.viewpoint.pose import View, ViewRelighter
from facerelight.viewpoint.regions import GroupRelighter, Region, correlation_table, make_regions, random_groups
from facerelight.viewpoint.views import LightViews

EXPLAINED = re.compile(r"expected .*, (got|found) ", re.DOTALL)
PEOPLE = [0, 0, 1, 1]


class World:
    """One of everything that takes images, lights, masks or people."""

    def __init__(self, statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
        self.statistics, self.people, self.lights = statistics, people, lights
        self.three = lights[[0, 7, 12]]
        self.kernel = KernelIlluminationEstimator.fit(people[:12], lights)
        self.likelihood = LikelihoodIlluminationEstimator(statistics, count=40)
        self.relighter = StatisticalRelighter(statistics, "face", self.kernel)
        self.views = LightViews(statistics)
        self.groups = GroupRelighter(self.views, make_regions(random_groups(SIZE[0] * SIZE[1], 100)))
        kinds = (NearestNeighborClassifier(), IndividualPCAClassifier(1), GlobalPCAClassifier(2), GaussianClassifier(1))
        self.classifiers: list[Classifier] = [kind.fit(people[:4, 0], PEOPLE) for kind in kinds]
        self.classifiers.append(SumClassifier(self.classifiers[:2]))


@pytest.fixture(scope="module")
def world(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> World:
    return World(statistics, people, lights)


def zoo(good: torch.Tensor) -> dict[str, Any]:
    """What images are mistaken for."""
    good = good.contiguous()
    spoilt = {bad: good.clone() for bad in (torch.nan, torch.inf)}
    for bad, images in spoilt.items():
        images.view(-1)[7] = bad
    return {
        "NaN": spoilt[torch.nan],
        "infinity": spoilt[torch.inf],
        "0..255": good * 255,
        "bytes": (good * 255).byte(),
        "integers": good.long(),
        "a dimension too few": good[0],
        "a dimension too many": good[None],
        "wider": torch.nn.functional.pad(good, (0, 1)),
        "turned": good.mT.contiguous(),
        "an array": good.numpy(),
        "a list": good.tolist(),
    }


ANY_SIZE = ("wider", "turned")  # where images of any size will do


IMAGES: dict[str, Callable[[World, torch.Tensor], Any]] = {
    "StatisticalRelighter": lambda w, x: w.relighter(x, w.lights[:2], w.three),
    "StatisticalRelighter, mle": lambda w, x: w.relighter(x, w.lights[:2], w.three, "mle"),
    "condition": lambda w, x: w.relighter.condition(x, w.three),
    "KernelIlluminationEstimator*": lambda w, x: w.kernel(x),
    "KernelIlluminationEstimator.sample*": lambda w, x: w.kernel.sample(x, 3),
    "LikelihoodIlluminationEstimator": lambda w, x: w.likelihood(x),
    "LikelihoodIlluminationEstimator.sample": lambda w, x: w.likelihood.sample(x, 3),
    "GroupRelighter": lambda w, x: w.groups(x, list(w.three), w.lights[4]),
    "ViewRelighter": lambda w, x: ViewRelighter(w.views, 3)(x, list(w.three), w.lights[4]),
    "FaceStatistics.fit*": lambda w, x: FaceStatistics.fit(x, w.three),
    "KernelIlluminationEstimator.fit*": lambda w, x: KernelIlluminationEstimator.fit(x, w.three),
    "calibrate": lambda w, x: w.likelihood.calibrate(x, w.three),
}
"""Callables of images ``(B, K, H, W)``, K = 3."""
ROWS: dict[str, Callable[[World, torch.Tensor], Any]] = {
    "log_likelihood": lambda w, x: w.likelihood.log_likelihood(x),
    "posterior": lambda w, x: w.likelihood.posterior(x),
    "keep_detail, photo": lambda w, x: keep_detail(w.people[:4, :2], x),
    "fit_soft_light*": lambda w, x: fit_soft_light(x, w.people[0, 0], torch.ones(SIZE)),
    "update": lambda w, x: FaceStatistics(w.lights[[0, 7, 12, 20]]).update(x),
    **{
        f"{kind}.{method}": lambda w, x, i=i, method=method: getattr(w.classifiers[i], method)(x)
        for i, kind in enumerate(("nearest", "individual", "global", "gaussian", "sum"))
        for method in ("decision_function", "predict", "calibrate")
    },
    **{
        f"{kind.__name__}.fit*": lambda w, x, kind=kind: kind().fit(x, PEOPLE)
        for kind in (NearestNeighborClassifier, IndividualPCAClassifier, GlobalPCAClassifier, GaussianClassifier)
    },
    "reconstruction_error": lambda w, x: w.classifiers[1].reconstruction_error(x),
    "partial_fit*": lambda w, x: IndividualPCAClassifier(1).partial_fit(x, "a"),
}
"""Callables of images ``(M, H, W)``, M = 4."""


def refused(call: Callable[[], Any], what: str = "") -> None:
    """A ``ValueError`` that says what was expected and what came."""
    with pytest.raises(ValueError) as caught:
        call()
    assert EXPLAINED.search(str(caught.value)), caught.value
    assert what in str(caught.value)


@pytest.mark.parametrize("bad", zoo(torch.zeros(1, 2, *SIZE)))
@pytest.mark.parametrize("name", [*IMAGES, *ROWS])
def test_bad_images_are_refused_by_name(world: World, name: str, bad: str) -> None:
    call, good = (IMAGES[name], world.people[:2, :3]) if name in IMAGES else (ROWS[name], world.people[:4, 0])
    if (name.endswith("*") or name == "update") and bad in ANY_SIZE:
        pytest.skip("images of any size will do")
    if name in ("KernelIlluminationEstimator.fit*", "FaceStatistics.fit*") and bad == "NaN":
        pytest.skip("NaN is a missing image, or refused below")
    refused(lambda: call(world, zoo(good)[bad]))


@pytest.mark.parametrize(
    "bad", ["NaN", "infinity", "0..255", "below 0", "a dimension too few", "one person too many", "wider", "an array"]
)
@pytest.mark.parametrize("name", ["condition", "kernel", "kernel.sample", "likelihood", "log_likelihood"])
def test_bad_masks_are_refused_by_name(world: World, name: str, bad: str) -> None:
    mask = torch.ones(2, *SIZE)
    images, lights = world.people[12:14, :1], world.lights[:1]
    wrong = {
        "NaN": mask * torch.nan,
        "infinity": mask * torch.inf,
        "0..255": (mask * 255).byte(),
        "below 0": -mask,
        "a dimension too few": mask[0],
        "one person too many": mask[[0, 0, 0]],
        "wider": torch.nn.functional.pad(mask, (0, 1)),
        "an array": mask.numpy(),
    }[bad]
    calls: dict[str, Callable[[torch.Tensor], Any]] = {
        "condition": lambda m: world.relighter.condition(images, lights, mask=m),
        "kernel": lambda m: world.kernel(images, m),
        "kernel.sample": lambda m: world.kernel.sample(images, 2, mask=m),
        "likelihood": lambda m: world.likelihood(images, m),
        "log_likelihood": lambda m: world.likelihood.log_likelihood(images[:, 0], m),
    }
    refused(lambda: calls[name](wrong), "mask")
    calls[name](mask.bool())  # booleans and integers 0 and 1 are weights, too
    calls[name](mask.long())


def test_integers_say_which_images_exist_and_index_nothing(world: World) -> None:
    valid = torch.rand(12, 30, generator=torch.Generator().manual_seed(0)) > 0.1
    images, lights = world.people[:12], world.lights
    learned = [FaceStatistics.fit(images, lights, v, rank=4).state_dict() for v in (valid, valid.long(), valid.byte())]
    for other in learned[1:]:
        assert all(torch.equal(other[name], learned[0][name]) for name in other)
    found = [KernelIlluminationEstimator.fit(images, lights, v).bias for v in (valid, valid.long())]
    assert torch.equal(*found)
    calibrated = [world.likelihood.calibrate(images, lights, v).temper.clone() for v in (valid, valid.long())]
    assert torch.equal(*calibrated)
    for wrong in (valid.float(), valid[:, :5], valid.long() * 2, valid[0], valid.tolist()):
        for fit in (FaceStatistics.fit, KernelIlluminationEstimator.fit, world.likelihood.calibrate):
            refused(lambda fit=fit, wrong=wrong: fit(images, lights, wrong), "valid")  # type: ignore[operator]
        refused(lambda wrong=wrong: choose_face_options(images, lights, wrong), "valid")


def test_missing_images_need_not_be_finite_and_others_must(world: World) -> None:
    images = world.people[:12].clone()
    images[0, 3, 2, 2] = torch.nan
    refused(lambda: FaceStatistics.fit(images, world.lights), "valid")
    valid = torch.ones(12, 30, dtype=torch.bool)
    valid[0, 3] = False
    assert torch.isfinite(FaceStatistics.fit(images, world.lights, valid, rank=3).n_mean).all()


LIGHTS: dict[str, Callable[[World, Any], Any]] = {
    "target": lambda w, s: w.relighter(w.people[:1, :1], s, w.lights[:1]),
    "target, mle": lambda w, s: w.relighter(w.people[:1, :4], s, w.lights[[0, 7, 12, 20]], "mle"),
    "source": lambda w, s: w.relighter(w.people[:1, :2], w.lights[:1], s),
    "source, mle": lambda w, s: w.relighter(w.people[:1, :2], w.lights[:1], s, "mle"),
    "mean": lambda w, s: w.relighter.condition(w.people[:1, :1], w.lights[:1]).mean(s),
    "variance": lambda w, s: w.relighter.condition(w.people[:1, :1], w.lights[:1]).variance(s),
    "weights": lambda w, s: w.statistics.weights(s),
    "views": lambda w, s: w.views.fields(s),
    "groups": lambda w, s: w.groups(w.people[:1, :2], s, w.lights[3]),
    "angles_from_light": lambda w, s: angles_from_light(s),
    "statistics": lambda w, s: FaceStatistics(s),
    "FaceStatistics.fit": lambda w, s: FaceStatistics.fit(w.people[:4, :2], s),
    "KernelIlluminationEstimator.fit": lambda w, s: KernelIlluminationEstimator.fit(w.people[:4, :2], s),
}


@pytest.mark.parametrize("bad", ["zero", "NaN", "infinity", "pairs of angles", "a number", "text"])
@pytest.mark.parametrize("name", LIGHTS)
def test_bad_lights_are_refused_by_name(world: World, name: str, bad: str) -> None:
    documented = {("source", "zero"), ("source", "NaN"), ("groups", "zero")}  # out of the evidence; unknown
    if (name, bad) in documented:
        pytest.skip("documented")
    wrong = {
        "zero": torch.zeros(2, 3),
        "NaN": torch.full((2, 3), torch.nan),
        "infinity": torch.full((2, 3), torch.inf),
        "pairs of angles": torch.tensor([[30.0, 10.0], [0.0, 5.0]]),
        "a number": torch.tensor(3.0),
        "text": "above",
    }[bad]
    with pytest.raises(ValueError, match="expected"):
        LIGHTS[name](world, wrong)


def test_lights_of_any_length_are_directions(world: World) -> None:
    """Where a light is asked for, its length does not matter; where kernel weights are, it must be one."""
    long, unit = list(world.lights[:3] * 7), list(world.lights[:3])
    one, other = world.views.fields(unit), world.views.fields(long)
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(one, other, strict=True))
    with pytest.raises(ValueError, match="unit vectors"):
        world.statistics.weights(world.lights * 7)
    with pytest.raises(ValueError, match="unit vectors"):
        check_unit(torch.full((2, 3), torch.nan), "lights")


def test_nobody_no_image_and_no_light_are_answered_with_nothing(world: World) -> None:
    relighter, lights, none = world.relighter, world.lights, torch.zeros(0, 1, *SIZE)
    for known in (lights[:1], None):
        out = relighter(none, lights[:4], known, draws=2)
        assert out.mean.shape == out.variance.shape == (0, 4, *SIZE)
    posterior = relighter.condition(none, lights[:1])
    assert posterior.mean(lights[:4]).shape == posterior.mode(lights[:4]).shape == (0, 4, *SIZE)
    refused(posterior.code, "code")
    for method, count in (("expected", 1), ("map", 1), ("mle", 4)):
        sources = lights[[0, 7, 12, 20]][:count]
        no_light = relighter(world.people[:2, [0, 7, 12, 20]][:, :count], lights[:0], sources, method)
        assert no_light.mean.shape == no_light.variance.shape == (2, 0, *SIZE)
        nobody = relighter(torch.zeros(0, count, *SIZE), lights[:4], sources, method)
        assert nobody.mean.shape == (0, 4, *SIZE)
    prior = relighter(torch.zeros(1, 1, *SIZE), lights[:2], torch.zeros(1, 3))
    nothing_seen = relighter(torch.zeros(1, 0, *SIZE), lights[:2], torch.zeros(0, 3))
    assert torch.equal(prior.mean, nothing_seen.mean)
    for estimator in (world.kernel, world.likelihood):
        assert estimator(none).direction.shape == (0, 1, 3)
        assert estimator.sample(none, 5).shape == (0, 5, 1, 3)
        assert estimator(torch.zeros(2, 0, *SIZE)).direction.shape == (2, 0, 3)
    assert world.groups(none, [lights[0]], lights[1]).mean.shape == (0, *SIZE)
    views = ViewRelighter(world.views, 2)(none, [lights[0]], lights[1])
    assert views.mean.shape == views.variance.shape == (0, *SIZE)
    for classifier in world.classifiers:
        assert classifier.decision_function(torch.zeros(0, *SIZE)).shape == (0, 2)
        assert classifier.predict(torch.zeros(0, *SIZE)) == []
        refused(lambda classifier=classifier: classifier.calibrate(torch.zeros(0, *SIZE)), "calibrate")


def test_other_counts_of_images_lights_and_views_are_refused(world: World) -> None:
    images, lights = world.people[:2, :4], world.lights
    for method in ("expected", "mle"):
        for sources in (lights[:3], lights[:5], lights[:4].expand(3, 4, 3), lights[:4, :2]):
            refused(lambda m=method, s=sources: world.relighter(images, lights[:1], s, m), "source lights")
        wrong = lights[:2].expand(3, 2, 3)
        refused(lambda m=method, t=wrong: world.relighter(images, t, lights[[0, 7, 12, 20]], m), "target lights")
    refused(lambda: world.relighter.condition(images, torch.zeros(2, 0, 4, 3)), "source lights")
    for relighter in (world.groups, ViewRelighter(world.views, 2)):
        refused(lambda r=relighter: r(images, list(lights[:3]), lights[0]), "3 views")
        refused(lambda r=relighter: r(images[:, :0], [], lights[0]), "views")
    refused(lambda: ViewRelighter(world.views, 2)(images[:, :1], [[]], lights[0]), "candidates")
    for count in (0, -1, 2.5):
        refused(lambda count=count: world.kernel.sample(images, count), "count")
    for classifier in world.classifiers:
        refused(lambda classifier=classifier: classifier.score(world.people[:4, 0], [0]), "labels")


def test_a_light_is_a_view(world: World) -> None:
    """A bare light, and a list of candidate lights where it is unknown."""
    images, lights = world.people[13:14, [2]], world.lights
    relighter = ViewRelighter(world.views, 3)
    bare = relighter(images, [lights[2]], lights[9])
    assert torch.equal(bare.mean, relighter(images, lights[2:3], lights[9]).mean)
    assert torch.allclose(relighter(images, [lights[2]], lights[2]).mean[0], images[0, 0], atol=1 / 255)
    among = relighter(images, [[lights[2], lights[20]]], lights[9])
    assert torch.equal(among.mean, relighter(images, [lights[[2, 20]]], lights[9]).mean)
    assert among.weight[0, 0] > 0.5


def test_regions_are_a_partition_of_the_pixels(world: World) -> None:
    pixels = SIZE[0] * SIZE[1]
    groups = random_groups(pixels, 84)
    whole = make_regions(groups)
    for wrong in (make_regions(groups[1:]), make_regions([*groups, groups[0]]), [], make_regions([torch.arange(600)])):
        refused(lambda wrong=wrong: GroupRelighter(world.views, wrong), "expected")
    some, others = whole[0].outputs, whole[0].inputs
    refused(lambda: GroupRelighter(world.views, [Region(some, others.float())]), "region inputs")
    refused(lambda: GroupRelighter(world.views, [Region(some, others[:2])]), "regions")
    refused(lambda: GroupRelighter(world.views, whole, "ridge"), "shrinkage")  # type: ignore[arg-type]
    refused(lambda: make_regions([torch.tensor([0, 700])], torch.rand(4, 504)), "groups")
    refused(lambda: make_regions([]), "groups")
    refused(lambda: random_groups(0, 3), "groups")
    refused(lambda: correlation_table(torch.full((4, 9), torch.nan)), "samples")
    refused(lambda: check_index(torch.tensor([[-1]]), "index", "A B", 4), "index")


def test_views_are_angles_and_weights() -> None:
    for wrong in (
        {"azimuth": float("nan")},
        {"elevation": 100.0},
        {"light": (0.0, 91.0)},
        {"light": (0.0,)},
        {"expression": (("jawOpen", 1.5),)},
    ):
        refused(lambda wrong=wrong: View(**wrong), "view")
    with pytest.raises(ValueError, match="shapes that fit"):
        light_from_angles(torch.zeros(2), torch.zeros(3))


def test_a_gallery_wants_names_and_photographs() -> None:
    gallery = Gallery(EmbeddingRecognizer(MeanColour()))
    photo, face = np.zeros((112, 112, 3), np.uint8), marked_face()
    refused(lambda: gallery.enroll("ann", []), "photos")
    refused(lambda: gallery.add("", photo, face), "name")
    with pytest.raises(ValueError, match="enroll"):
        gallery.compare(photo, face)
    gallery.add("ann", photo + np.uint8(9), face)
    refused(lambda: gallery.compare(photo, face, far=0.0), "far")
    refused(lambda: gallery.compare(photo, face, top=0), "top")
    refused(lambda: gallery.compare(photo[..., 0], face), "photo")
    refused(lambda: gallery.remove("bob"), "name")
    refused(lambda: gallery.add_templates(["bob"], {"probe": torch.ones(1, 7)}), "templates")
    refused(lambda: gallery.add_templates(["bob"], {"probe": torch.ones(2, 3)}), "templates")
