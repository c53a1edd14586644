"""Films with several people, and films one after the other: what is known of one does not go over to the next."""

import numpy as np
import pytest
import torch

from facerelight import Lamp
from facerelight.photo import load_relighter
from facerelight.photo.faces.landmarks import find_faces
from facerelight.photo.film import relighter as film_relighter
from facerelight.photo.film.evidence import Evidence, angle_between
from facerelight.photo.film.relighter import FilmRelighter, Lighting
from facerelight.photo.film.track import Picture, Tracked

SIDE = 256


@pytest.fixture(scope="module")
def people() -> list[Tracked]:
    """Two faces that differ, found one after the other in one shot."""
    photo = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    one = np.ascontiguousarray(photo[:SIDE, 96 : 96 + SIDE])
    two = np.ascontiguousarray(one[:, ::-1] // (1, 2, 2)).astype(np.uint8)
    faces = [(pixels, find_faces(pixels)[0]) for pixels in (one, two)]
    return [Tracked(Picture(pixels, k / 25), face, 1.0, 0, k + 1) for k, (pixels, face) in enumerate(faces)]


@pytest.fixture
def film(monkeypatch: pytest.MonkeyPatch) -> FilmRelighter:
    monkeypatch.setattr(film_relighter, "follow", lambda tracked, _: iter(tracked))
    return FilmRelighter(Lighting([Lamp(60, 20)]), load_relighter())


def relit(film: FilmRelighter, tracked: list[Tracked]) -> list[np.ndarray]:
    return [picture.pixels for picture in film.frames(tracked)]


def test_two_people_in_one_shot_are_two(film: FilmRelighter, people: list[Tracked]) -> None:
    together = relit(film, people)
    alone = [relit(film, [one])[0] for one in people]
    assert not np.array_equal(together[1], people[1].picture.pixels)
    assert all(np.array_equal(*pair) for pair in zip(together, alone, strict=True))


def test_a_film_knows_nothing_of_the_film_before_it(film: FilmRelighter, people: list[Tracked]) -> None:
    one, two = (person._replace(run=1) for person in people)
    alone = relit(film, [two])[0]
    facts = film.seen, film.lit, film.keys, film.shots, film.source_angles, film.warnings
    relit(film, [one])
    assert np.array_equal(relit(film, [two])[0], alone)
    assert facts == (film.seen, film.lit, film.keys, film.shots, film.source_angles, film.warnings)
    assert facts[:4] == (1, 1, 1, 1)


def test_a_view_turns_with_the_frames_it_is_the_mean_of() -> None:
    relighter = load_relighter()
    crop = torch.full((3, *relighter.statistics.size), 0.3)
    evidence = Evidence(relighter)
    turns = np.deg2rad((0.0, 3.0, 6.0))

    def turned(angle: float) -> np.ndarray:
        return np.array(((np.cos(angle), 0, np.sin(angle)), (0, 1, 0), (-np.sin(angle), 0, np.cos(angle))))

    for angle in turns:
        evidence.add(crop, turned(angle))
    (view,) = evidence.views
    assert angle_between(view.rotation, turned(turns.mean())) < 0.01
    assert view.rotation @ view.rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(view.rotation) == pytest.approx(1)
