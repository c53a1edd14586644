"""Galleries: who is kept, who is found, what a score means, and where strangers begin."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import MeanColour, marked_face
from scipy.stats import t as student

from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.blur import gaussian_blur
from facerelight.recognition.gallery import individual
from facerelight.recognition.gallery.calibration import calibrate, stranger_scores
from facerelight.recognition.gallery.embeddings import CompressedIndex, EmbeddingRecognizer, ExactIndex
from facerelight.recognition.gallery.gallery import Gallery
from facerelight.recognition.gallery.individual import IndividualRecognizer
from facerelight.recognition.gallery.recognizer import Levels

LEVELS = Levels(0.2, 0.1, 1.5, -5.0)
COLOURS = {"red": (200, 40, 40), "green": (40, 200, 40), "blue": (40, 40, 200)}


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.tile(np.array(colour, np.uint8), (80, 80, 1))


@pytest.fixture
def gallery() -> Gallery:
    made = Gallery(EmbeddingRecognizer(MeanColour(), Levels(0.4, 0.2, 1.5, -5.0), "colour"))
    for name, colour in COLOURS.items():
        made.add(name, plain(colour), marked_face())
    return made


def test_faces_are_named_by_their_nearest_template(gallery: Gallery) -> None:
    for name, (r, g, b) in COLOURS.items():
        found = gallery.compare(plain((r - 10, g + 5, b)), marked_face(), far=0.2, top=3)
        assert found.name == found.matches[0].name == name
        assert sorted(match.name for match in found.matches) == sorted(COLOURS)
        assert [m.probability for m in found.matches] == sorted((m.probability for m in found.matches), reverse=True)
    grey = gallery.compare(plain((90, 90, 90)), marked_face())
    assert grey.name is None


def test_a_score_is_the_best_of_several_photographs(gallery: Gallery) -> None:
    gallery.add("red", plain((90, 90, 90)), marked_face())
    assert gallery.people == {"blue": 1, "green": 1, "red": 2}
    assert gallery.compare(plain((91, 90, 90)), marked_face(), far=0.5, top=2).matches[0].name == "red"
    gallery.remove("red")
    assert gallery.people == {"blue": 1, "green": 1}
    assert gallery.compare(plain((200, 40, 40)), marked_face(), top=3).matches[0].name != "red"


def test_a_gallery_keeps_its_model_and_refuses_others(gallery: Gallery, tmp_path: Path) -> None:
    path = tmp_path / "g.safetensors"
    gallery.save(path)
    again = Gallery.load(path, gallery.recognizer)
    assert again.people == gallery.people
    photo = plain((190, 45, 45))
    assert again.compare(photo, marked_face()).matches == gallery.compare(photo, marked_face()).matches

    class Other(MeanColour):
        name = "mean-colour-2"

    class Wider(MeanColour):
        crop = MeanColour.crop._replace(side=9)

    for other in (Other(), Wider()):
        with pytest.raises(ValueError, match=r"expected a gallery of .* got .* enroll anew"):
            Gallery.load(path, EmbeddingRecognizer(other))
    empty = Gallery(gallery.recognizer)
    empty.save(path)
    assert Gallery.load(path, gallery.recognizer).people == {}


def test_the_threshold_is_students_for_the_best_of_many() -> None:
    """With everybody alike it is the quantile of Student's distribution that all of N strangers' scores stay under."""
    people = torch.arange(20)
    scores = 0.3 + 0.05 * torch.randn(20, 20, generator=torch.Generator().manual_seed(0))
    learned = calibrate(scores, people, people, LEVELS, False)
    apart = scores[~torch.eye(20, dtype=torch.bool)]
    assert float(learned.mean[0]) == pytest.approx(0.8 * float(apart.mean()) + 0.2 * 0.2, abs=1e-6)
    assert learned.threshold(0.01, 20) == pytest.approx(student.isf(1 - 0.99 ** (1 / 20), 24))
    assert learned.threshold(0.01, 20) > learned.threshold(0.1, 20)
    assert learned.threshold(0.01, 2000) > learned.threshold(0.01, 20)
    with pytest.raises(ValueError, match="far: expected a false accept rate"):
        learned.threshold(1.0, 20)


def test_nobody_to_compare_leaves_what_was_learned_before() -> None:
    one = calibrate(torch.ones(1, 1), torch.zeros(1), torch.zeros(1), LEVELS, True)
    assert (float(one.mean[0]), one.std) == pytest.approx((0.2, 0.1))
    assert one.probability(-LEVELS.intercept / LEVELS.slope) == pytest.approx(0.5)


def test_as_many_strangers_pass_as_were_asked_for() -> None:
    """Embeddings around their people's directions: of many strangers about 1 % and 10 % pass, known people do."""
    generator = torch.Generator().manual_seed(0)
    centres = torch.nn.functional.normalize(torch.randn(60, 128, generator=generator), dim=1)
    index = torch.arange(60)
    learned = calibrate(centres @ centres.T, index, index, Levels(0.0, 0.09, 1.5, -5.0), False)
    strangers = torch.nn.functional.normalize(torch.randn(20_000, 128, generator=generator), dim=1)
    best = learned.standardised(strangers @ centres.T, index).amax(1)
    for far in (0.01, 0.1):
        assert 0.2 * far < float((best >= learned.threshold(far, 60)).float().mean()) < 1.5 * far


