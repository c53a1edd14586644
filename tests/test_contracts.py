"""One suite a role: what every light estimator, relighter, classifier and effect promises, whoever wrote it.

A toy of each role is added by the public recipe and held to the same promises.
"""

from collections.abc import Hashable, Iterator

import numpy as np
import pytest
import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.effects import EFFECTS, Effect, LampLight, Scene
from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.bootstrap.shading import EffectPlan, plan_effects, shade
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.methods import RELIGHTING_METHODS, Method
from facerelight.inference.relighter import Covariance, StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.estimator import GaussianBelief, LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition import registry
from facerelight.recognition.classifier import Classifier
from facerelight.recognition.photometric import make_normalizer
from facerelight.recognition.registry import (
    GalleryImages,
    Recipe,
    baseline_names,
    fit_classifier,
    is_pairwise,
    needs_exemplars,
    register,
    table_names,
)


class BrightSide(LightEstimator):
    """A toy: the light comes from the brighter half of the image."""

    def locate(self, images: torch.Tensor, mask: torch.Tensor | None = None) -> GaussianBelief:
        left, right = images.tensor_split(2, dim=-1)
        side = (right.mean((-2, -1)) - left.mean((-2, -1))) / images.mean((-2, -1)).clamp_min(1e-6)
        direction = torch.stack((side, torch.zeros_like(side), torch.ones_like(side)), -1)
        lit = images.amax((-2, -1)) > 0
        return GaussianBelief(torch.nn.functional.normalize(direction, dim=-1) * lit[..., None], 0.1 * torch.eye(3))


class MeanDistance(Classifier):
    """A toy: the nearest mean."""

    def _learn(self, rows: torch.Tensor, index: torch.Tensor) -> None:
        self.means = torch.stack([rows[index == c].mean(0) for c in range(int(index.max()) + 1)])

    def _scores(self, rows: torch.Tensor) -> torch.Tensor:
        return -torch.cdist(rows, self.means)


class Glow(Effect):
    """A toy: the upper half of the picture glows."""

    name = "glow"

    def where(self, scene: Scene) -> torch.Tensor:
        return scene.surface.pixel < scene.surface.size[0] // 2 * scene.surface.size[1]

    def emit(self, scene: Scene, pixels: torch.Tensor | slice, light: LampLight) -> torch.Tensor:
        return torch.full_like(scene.facing[pixels], 0.25)


@pytest.fixture
def toy_classifier() -> Iterator[str]:
    @register("toy", pairwise=True)
    def _make(gallery: GalleryImages, recipe: Recipe) -> Classifier:
        normalizer = make_normalizer(recipe.normalizer)
        return MeanDistance(normalizer, shift=gallery.shift).fit(gallery.photos, gallery.people)

    yield "toy"
    del registry._METHODS["toy"]


