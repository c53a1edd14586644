"""Faces at ease: what moves, which way, and what stays."""

import numpy as np
import pytest
import trimesh

from facerelight.bootstrap.heads import Head, IctHeads, MakeHumanHeads
from facerelight.bootstrap.heads.rest import Ease, at_rest, close_lips, move_lids, move_mouth

BOTH, NONE = np.ones(2), np.zeros(2)


@pytest.fixture(scope="module")
def source() -> IctHeads:
    return IctHeads()


@pytest.fixture(scope="module")
def marks(source: IctHeads) -> np.ndarray:
    return source._data.marks


def opening(head: Head, marks: np.ndarray) -> np.ndarray:
    """Between the lids, image-left and image-right."""
    y = head.vertices[marks, 1]
    return np.array([y[first + 1 : first + 3].mean() - y[first + 4 : first + 6].mean() for first in (36, 42)])


@pytest.mark.parametrize("index", [0, 2, 5])
def test_lids_come_down_with_their_share(source: IctHeads, marks: np.ndarray, index: int) -> None:
    """Monotonically, each eye by its own, and at the middle of the lid by just that share of the opening."""
    head = source.awake(index)
    shares = np.linspace(0, 0.45, 6)
    openings = np.array([opening(move_lids(head, marks, share * BOTH, NONE), marks) for share in shares])
    assert (np.diff(openings, axis=0) < -0.003).all()
    assert openings[0] == pytest.approx(opening(head, marks))
    assert openings[-1] / openings[0] == pytest.approx(1 - 0.45, abs=0.13)
    left = opening(move_lids(head, marks, np.array((0.3, 0.0)), NONE), marks)
    assert left[0] < 0.85 * openings[0, 0]
    assert left[1] == pytest.approx(openings[0, 1], abs=1e-9)
    raised = opening(move_lids(head, marks, NONE, 0.2 * BOTH), marks)
    assert (raised < openings[0] - 0.01).all()


