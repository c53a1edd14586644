"""Which face is followed where there are several: faces of a script instead of faces that are found."""

from argparse import Namespace
from collections.abc import Callable

import numpy as np
import pytest

from facerelight.photo.faces import given
from facerelight.photo.faces.head_pose import canonical_face
from facerelight.photo.faces.landmarks import Face, face_of_points
from facerelight.photo.film import track
from facerelight.photo.film.command import _chooser
from facerelight.photo.film.track import Choose, Picture, follow

SHAPE, UNIT = (240, 640, 3), 20  # pixels
Script = dict[int, list[float]]  # from a frame on, where faces are, in eye distances; the largest one first


def face_at(x: float) -> Face:
    points = canonical_face().points.copy()
    one = face_of_points(points, SHAPE, 1.0, 1.0)
    points *= UNIT / np.hypot(*(one.landmarks[1] - one.landmarks[0]))
    points[:, :2] += (40 + UNIT * x, 120) - points[:, :2].mean(0)
    return face_of_points(points, SHAPE, 1.0, 1.0)


def place(face: Face | None) -> float | None:
    return None if face is None or face.points is None else round(float(face.points[:, 0].mean() - 40) / UNIT, 2)


@pytest.fixture
def followed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[float | None]]:
    """Where the face is in every frame; what is followed is lost in the ``lost`` ones."""

    def run(script: Script, lost: set[int], frames: int, choose: Choose) -> list[float | None]:
        def found(pixels: np.ndarray) -> list[Face]:
            return [face_at(x) for x in script[max(k for k in script if k <= pixels[0, 0, 0])]]

        def same(pixels: np.ndarray, before: Face) -> Face | None:
            return None if pixels[0, 0, 0] in lost else before

        monkeypatch.setattr(track, "find_faces", found)
        monkeypatch.setattr(track, "follow_face", same)
        pixels = np.zeros((frames, *SHAPE), np.uint8)
        pixels[:, 0, 0, 0] = np.arange(frames)
        return [place(one.face) for one in follow([Picture(one, k / 25) for k, one in enumerate(pixels)], choose)]

    return run


def first_only(pixels: np.ndarray, before: Face | None) -> Face | None:
    return face_at(0.0) if pixels[0, 0, 0] == 0 else None


def test_the_nearest_face_is_the_one_that_was_followed(followed) -> None:
    places = followed({0: [0.0], 6: [0.9, 0.0]}, {6}, 12, track.largest_face)
    assert places == [0.0] * 12


def test_a_face_far_off_is_never_taken_for_the_one_that_left(followed) -> None:
    script = {0: [0.0], 6: [], 60: [12.0]}
    assert followed(script, set(range(6, 90)), 90, first_only)[6:] == [None] * 84
    back = followed({**script, 60: [3.0]}, set(range(6, 60)), 90, first_only)
    assert back[6:60] == [None] * 54
    assert back[70:] == [3.0] * 20


def test_the_face_that_is_meant_is_asked_for_anew_when_one_has_left(followed) -> None:
    places = followed({0: [0.0], 6: [], 40: [12.0, 1.0]}, set(range(6, 40)), 60, track.largest_face)
    assert places[50:] == [12.0] * 10


def test_the_face_at_the_landmarks_is_kept(followed, monkeypatch: pytest.MonkeyPatch) -> None:
    marked = face_at(0.0)
    monkeypatch.setattr(given, "locate_face", lambda *_: (marked, 1))
    choose = _chooser(Namespace(landmarks=marked.landmarks.tolist(), face="largest"))  # type: ignore[arg-type]
    script = {0: [12.0, 0.0], 6: [12.0], 40: [12.0, 1.0]}
    places = followed(script, set(range(6, 40)), 60, choose)
    assert places[:6] == [0.0] * 6
    assert places[6:40] == [None] * 34
    assert places[50:] == [1.0] * 10
