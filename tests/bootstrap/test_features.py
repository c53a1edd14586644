"""Brows, lips, rings and stubble, beside the landmarks of the average scanned head, which paint does not know."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.heads import IctHeads
from facerelight.bootstrap.look import Look, paint
from facerelight.bootstrap.look.features import brow_arc, brows, lips, rings, stubble


@pytest.fixture(scope="module")
def marks() -> np.ndarray:
    """iBUG's 68 on the average head."""
    source = IctHeads()
    return source._reference[source._data.marks]


def grid(z: float = 0.3) -> torch.Tensor:
    """Points of a face's front, ``(P, 3)``, a fiftieth of the eyes' distance apart."""
    x, y = torch.meshgrid(torch.arange(-1, 1, 0.02), torch.arange(-1.6, 1, 0.02), indexing="xy")
    return torch.stack((x, y, torch.full_like(x, z)), -1).reshape(-1, 3)


def test_lips_lie_where_the_landmarks_do(marks: np.ndarray) -> None:
    points = grid()
    red = lips(points)[0].numpy() > 0.25
    outline = np.ascontiguousarray(marks[48:60, None, :2], np.float32)
    inside = np.array([cv2.pointPolygonTest(outline, tuple(place), False) > 0 for place in points[:, :2].tolist()])
    assert (red & inside).sum() / (red | inside).sum() > 0.75
    upper, lower = (torch.tensor([[0.1, y, 0.3]]) for y in (-0.97, -1.12))
    assert lips(upper)[0] > 1.7 * lips(lower)[0]


def test_lips_meet_on_a_line(marks: np.ndarray) -> None:
    meeting = torch.tensor(marks[60:68], dtype=torch.float32)
    assert (lips(meeting)[1] > 0.6).all()
    assert (lips(meeting + torch.tensor((0.0, 0.06, 0.0)))[1] < 0.1).all()


def test_brows_bend_as_the_landmarks_do(marks: np.ndarray) -> None:
    """In shape; the scans' brows are raised by a tenth of the eyes' distance."""
    right = marks[22:27]
    arc = brow_arc(torch.tensor(right[:, 0]), 0.30).numpy()
    apart = right[:, 1] - arc
    assert np.ptp(apart) < 0.12
    assert 0.02 < apart.mean() < 0.15
    cover = brows(torch.tensor([[0.45, 0.30, 0.2], [-0.45, 0.30, 0.2], [0.0, 0.30, 0.2], [0.45, 0.1, 0.1]]), 0.3, 0.06)
    assert cover[:2].min() > 0.5
    assert cover[2:].max() < 0.05


def test_dark_skin_is_around_eyes_and_nowhere_else(marks: np.ndarray) -> None:
    around, under = rings(torch.tensor(marks, dtype=torch.float32))
    assert around[36:48].min() > 0.5
    elsewhere = torch.cat((around[:17], around[30:36], around[48:]))
    assert elsewhere.max() < 0.02
    assert under[[40, 41, 46, 47]].min() > 0.4
    assert under[48:].max() < 0.01


def test_a_shaven_beard_spares_lips_nose_and_brow(marks: np.ndarray) -> None:
    points = torch.tensor(marks, dtype=torch.float32)
    cover = stubble(points, lips(points)[0])
    assert cover[5:12].min() > 0.5  # the jaw
    assert cover[17:31].max() < 0.03
    assert cover[61:64].max() < 0.6


def test_each_feature_darkens_its_own_place() -> None:
    points = torch.tensor(
        [[0.45, 0.30, 0.2], [0.1, -0.97, 0.3], [0.0, -1.045, 0.3], [0.48, -0.14, 0.0], [0.0, -1.45, 0.1]]
    )
    look = Look.random(np.random.default_rng(0), Domain(texture=0.0))
    plain = dict.fromkeys(("brows", "lips", "line", "sockets", "under", "stubble"), 0.0)
    zeros = torch.zeros(len(points))

    def painted(**change: float) -> torch.Tensor:
        return paint(points, zeros, replace(look, brow_height=0.3, **(plain | change)))

    bare = painted()
    for place, name in enumerate(("brows", "lips", "line", "under", "stubble")):
        left = painted(**{name: 0.5}) / bare
        assert left.argmin() == place, name
        assert left[place] < 0.85, name
        others = torch.arange(len(points)) != place
        assert (left[others] > left[place] + 0.1).all(), name