# light estimators
@pytest.fixture(scope="module")
def estimators(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> dict[str, LightEstimator]:
    return {
        "kernel": KernelIlluminationEstimator.fit(people[:12], lights),
        "likelihood": LikelihoodIlluminationEstimator(statistics, count=80),
        "amounts": SoftLightEstimator(statistics),
        "toy": BrightSide(),
    }


@pytest.mark.parametrize("name", ["kernel", "likelihood", "amounts", "toy"])
class TestLightEstimator:
    def test_it_answers_with_a_unit_vector_an_image(
        self, estimators: dict[str, LightEstimator], people: torch.Tensor, name: str
    ) -> None:
        images = people[12:15, [1, 9]]
        found = estimators[name](images).direction
        assert found.shape == (3, 2, 3)
        assert found.dtype == images.dtype
        assert torch.allclose(found.norm(dim=-1), torch.ones(3, 2), atol=1e-5)
        masked = estimators[name](images, torch.ones(3, *images.shape[2:])).direction
        assert torch.allclose(masked, found, atol=1e-5)

    def test_samples_lie_on_the_sphere_about_it_and_repeat(
        self, estimators: dict[str, LightEstimator], people: torch.Tensor, name: str
    ) -> None:
        estimator, images = estimators[name], people[12:14, [1, 9]]
        drawn = estimator.sample(images, 7)
        assert drawn.shape == (2, 7, 2, 3)
        assert torch.allclose(drawn.norm(dim=-1), torch.ones(2, 7, 2), atol=1e-5)
        assert torch.equal(drawn, estimator.sample(images, 7))
        seeded = [
            estimator.sample(images, 7, torch.Generator().manual_seed(seed), independent=True) for seed in (1, 1, 2)
        ]
        assert torch.equal(seeded[0], seeded[1])
        assert not torch.equal(seeded[0], seeded[2])

    def test_a_black_image_has_no_light(self, estimators: dict[str, LightEstimator], name: str) -> None:
        black = torch.zeros(1, 1, 24, 21)
        assert not estimators[name](black).direction.any()
        assert not estimators[name].sample(black, 4).any()

    def test_bad_input_is_named(self, estimators: dict[str, LightEstimator], name: str) -> None:
        for ask in (estimators[name], lambda images: estimators[name].sample(images, 3)):
            with pytest.raises(ValueError, match=r"images: expected \(B, K, H, W\)"):
                ask(torch.zeros(24, 21))

    def test_a_relighter_takes_it(
        self,
        estimators: dict[str, LightEstimator],
        statistics: FaceStatistics,
        people: torch.Tensor,
        lights: torch.Tensor,
        name: str,
    ) -> None:
        relighter = StatisticalRelighter(statistics, "face", estimators[name])
        relit = relighter(people[12:13, :1], lights[:3], draws=4)
        assert torch.isfinite(relit.mean).all()
        assert (relit.variance >= 0).all()


def test_an_estimator_without_locate_says_so() -> None:
    with pytest.raises(NotImplementedError, match="expected a method locate"):
        LightEstimator()(torch.zeros(1, 1, 8, 8))


# relighters
@pytest.mark.parametrize("method", RELIGHTING_METHODS)
@pytest.mark.parametrize("covariance", ["pixel", "face"])
class TestRelighter:
    def test_shapes_types_and_inputs_returned(
        self,
        statistics: FaceStatistics,
        people: torch.Tensor,
        lights: torch.Tensor,
        covariance: Covariance,
        method: Method,
    ) -> None:
        sources, images = [0, 5, 20], people[12:14, [0, 5, 20]]
        relighter = StatisticalRelighter(statistics, covariance)
        for dtype in (torch.float32, torch.float64):
            relit = relighter(images.to(dtype), lights[sources], lights[sources], method)
            assert relit.mean.shape == relit.variance.shape == (2, 3, 24, 21)
            assert relit.mean.dtype == relit.variance.dtype == dtype
            assert torch.allclose(
                relit.mean, images.to(dtype), atol=2 / 255
            )  # what was seen is returned, but for noise
            assert (relit.variance >= 0).all()
            assert relit.variance.max() < 1e-4

    def test_it_leaves_its_inputs_alone(
        self,
        statistics: FaceStatistics,
        people: torch.Tensor,
        lights: torch.Tensor,
        covariance: Covariance,
        method: Method,
    ) -> None:
        images, targets, before = people[12:13, [0, 5, 20]].clone(), lights[:2].clone(), statistics.n_mean.clone()
        kept = images.clone()
        StatisticalRelighter(statistics, covariance)(images, targets, lights[[0, 5, 20]], method)
        assert torch.equal(images, kept)
        assert torch.equal(targets, lights[:2])
        assert torch.equal(statistics.n_mean, before)


# classifiers
@pytest.fixture(scope="module")
def gallery() -> tuple[GalleryImages, torch.Tensor]:
    """Six people, four exemplars each, and a probe of everybody."""
    generator = torch.Generator().manual_seed(0)
    faces = torch.rand(6, 24, 21, generator=generator)
    noisy = faces[:, None] + 0.05 * torch.randn(6, 6, 24, 21, generator=generator)
    noisy = noisy.clamp(0, 1)
    return GalleryImages(noisy[:, 0], [3, 5, 8, 9, 12, 40], noisy[:, 1:5], 1), noisy[:, 5]


NAMES = (*table_names(), "individual_pca_9+detail+cosine+weber_fine", "nearest_neighbor+tan_triggs")
OTHERS = tuple(name for name in baseline_names() if name != "sface")  # its weights are an optional package


@pytest.mark.parametrize("name", [*NAMES, *OTHERS, "toy"])
def test_every_registered_classifier(
    gallery: tuple[GalleryImages, torch.Tensor], toy_classifier: str, name: str
) -> None:
    images, probes = gallery
    classifier = fit_classifier(name, images)
    assert classifier.classes_ is not None
    assert sorted(map(str, classifier.classes_)) == sorted(map(str, images.people))
    scores = classifier.decision_function(probes)
    assert scores.shape == (6, 6)
    assert torch.isfinite(scores).all()
    assert [classifier.classes_[i] for i in scores.argmax(1).tolist()] == classifier.predict(probes) == images.people
    assert torch.equal(scores, classifier.compare(classifier.views(probes)))
    if is_pairwise(name):  # a person's score does not change with who else is enrolled
        few = images._replace(photos=images.photos[:3], people=images.people[:3], relit=images.relit[:3])
        fewer = fit_classifier(name, few)
        places = [classifier.classes_.index(person) for person in fewer.classes_ or []]
        assert torch.allclose(fewer.decision_function(probes), scores[:, places], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", [*table_names(), "gaussian_9", "toy"])
def test_a_normalisation_in_a_name_is_used(
    gallery: tuple[GalleryImages, torch.Tensor], toy_classifier: str, name: str
) -> None:
    """Who ignores it would stand in a row that says otherwise."""
    images, probes = gallery
    dimmed = probes * torch.linspace(0.1, 1, 21)  # which Weber's contrast hardly sees
    plain, normal = fit_classifier(name, images), fit_classifier(f"{name}+weber", images)
    assert plain.view_key() != normal.view_key()
    change = normal.decision_function(dimmed) - normal.decision_function(probes)
    assert change.diagonal().abs().max() < normal.decision_function(probes).std()
    assert not torch.allclose(plain.decision_function(dimmed), normal.decision_function(dimmed), rtol=1e-2)


def test_classifiers_of_one_key_share_their_probes(
    gallery: tuple[GalleryImages, torch.Tensor], toy_classifier: str
) -> None:
    images, probes = gallery
    names = [name + more for name in (*NAMES[:-2], "toy") if is_pairwise(name) for more in ("", "+weber", "+unit")]
    views: dict[Hashable, list[torch.Tensor]] = {}
    for name in names:
        classifier = fit_classifier(name, images)
        shared = views.setdefault(classifier.view_key(), list(classifier.views(probes)))
        assert torch.equal(classifier.compare(shared), classifier.decision_function(probes)), name
    assert len(views) == 3


def test_a_classifier_registers_once(toy_classifier: str) -> None:
    assert toy_classifier in table_names()
    assert is_pairwise("toy+weber")
    assert needs_exemplars("toy+weber")
    assert not needs_exemplars("nearest_neighbor+weber")
    assert needs_exemplars("nearest_neighbor+exemplars")
    with pytest.raises(ValueError, match="taken are"):
        register("toy")
    with pytest.raises(ValueError, match=r"expected one of .*toy"):
        is_pairwise("unheard_of")


# effects
@pytest.fixture(scope="module")
def heads() -> Iterator[BootstrapDataset]:
    dataset = BootstrapDataset(MakeHumanHeads(), 2, light_from_angles(40.0, 10.0)[None], CropFrame(48, 42), Domain())
    yield dataset
    dataset.close()


@pytest.fixture
def glow(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFECTS, Glow.name, Glow())


@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("azimuth", [0.0, 60.0, -110.0])
def test_every_effect_is_simulated_where_it_matters(heads: BootstrapDataset, name: str, azimuth: float) -> None:
    """Where its own test says that it can change nothing, forcing it changes nothing."""
    surface, material = heads.surface(0)
    assert heads.renderer is not None
    light = light_from_angles(azimuth, 10.0)
    where = EFFECTS[name].where(Scene(surface, light, material))
    assert where.shape == surface.pixel.shape
    assert where.dtype == torch.bool
    plan = plan_effects(surface, light, material)
    assert (name in plan.effects) == bool(where.any())
    forced = {key: plan.where.get(key) if key != name else torch.ones_like(where) for key in EFFECTS}
    forced_plan = EffectPlan({key: value for key, value in forced.items() if value is not None})
    images = [shade(surface, light, material, asked, heads.renderer) for asked in (plan, forced_plan)]
    assert torch.allclose(images[0], images[1], atol=1e-3)


def test_an_effect_is_planned_shaded_and_reported(heads: BootstrapDataset, glow: None) -> None:
    surface, material = heads.surface(0)
    assert heads.renderer is not None
    light = heads.lights[0]
    plan = plan_effects(surface, light, material)
    without = EffectPlan({key: value for key, value in plan.where.items() if key != "glow"})
    lit, plain = (shade(surface, light, material, asked, heads.renderer) for asked in (plan, without))
    inside = torch.zeros(48 * 42, dtype=torch.bool)
    inside[surface.pixel] = True
    expected = 0.25 * inside.view(48, 42).float()
    expected[24:] = 0
    assert torch.allclose(lit - plain, expected, atol=1e-6)
    work = heads[1].work
    assert work["glow passes run"] == 1
    assert (
        work["glow pixels run"] + work["glow pixels skipped"]
        == work["attached pixels run"] + (work["attached pixels skipped"])
    )
    assert plan_effects(surface, light, material, ["glow"]).effects == {"glow"}
    assert np.isfinite(heads[1].images.numpy()).all()
