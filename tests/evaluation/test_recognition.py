import pytest
import torch

from facerelight.evaluation.datasets import FaceImages
from facerelight.evaluation.recognition import Enrolment, evaluate_galleries, training_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition import registry
from facerelight.recognition.classifier import SumClassifier
from facerelight.recognition.exemplars import exemplar_lights, synthesize
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.photometric import Inside, TanTriggs, WeberFaces
from facerelight.recognition.registry import GalleryImages, fit_classifier, is_pairwise

NAMES = [
    "nearest_neighbor",
    "individual_pca_9+weber",
    "individual_pca_9+detail+cosine",
    "individual_pca_9+photo+unit",
    "global_pca",
    "gaussian_9",
]


@pytest.fixture(scope="module")
def faces(people: torch.Tensor, lights: torch.Tensor) -> FaceImages:
    """Twelve people, whose numbers sort differently as text, with a few images missing."""
    count, several = 12, 8
    images = people[:count, ::4][:, :several].clamp(0, 1)
    grid = torch.stack(torch.meshgrid(torch.arange(count), torch.arange(several), indexing="ij")).flatten(1)
    there = grid[0] + grid[1] != 5
    subject, light = grid[0][there], grid[1][there]
    angles = torch.zeros(several, 2)
    return FaceImages(
        images.flatten(0, 1)[there],
        subject,
        light,
        lights[::4][:several],
        angles,
        torch.ones_like(subject),
        [str(i) for i in range(count)],
    )


@pytest.mark.parametrize("case", ["same", "random"])
def test_enrolling_once_equals_fitting_every_gallery(faces: FaceImages, statistics: FaceStatistics, case: str) -> None:
    """The same right answers, probe by probe, as classifiers fitted to each gallery by themselves."""
    relighter = StatisticalRelighter(statistics, "face")
    galleries = list(training_lights(faces, list(range(12)), case, 4))
    how = Enrolment(shift=1)
    tallies = evaluate_galleries(faces, galleries, relighter, NAMES, how)
    for index, gallery in enumerate(galleries):
        photos = torch.stack(
            [faces.images[(faces.subject == person) & (faces.light == light)][0] for person, light in gallery.items()]
        )
        given = torch.stack([faces.lights[light][None] for light in gallery.values()])
        relit = synthesize(relighter.condition(photos[:, None], given), exemplar_lights()[0])
        for name in NAMES:
            tally = tallies[name][index]
            classifier = fit_classifier(name, GalleryImages(photos, list(gallery), relit, how.shift))
            probes = [
                i
                for i in range(len(faces.images))
                if int(faces.subject[i]) in gallery and gallery[int(faces.subject[i])] != int(faces.light[i])
            ]
            right = [
                found == int(faces.subject[i])
                for i, found in zip(probes, classifier.predict(faces.images[probes]), strict=True)
            ]
            assert tally.right.tolist() == right, name
            assert tally.seconds > 0


def test_names_are_checked() -> None:
    assert is_pairwise("individual_pca_9+detail+cosine+weber_fine")
    assert not is_pairwise("global_pca+weber")
    for name in ("svm", "nearest_neighbor+sepia", "nearest_neighbor+weber+unit"):
        with pytest.raises(ValueError, match="classifier: expected one of"):
            is_pairwise(name)


@pytest.fixture
def stubborn(monkeypatch: pytest.MonkeyPatch) -> str:
    """A classifier that has a normalisation of its own, whatever its name asks for."""
    monkeypatch.setattr("facerelight.recognition.registry._METHODS", dict(registry._METHODS))

    @registry.register("stubborn", pairwise=True, relit=False)
    def _stubborn(gallery: GalleryImages, recipe: registry.Recipe) -> NearestNeighborClassifier:
        nearest = NearestNeighborClassifier("cosine", normalizer=TanTriggs(), shift=gallery.shift)
        return nearest.fit(gallery.photos, gallery.people)

    return "stubborn+weber"


def test_a_classifier_that_ignores_its_normaliser_changes_nobody_elses_row(
    faces: FaceImages, statistics: FaceStatistics, stubborn: str
) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    galleries = list(training_lights(faces, list(range(12)), "random", 3))
    alone = evaluate_galleries(faces, galleries, relighter, ["nearest_neighbor+weber"])
    beside = evaluate_galleries(faces, galleries, relighter, [stubborn, "nearest_neighbor+weber"])
    own = evaluate_galleries(faces, galleries, relighter, [stubborn])
    for name, expected in (("nearest_neighbor+weber", alone), (stubborn, own)):
        assert [t.right.tolist() for t in beside[name]] == [t.right.tolist() for t in expected[name]]


def test_views_are_shared_by_what_they_depend_on() -> None:
    images = torch.rand(4, 24, 21)
    weber, finer, again = (
        NearestNeighborClassifier("cosine", normalizer=WeberFaces(sigma)).fit(images, [0, 1, 2, 3])
        for sigma in (1.0, 0.5, 1.0)
    )
    assert weber.view_key() == again.view_key()
    assert weber.view_key() != finer.view_key()
    masks = [Inside(WeberFaces(), mask) for mask in (torch.ones(24, 21), torch.zeros(24, 21))]
    keys = {NearestNeighborClassifier(normalizer=mask).view_key() for mask in masks}
    assert len(keys) == 2
    assert SumClassifier([weber, finer]).view_key() == weber.view_key()


def test_photographs_alone_are_not_relit(faces: FaceImages, statistics: FaceStatistics) -> None:
    class Never:
        def condition(self, *_: object, **__: object) -> None:
            raise AssertionError("relit for nobody")

    gallery = next(iter(training_lights(faces, list(range(12)), "random", 1)))
    for names in (["nearest_neighbor"], ["eigenfaces"]):
        evaluate_galleries(faces, [gallery], Never(), names)  # type: ignore[arg-type]
