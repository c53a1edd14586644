"""The paint of eyes and what lids do to it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.heads import HeadSource, IctHeads, MakeHumanHeads
from facerelight.bootstrap.heads.rest import LOWER, UPPER
from facerelight.bootstrap.look.eyes import IRIS_RADIUS, Gaze, lashes, lid_shade, paint_eyes
from facerelight.bootstrap.look.skin import Look, paint
from facerelight.bootstrap.posture import stand
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import light_from_angles

GAZE = Gaze(aside=0.02, up=0.01, iris=0.093, pupil=0.04, white=0.45)


def at(*places: tuple[float, float]) -> torch.Tensor:
    return torch.tensor([(x, y, 0.05) for x, y in places])


def test_white_iris_limbus_and_pupil() -> None:
    """From the axis outwards: black, dark, darker at the rim, white; and the white darker towards its corners."""
    across = paint_eyes(at(*((0.52 + r, 0.01) for r in (0.0, 0.065, 0.082, 0.12))), GAZE, 0.6)
    pupil, iris, limbus, white = across.tolist()
    assert pupil < 0.02 < limbus < 0.9 * iris
    assert iris < 0.5 * white
    inner, middle, outer = paint_eyes(at((0.33, 0.0), (0.4, 0.0), (0.67, 0.0)), GAZE, 0.6).tolist()
    assert inner < outer < middle < 0.45  # the tear duct is darkest
    half = 0.5 * (paint_eyes(at((0.52, 0.0)), GAZE, 0.9) + across[-1])
    edge = paint_eyes(at(*((0.52 + r, 0.01) for r in np.arange(0.05, 0.13, 0.0005))), GAZE, 0.9) > half
    assert 0.05 + 0.0005 * int(edge.float().argmax()) == pytest.approx(0.093, abs=0.003)


def test_both_eyes_look_the_same_way() -> None:
    """The iris of each lies as far to image-right."""
    x = torch.arange(-0.09, 0.09, 0.001)
    for eye in (-0.5, 0.5):
        albedo = paint_eyes(torch.stack((eye + x, torch.full_like(x, 0.01), torch.zeros_like(x)), 1), GAZE, 0.6)
        dark = (albedo < 0.02).float()
        assert float((dark * x).sum() / dark.sum()) == pytest.approx(GAZE.aside, abs=0.002)


def test_lashes_are_where_lids_end() -> None:
    places = at((0.5, UPPER + 0.008), (-0.5, LOWER - 0.008), (0.5, 0.2), (0.85, 0.0), (0.5, 0.09))
    places[4, 2] = -1.0  # the back of the head
    on, below, brow, temple, behind = lashes(places).tolist()
    assert on > 0.75
    assert 0.2 < below < 0.4
    assert max(brow, temple, behind) < 0.01


def test_shade_hangs_from_the_lid() -> None:
    """Darkest where the lid is, gone by the middle of the eye, the same at twice the resolution, and on eyes alone."""
    eye = torch.zeros(40, 60, dtype=torch.bool)
    eye[10:30, 20:40] = True
    shade = lid_shade(eye, 100.0)
    column = shade[10:30, 30]
    assert (shade[~eye] == 1).all()
    assert (column.diff() > 0).all()
    assert column[0] < 0.7
    assert column[-1] > 0.95
    twice = lid_shade(eye.repeat_interleave(2, 0).repeat_interleave(2, 1), 200.0)
    assert (torch.nn.functional.avg_pool2d(twice[None], 2)[0] - shade).abs().max() < 0.01


def test_skin_away_from_the_eyes_has_no_part_in_a_gaze() -> None:
    """And a person's eyes are the same every time."""
    look = Look.random(np.random.default_rng(3), Domain())
    places, is_eye = at((0.5, 0.01), (0.9, -0.5), (0.0, -0.4)), torch.tensor([1.0, 0.0, 0.0])
    first = paint(places, is_eye, look)
    assert torch.equal(first, paint(places, is_eye, look))
    assert torch.equal(first[1:], paint(places, is_eye, replace(look, iris=0.99))[1:])
    draws = [Gaze.random(np.random.default_rng(k)) for k in range(300)]
    assert np.std([gaze.aside for gaze in draws]) == pytest.approx(0.02, rel=0.2)
    assert abs(np.mean([gaze.up for gaze in draws])) < 0.02


def test_no_white_above_the_iris_in_a_rendered_face() -> None:
    """White above the iris is a stare: straight up from the middle of the iris comes a lid."""
    frame = CropFrame(128, 112)
    dataset = BootstrapDataset(
        IctHeads(), 10, light_from_angles(0.0, 0.0)[None], frame, Domain(pitch=0.0, turn=0.0, misalign=0.0)
    )
    highest = []
    for index in range(10):
        dataset.surface(index)
        seen = dataset.renderer.geometry()
        gaze = Gaze.random(np.random.default_rng((dataset.look(index).seed, 4)))
        x, y, _, is_eye = np.moveaxis(seen.attribute, -1, 0)
        above = seen.inside & (is_eye > 0.5) & (np.abs(np.abs(x) - 0.5 - np.sign(x) * gaze.aside) < 0.02)
        highest.append(y[above].max() - gaze.up)
    dataset.close()
    assert max(highest) < IRIS_RADIUS
    assert 0.03 < np.mean(highest) < 0.08  # lids end between the rim of the pupil and that of the iris


@pytest.mark.parametrize("source", [IctHeads(), MakeHumanHeads()])
def test_eyes_stay_on_the_camera_when_a_head_turns(source: HeadSource) -> None:
    """As the camera sees it, the iris of a head that is turned aside stays in the middle of the eyeball, where it was;
    nothing but eyes changes its paint."""
    head, domain = source.head(1), Domain(pitch=0.0, turn=0.0, misalign=0.0)

    def iris(seed: int, turn: float, reference: np.ndarray | None = None) -> np.ndarray:
        """How far to image-right the iris of each eye lies of the eyeball's middle."""
        stood = stand(head, np.random.default_rng(seed), replace(domain, turn=turn))
        assert np.array_equal(stood.reference[head.is_eye < 0.5], head.reference[head.is_eye < 0.5])
        painted, places = stood.reference if reference is None else reference, []
        for side in (-1, 1):
            ball = (head.is_eye > 0.5) & (side * head.reference[:, 0] > 0)
            front = ball & (head.vertices[:, 2] > head.vertices[ball, 2].max() - 0.1)
            x, y = painted[front, 0] - side * 0.5, painted[front, 1]
            terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), 1)
            fitted = np.linalg.lstsq(terms, stood.vertices[front, 0], rcond=None)[0]
            places.append(fitted[0] - stood.vertices[ball, 0].mean())
        return np.array(places)

    for seed in range(6):
        straight, turned, left_behind = iris(seed, 0.0), iris(seed, 10.0), iris(seed, 10.0, head.reference)
        carried = np.abs(left_behind - straight).max()
        assert np.abs(turned - straight).max() < 0.25 * carried + 0.006
    assert max(np.abs(iris(k, 10.0, head.reference) - iris(k, 0.0)).max() for k in range(6)) > 0.02
