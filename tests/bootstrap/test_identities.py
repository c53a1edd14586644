"""Heads of the format of ICT-FaceKit, made up here: a ball with eyes, a mouth, teeth and two modes."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from facerelight.bootstrap.heads.identities import IctHeads, read_identities, read_packed

MODE = np.array((0.0, 0.0, 0.5))  # one of the modes lifts the crown by that


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    mesh = trimesh.creation.icosphere(3, radius=10)
    vertices = np.array(mesh.vertices) + np.array((3, 40, 1))
    part = np.zeros(len(mesh.faces), int)
    part[:5], part[(mesh.faces == mesh.faces[600, 0]).any(1)] = 1, 2
    marks = np.full(68, 20)

    def nearest(place: tuple[float, float, float]) -> int:
        return int(((mesh.vertices - np.array(place)) ** 2).sum(1).argmin())

    marks[36:42], marks[42:48], marks[48:] = nearest((-4, 3, 9)), nearest((4, 3, 9)), nearest((0, -5, 9))
    modes = np.zeros((100, *vertices.shape))
    crown = nearest((0, 10, 0))
    modes[7, crown] = MODE
    np.savez(
        tmp_path / "ict_heads.npz",
        vertices=vertices,
        identity_basis=modes.astype(np.float32),
        triangles=mesh.faces,
        landmarks68=marks,
        triangle_part=part,
        part_names=np.array(["face", "teeth", "left eyeball"]),
    )
    return tmp_path / "ict_heads.npz"


def test_identities_are_as_far_from_the_mean_as_asked(packed: Path) -> None:
    """The crown moves by the mode times a standard normal number times the spread; eyes stay one unit apart."""
    source = IctHeads(packed, spread=0.8)
    with np.load(packed) as data:
        scale = 1 / np.linalg.norm(np.diff(data["vertices"][data["landmarks68"]][[36, 42]], axis=0))
    moved = np.array([(head.vertices - head.reference)[:, 2] for head in map(source.head, range(300))])
    crown = np.abs(moved).max(0).argmax()
    assert moved[:, crown].std() == pytest.approx(0.8 * MODE[2] * scale, rel=0.1)
    assert np.abs(moved.mean(0)).max() < 0.15 * 0.8 * MODE[2] * scale
    assert np.abs(np.delete(moved, crown, 1)).max() < 1e-6
    head = source.head(3)
    assert np.allclose(head.landmarks[:2].mean(0), 0, atol=1e-9)
    assert np.linalg.norm(head.landmarks[1] - head.landmarks[0]) == pytest.approx(1)
    assert head.landmarks[2, 1] < 0  # the mouth is below
    assert np.array_equal(IctHeads(packed, spread=0.8).head(3).vertices, head.vertices)
    assert not np.array_equal(IctHeads(packed, seed=1).head(3).vertices, head.vertices)


def test_only_face_and_eyes_are_kept(packed: Path) -> None:
    source = IctHeads(packed)
    with np.load(packed) as data:
        parts, triangles = data["triangle_part"], data["triangles"]
    head = source.head(0)
    assert np.array_equal(head.triangles, triangles[parts != 1])  # no teeth
    assert set(head.is_eye.nonzero()[0]) == set(triangles[parts == 2].ravel())


def test_an_eyeball_is_its_outer_shell_and_no_socket(tmp_path: Path) -> None:
    """An iris behind a cornea and a socket around an eyeball would shine where no white is."""
    shells = [trimesh.creation.icosphere(2, radius=radius) for radius in (1.0, 0.8, 1.2)]
    shells[2].faces = shells[2].faces[:40]
    mesh = trimesh.util.concatenate(shells)
    sizes = [len(shell.faces) for shell in shells]
    np.savez(
        tmp_path / "ict_heads.npz",
        vertices=mesh.vertices,
        identity_basis=np.zeros((100, *mesh.vertices.shape), np.float32),
        triangles=mesh.faces,
        landmarks68=np.zeros(68, int),
        triangle_part=np.repeat((1, 1, 0), sizes),
        part_names=np.array(["eye_socket_L", "eyeball_L"]),
    )
    found = read_identities(tmp_path / "ict_heads.npz")
    assert set(found.is_eye.nonzero()[0]) == set(range(len(shells[0].vertices)))
    assert np.array_equal(found.triangles, np.delete(mesh.faces, np.s_[sizes[0] : sizes[0] + sizes[1]], 0))


def test_eyeballs_are_as_smooth_as_the_average() -> None:
    """Affine maps of the average's, whoever it is: what modes are rounded by breaks the light on a pupil."""
    source = IctHeads()
    for index in (0, 5):
        head = source.head(index)
        for side in (-1, 1):
            ball = np.flatnonzero((head.is_eye > 0.5) & (side * head.reference[:, 0] > 0))
            place = np.column_stack((head.reference[ball], np.ones(len(ball)))).astype(np.float64)
            fitted = place @ np.linalg.lstsq(place, head.vertices[ball], rcond=None)[0]
            assert len(ball) > 500
            assert np.abs(fitted - head.vertices[ball]).max() < 1e-5


def test_packed_modes_are_those_packed(packed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within half a step of a thousandth of the distance between the eyes; the first 60, and no teeth."""
    out = tmp_path / "identities.npz"
    monkeypatch.setattr(sys, "argv", ["pack_identities.py", str(packed), str(out)])
    runpy.run_path(str(Path(__file__).parents[2] / "scripts/data/pack_identities.py"), run_name="__main__")
    before, after = read_identities(packed), read_packed(out)
    used = np.unique(before.triangles)
    eyes = before.vertices[before.marks[[36, 42]]]
    step = np.linalg.norm(eyes[0] - eyes[1]) / 1000
    assert after.modes.shape == (60, len(used), 3)
    assert np.abs(after.modes - before.modes[:60, used]).max() <= 0.51 * step
    assert np.array_equal(after.vertices[after.triangles], before.vertices[before.triangles].astype(np.float32))
    assert np.array_equal(after.is_eye, before.is_eye[used])
    assert np.allclose(after.vertices[after.marks], before.vertices[before.marks])


def test_the_packages_identities_are_heads() -> None:
    """Eyes and mouth where the crop expects them, closed surfaces that face outwards, everybody different."""
    source = IctHeads()
    heads = [source.head(index) for index in range(12)]
    for head in heads:
        assert np.isfinite(head.vertices).all()
        assert np.abs(head.landmarks[2] - (0, -1.05, 0.3)).max() < 0.35
        nose = head.vertices[:, 2].argmax()
        assert abs(head.vertices[nose, 0]) < 0.2
        assert -1.1 < head.vertices[nose, 1] < -0.2
        assert head.normals()[nose, 2] > 0.7
    apart = np.stack([head.vertices for head in heads]).std(0)
    assert 0.01 < apart.mean() < 0.2


def test_another_file_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", vertices=np.zeros((3, 3)))
    for name in ("other.npz", "missing.npz"):
        with pytest.raises(ValueError, match=rf"{name}: expected ict_heads\.npz"):
            IctHeads(tmp_path / name)