def test_a_template_that_everybody_resembles_is_held_to_its_own_level() -> None:
    people = torch.arange(30)
    scores = 0.3 + 0.01 * torch.randn(30, 30, generator=torch.Generator().manual_seed(1))
    scores[:, 7] += 0.2
    common, own = (calibrate(scores, people, people, LEVELS, personal) for personal in (False, True))
    assert float(own.mean[7] - own.mean.median()) > 0.15
    assert float(common.mean.std()) == 0
    probe = torch.full((30,), 0.3)
    probe[7], probe[3] = 0.5, 0.4  # the template's usual score, and an unusual one
    assert int(common.standardised(probe, people).argmax()) == 7
    assert int(own.standardised(probe, people).argmax()) == 3


def gathered(people: int, photos: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Vectors of people who all have a good part in common, and whose they are."""
    centres = torch.randn(people, 128, generator=generator) + torch.linspace(-1.5, 1.5, 128)
    owners = torch.arange(people).repeat_interleave(photos)
    noise = torch.randn(len(owners), 128, generator=generator)
    return torch.nn.functional.normalize(centres[owners] + noise, dim=1), owners


def test_the_thesiss_scores_less_what_a_probe_shares_with_others(statistics: FaceStatistics) -> None:
    """Darkening or noise that lowers every score leaves the margin; another photograph of the likeliest is no other."""
    recognizer = IndividualRecognizer(StatisticalRelighter(statistics))
    generator = torch.Generator().manual_seed(0)
    probe = gaussian_blur(torch.rand(1, 240, 210, generator=generator), 3.0)[0]
    same = individual._modules(recognizer._features(individual._views(probe)[:1]))
    noise = torch.randn(5, *same[:, 0].shape, generator=generator) * same.std()
    mean = torch.cat((same.transpose(0, 1), same.transpose(0, 1) + 0.2 * noise[:1], noise[1:]))
    basis = torch.zeros(*mean.shape, 1)
    found, rows = recognizer.index({"mean": mean, "basis": basis}, torch.tensor([0, 0, 1, 2, 3, 4])).search(probe, 6)
    apart, _ = recognizer.index({"mean": mean, "basis": basis}, torch.arange(6)).search(probe, 6)
    assert rows[:2].tolist() == [0, 1]
    raw = apart - apart[0] + 1  # the first is the probe itself
    expected = raw - (raw[2:].sum() + 5 * individual.STRANGERS) / 9
    assert torch.allclose(found, expected, atol=1e-4)


def test_people_score_as_strangers_without_themselves() -> None:
    recognizer = EmbeddingRecognizer(MeanColour())
    vectors, owners = gathered(4, 2, torch.Generator().manual_seed(0))
    scores = stranger_scores(recognizer, {"probe": vectors}, owners)
    assert (scores[owners[:, None] == owners] == 0).all()
    found, rows = ExactIndex(vectors[2:]).search(vectors[1], 6)
    assert torch.allclose(scores[1, 2:][rows], found)
    alone = stranger_scores(recognizer, {"probe": vectors[:2]}, owners[:2])
    assert torch.equal(alone, torch.zeros(2, 2))


def test_the_compressed_index_finds_what_an_exact_search_finds() -> None:
    pytest.importorskip("faiss", reason="needs the extra 'faiss'")
    generator = torch.Generator().manual_seed(0)
    vectors = torch.nn.functional.normalize(torch.randn(20_000, 128, generator=generator), dim=1)
    probes = torch.nn.functional.normalize(vectors[::200] + 0.08 * torch.randn(100, 128, generator=generator), dim=1)
    exact, compressed = ExactIndex(vectors), CompressedIndex(vectors)
    for probe in probes:
        (ours, rows), (theirs, expected) = compressed.search(probe, 3), exact.search(probe, 3)
        assert int(rows[0]) == int(expected[0])
        assert float(ours[0]) == pytest.approx(float(theirs[0]))
    recognizer, owners = EmbeddingRecognizer(MeanColour()), torch.arange(20_000)
    for count, kind in ((20_000, CompressedIndex), (10_000, ExactIndex)):
        index = recognizer.index({"probe": vectors[:count]}, owners[:count])
        assert isinstance(index, kind)
    with pytest.raises(ValueError, match="vectors: expected"):
        CompressedIndex(vectors[:9])
