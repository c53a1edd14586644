import pytest
import torch

from facerelight.evaluation.datasets import FaceImages
from facerelight.evaluation.recognition import Enrolment, evaluate_galleries, training_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.exemplars import exemplar_lights, synthesize
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