def above(ball: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """How far points lie outside an eyeball, along rays from its middle."""
    middle = ball.vertices.mean(0)
    outward = (points - middle) / np.linalg.norm(points - middle, axis=1, keepdims=True)
    hits, rays, _ = ball.ray.intersects_location(np.tile(middle, (len(points), 1)), outward, multiple_hits=False)
    reach = np.full(len(points), np.nan)
    reach[rays] = np.linalg.norm(hits - middle, axis=1)
    return np.linalg.norm(points - middle, axis=1) - reach


@pytest.mark.parametrize("index", [1, 3, 4])
def test_no_skin_enters_an_eyeball(source: IctHeads, marks: np.ndarray, index: int) -> None:
    """Ray casting against the eyeball itself: skin that slides over it stays outside; lining of the socket that
    is inside in the scan goes no deeper."""
    pytest.importorskip("embreex", reason="ray casting needs embreex")
    head = source.awake(index)
    moved = move_lids(head, marks, 0.4 * BOTH, 0.1 * BOTH)
    slid = np.linalg.norm(moved.vertices - head.vertices, axis=1) > 0.006
    assert slid.sum() > 300
    for side in (-1, 1):
        on_ball, skin = ((mask & (side * head.reference[:, 0] > 0)) for mask in (head.is_eye > 0.5, slid))
        faces = head.triangles[on_ball[head.triangles].all(1)].astype(int)
        ball = trimesh.Trimesh(head.vertices, faces).submesh([np.arange(len(faces))], append=True)
        before, after = above(ball, head.vertices[skin]), above(ball, moved.vertices[skin])
        assert np.isfinite(after).mean() > 0.95
        outside = before > 0
        assert np.nanmin(after[outside]) > 0
        assert np.nanmin((after - before)[~outside & np.isfinite(after - before)], initial=1) > 0
        assert outside.mean() > 0.5


def test_only_lids_and_mouth_move(source: IctHeads, marks: np.ndarray) -> None:
    """Brows, nose, ears and the eyeballs are who a person is, and stay; far from both not one vertex moves."""
    head = source.awake(0)
    calm = at_rest(head, marks, np.random.default_rng(4))
    x, y, z = head.reference.astype(float).T
    moved = np.linalg.norm(calm.vertices - head.vertices, axis=1)
    near_eyes = (np.abs(y) < 0.28) & (np.abs(x) > 0.29) & (np.abs(x) < 0.71) & (z > -0.3)
    assert moved[~near_eyes & ((y > 0.3) | (z < -0.7))].max() == 0
    lids = move_lids(head, marks, 0.3 * BOTH, 0.1 * BOTH)
    shut = np.linalg.norm(lids.vertices - head.vertices, axis=1)
    assert shut[~near_eyes | (head.is_eye > 0.5)].max() == 0
    assert 0.02 < shut.max() < 0.12
    assert np.array_equal(calm.landmarks[:2], head.landmarks[:2])
    blind = head._replace(is_eye=np.zeros_like(head.is_eye))
    for still in (move_lids(head, marks, NONE, NONE), move_lids(blind, marks, 0.3 * BOTH, NONE)):
        assert np.array_equal(still.vertices, head.vertices)


def test_lips_meet_and_stay_together(source: IctHeads, marks: np.ndarray) -> None:
    """Whoever's were apart, smiling or not; the mouth's landmark goes with a smile."""
    parted = [source.awake(index) for index in (5, 7)]
    for head in parted:
        upper, lower = marks[[61, 62, 63]], marks[[67, 66, 65]]
        before = (head.vertices[upper] - head.vertices[lower])[:, 1]
        closed = close_lips(head, marks)
        smiling = move_mouth(closed, marks, 0.05, 0.05, 0.03)
        assert before.max() > 0.015
        for face in (closed, smiling):
            assert (face.vertices[upper] - face.vertices[lower])[:, 1].max() < max(0.3 * before.max(), 0.008)
        corners = smiling.vertices[marks[[48, 54]]] - closed.vertices[marks[[48, 54]]]
        assert corners[:, 1] == pytest.approx([0.05, 0.05], abs=0.01)
        assert corners[:, 0] == pytest.approx([-0.05, 0.05], abs=0.01)
        assert 0.01 < smiling.landmarks[2, 1] - closed.landmarks[2, 1] < 0.05


def test_the_same_person_rests_the_same_way(source: IctHeads) -> None:
    first, again, other = IctHeads().head(3), IctHeads().head(3), IctHeads().head(4)
    assert np.array_equal(first.vertices, again.vertices)
    assert not np.array_equal(first.vertices, other.vertices)
    far = source.awake(3).reference[:, 1] > 0.3
    assert np.array_equal(first.vertices[far], source.awake(3).vertices[far])


def test_people_differ_in_how_they_rest() -> None:
    eases = [Ease.random(np.random.default_rng((1, k))) for k in range(400)]
    upper = np.stack([ease.upper for ease in eases])
    assert 0.05 < upper.std() < 0.15
    assert np.abs(np.diff(upper, axis=1)).mean() < 0.05  # both alike
    assert 0 <= upper.min() <= upper.max() <= 0.4
    assert np.mean([ease.out > 0 for ease in eases]) == pytest.approx(1 / 3, abs=0.08)


def test_makehumans_people_rest_and_obey() -> None:
    """Lids by which nobody stares, whoever it is; what is asked for comes on top, and no shape overshoots."""
    source = MakeHumanHeads(2)
    eye = "expression/eyeBlinkLeft"
    blinks = np.array([source._weights(index)[eye] for index in range(12)])
    assert 0.05 <= blinks.min() < blinks.max() <= 0.35
    assert np.ptp(blinks) > 0.1
    asked = MakeHumanHeads(2, expression={"eyeBlinkLeft": 0.5})
    assert [asked._weights(index)[eye] - blinks[index] for index in range(12)] == pytest.approx([0.5] * 12, abs=1e-3)
    shut = MakeHumanHeads(2, expression={"eyeBlinkLeft": 1.0})
    assert [shut._weights(index)[eye] for index in range(3)] == pytest.approx([1.0] * 3, abs=1e-3)
