"""Measures of identification against scikit-learn's curves and counts by hand; photographs for them."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.evaluation.identification.scores import (
    equal_error,
    identified_at,
    open_set,
    rank_one,
    standardised,
    wilson,
)
from facerelight.evaluation.identification.shots import (
    ENROLLED,
    PROBES,
    Shot,
    find_face,
    folder_shots,
    turn_photo,
    yale_shots,
)
from facerelight.recognition.gallery.recognizer import Levels

LEVELS = Levels(0.0, 1.0, 1.5, -5.0)


def test_rank_one_counts_faces_that_were_not_found() -> None:
    scores = torch.tensor([[0.9, 0.1], [0.2, 0.3], [-torch.inf, -torch.inf], [0.5, 0.1]])
    assert rank_one(scores, torch.tensor([0, 1, 0, 1])) == 0.5


def test_equal_error_lies_on_the_curve() -> None:
    metrics = pytest.importorskip("sklearn.metrics")
    generator = torch.Generator().manual_seed(0)
    genuine, strangers = torch.randn(400, generator=generator) + 2, torch.randn(300, generator=generator)
    truth = np.concatenate((np.ones(400), np.zeros(300)))
    let_in, found, _ = metrics.roc_curve(truth, torch.cat((genuine, strangers)), drop_intermediate=False)
    nearest = np.abs(1 - found - let_in).argmin()
    assert equal_error(genuine, strangers) == pytest.approx((1 - found[nearest] + let_in[nearest]) / 2, abs=0.004)
    assert equal_error(strangers + 10, strangers) == 0
    assert identified_at(genuine, strangers, 0.01) == pytest.approx(found[let_in <= 0.01].max(), abs=1e-9)


def test_an_open_set_by_hand() -> None:
    probes = torch.tensor([[3.0, 0.0, 9.0], [0.5, 2.0, 0.0], [2.0, 0.0, 5.0], [1.0, 0.2, 0.0]])
    owners = torch.tensor([0, 1, 2, 1])
    found = open_set(probes, owners, torch.eye(3), torch.tensor([True, True, False]), LEVELS, False, 0.01)
    order = found.genuine.sort().values
    assert torch.isinf(order[0])  # the last probe is named as somebody else
    assert len(found.genuine) == 3
    assert len(found.strangers) == 1  # who looks like themselves is not enrolled
    assert float(found.strangers[0]) == pytest.approx(float(order[1]), abs=1e-6)  # 2.0 both
    assert found.threshold > 2
    assert torch.equal(standardised(probes, torch.eye(3), LEVELS, False).argmax(1), probes.argmax(1))


def test_intervals_are_wilsons() -> None:
    n, k, z = 162, 160, 1.959964
    share = k / n
    middle, half = share + z**2 / (2 * n), z * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2))
    expected = (middle - half) / (1 + z**2 / n), (middle + half) / (1 + z**2 / n)
    assert wilson(k, n) == pytest.approx(expected, abs=1e-6)


def test_a_folder_of_people(tmp_path: Path) -> None:
    for name, count in (("ann", 3), ("bob", 2), ("eve", 1)):
        (tmp_path / name).mkdir()
        for i in range(count):
            Image.fromarray(np.full((20, 30, 3), 10 * i, np.uint8)).save(tmp_path / name / f"{i}.png")
    shots = folder_shots(tmp_path)
    assert [(shot.person, shot.enrolled) for shot in shots] == [
        (0, True),
        (0, False),
        (0, False),
        (1, True),
        (1, False),
    ]
    assert find_face(shots[0]) is None
    with pytest.raises(ValueError, match="landmarks: expected data"):
        find_face(shots[0], exact=True)
    with pytest.raises(ValueError, match="two photos or more"):
        folder_shots(tmp_path / "ann")


def test_a_turned_photograph_keeps_its_landmarks() -> None:
    photo = np.zeros((120, 100, 3), np.uint8)
    photo[39:42, 59:62] = 255
    turned = turn_photo(Shot(0, photo, False, np.array(((60.0, 40.0), (30.0, 40.0), (50.0, 90.0)))), 10.0, 1.3)
    assert turned.photo.shape == (156, 130, 3)
    assert turned.landmarks is not None
    y, x = np.nonzero(turned.photo[..., 0] > 100)
    assert np.hypot(*(turned.landmarks[0] - (x.mean(), y.mean()))) < 0.5
    moved = turned.landmarks[1] - turned.landmarks[0]
    assert np.hypot(*moved) == pytest.approx(39)
    assert abs(np.rad2deg(np.arctan2(moved[1], moved[0])) - 170) < 1e-6


def test_yale_shots(yale_path: Path) -> None:
    shots = yale_shots(yale_path)
    enrolled, probes = ([shot for shot in shots if shot.enrolled is which] for which in (True, False))
    assert (len(enrolled), len(probes)) == (28, 162)
    assert len(ENROLLED) == 5
    assert len(PROBES) == 6
    assert shots[0].photo.shape == (312, 288, 3)
    face = find_face(enrolled[0])
    assert face is not None
    assert np.abs(face.landmarks - enrolled[0].landmarks).max() < 12
