"""The bust's coordinates: matrices, windows and maps against their definitions, written out anew."""

import numpy as np
import pytest
import torch

from facerelight.geometry.alignment import CropFrame, fit_similarity
from facerelight.photo.bust.frame import (
    BUST,
    FINE,
    LARGEST_SIDE,
    Grid,
    Window,
    between,
    compose,
    crop_onto,
    crop_to_bust,
    crop_unit,
    invert,
    working_window,
)

CROP = CropFrame(48, 42, 0.25)
MARKS = np.array(((202.0, 101.0), (247.0, 103.0), (221.0, 144.0)))


def applied(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:, :2].T + matrix[:, 2]


def window_of(marks: np.ndarray, shape: tuple[int, int] = (512, 512)) -> tuple[Window, np.ndarray]:
    to_crop = fit_similarity(torch.from_numpy(marks), CROP.landmarks).numpy()
    return working_window(shape, to_crop, CROP), to_crop


def test_maps_of_the_plane_compose_and_invert() -> None:
    generator = np.random.default_rng(0)
    points = generator.normal(size=(20, 2))
    for _ in range(50):
        first, second = generator.normal(size=(2, 2, 3))
        assert np.allclose(applied(compose(second, first), points), applied(second, applied(first, points)))
        if abs(np.linalg.det(first[:, :2])) > 0.05:
            for identity in (compose(invert(first), first), compose(first, invert(first))):
                assert np.allclose(identity, np.eye(2, 3), atol=1e-9)


def test_grid_places_are_pixel_centres() -> None:
    """The corner of the raster lies at (-side, top); its first pixel half a pixel further in."""
    for grid in (BUST, FINE, Grid(1.0, 0.5, -1.5, 10)):
        x, y = grid.places()
        assert x.shape == y.shape == grid.size
        half = 0.5 / grid.density
        assert x[0, 0] == pytest.approx(-grid.side + half)
        assert x[0, -1] == pytest.approx(grid.side - half)
        assert y[0, 0] == pytest.approx(grid.top - half)
        assert y[-1, 0] == pytest.approx(grid.bottom + half)
        rows, columns = np.indices(grid.size)
        pixels = applied(grid.matrix(), np.stack((x, y), -1).reshape(-1, 2)).reshape(*grid.size, 2)
        assert np.abs(pixels - np.stack((columns, rows), -1)).max() < 1e-3


def test_eyes_and_mouth_in_bust_coordinates() -> None:
    """The crop's eyes lie half a unit to either side of the origin, y is up."""
    marks = applied(crop_to_bust(CROP), CROP.landmarks.numpy().astype(float))
    assert np.allclose(marks[:2], ((-0.5, 0), (0.5, 0)), atol=1e-6)
    assert abs(marks[2, 0]) < 0.05
    assert -1.3 < marks[2, 1] < -0.8
    assert crop_unit(CROP) == pytest.approx(float(CROP.landmarks[1, 0] - CROP.landmarks[0, 0]))


@pytest.mark.parametrize("degrees", [0.0, 25.0, -70.0, 180.0])
@pytest.mark.parametrize("scale", [0.5, 1.0, 9.0])
def test_window_of_a_turned_face(degrees: float, scale: float) -> None:
    """A point set up in units around the eyes is found again by the window's matrices, through crop and copy."""
    turn = np.deg2rad(degrees)
    unit, middle = 45.0 * scale, np.array((250.0, 180.0)) * scale
    across = unit * np.array((np.cos(turn), np.sin(turn)))
    up = unit * np.array((np.sin(turn), -np.cos(turn)))  # rows run downwards
    template = applied(crop_to_bust(CROP), CROP.landmarks.numpy().astype(float))
    marks = middle + template[:, :1] * across + template[:, 1:] * up
    shape = round(700 * scale), round(600 * scale)
    window, to_crop = window_of(marks, shape)
    assert max(window.size) <= LARGEST_SIDE
    part = window.rows.stop - window.rows.start, window.columns.stop - window.columns.start
    step = np.array((part[1] / window.size[1], part[0] / window.size[0]))
    corner = np.array((window.columns.start, window.rows.start))
    wanted = np.array(((0.0, 0.0), (0.5, 0.0), (-1.0, -1.5), (1.2, 0.7)))
    in_photo = middle + wanted[:, :1] * across + wanted[:, 1:] * up
    in_copy = (in_photo - corner + 0.5) / step - 0.5
    assert np.allclose(applied(window.to_bust, in_copy), wanted, atol=0.02)
    assert np.allclose(applied(window.to_crop, in_copy), applied(to_crop, in_photo), atol=0.02)
    assert window.unit == pytest.approx(unit / np.sqrt(step.prod()), rel=0.01)
    x, y = window.places()
    for row, column in ((0, 0), (window.size[0] - 1, 3), (7, window.size[1] - 1)):
        there = applied(window.to_bust, np.array((column, row), float))
        assert (x[row, column], y[row, column]) == pytest.approx(tuple(there), abs=1e-4)


def test_window_holds_the_bust_and_nothing_more() -> None:
    """6 units to each side, 3.6 above and 11 below, no matter how large the photograph is."""
    marks = MARKS + np.array((1000, 800))
    window, to_crop = window_of(marks, (4000, 5000))
    to_bust = compose(crop_to_bust(CROP), to_crop)
    sides = np.array([(x, y) for x in (-6.0, 6.0) for y in (3.6, -11.0)])
    corners = applied(invert(to_bust), sides)
    low, high = corners.min(0), corners.max(0)
    assert abs(window.columns.start - low[0]) <= 1
    assert abs(window.rows.start - low[1]) <= 1
    assert abs(window.columns.stop - high[0]) <= 2.5
    assert abs(window.rows.stop - high[1]) <= 2.5


@pytest.mark.parametrize("corner", [(0, 0), (511, 0), (0, 511), (511, 511)])
def test_window_of_a_face_at_the_border(corner: tuple[int, int]) -> None:
    """It ends where the photograph ends, and is never empty."""
    marks = MARKS - MARKS.mean(0) + corner
    window, _ = window_of(marks)
    for part, side in ((window.rows, 512), (window.columns, 512)):
        assert 0 <= part.start < part.stop <= side
    touched = [
        part.start if place == 0 else part.stop
        for part, place in zip((window.columns, window.rows), corner, strict=True)
    ]
    assert touched == [0 if place == 0 else 512 for place in corner]


def test_maps_of_a_linear_ramp_stay_linear() -> None:
    """What is linear in bust coordinates stays so between grids, from the copy onto a grid and back."""

    def ramp(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (0.3 * x - 0.7 * y + 2).astype(np.float32)

    def gap(image: np.ndarray, x: np.ndarray, y: np.ndarray, near: float) -> float:
        inside = (np.abs(x) < near) & (np.abs(y) < near)
        assert inside.sum() > 100
        return float(np.abs(image - ramp(x, y))[inside].max())

    window, _ = window_of(MARKS)
    for source, target in ((BUST, FINE), (FINE, BUST)):
        assert gap(between(ramp(*source.places()), source, target), *target.places(), 3.4) < 2e-3
    for grid in (BUST, FINE):
        assert gap(window.back(ramp(*grid.places()), grid), *window.places(), 2.2) < 2e-3
        assert gap(window.onto(ramp(*window.places()), grid), *grid.places(), 2.0) < 2e-3
        bust_x, bust_y = grid.places()
        to_bust = crop_to_bust(CROP)
        rows, columns = np.indices((CROP.height, CROP.width))
        of_crop = ramp(
            to_bust[0, 0] * columns + to_bust[0, 2], to_bust[1, 1] * rows + to_bust[1, 2]
        )  # no turn between them
        assert gap(crop_onto(of_crop, CROP, grid), bust_x, bust_y, 0.6) < 5e-3
    of_copy = ramp(*window.places())
    assert gap(window.from_crop(window.onto_crop(of_copy), 0.0), *window.places(), 0.6) < 5e-3
    outside = window.from_crop(np.ones((CROP.height, CROP.width), np.float32), outside=9.0)
    x, y = window.places()
    assert outside[np.hypot(x, y) > 3.4].min() == 9.0
    assert outside[np.hypot(x, y) < 0.4].max() == pytest.approx(1.0)
    assert crop_onto(np.ones((CROP.height, CROP.width), np.float32), CROP, BUST, 5.0)[0, 0] == 5.0


def test_window_fades_out_towards_its_ends() -> None:
    """1 over head, shoulders and chest, 0 at the window's ends, slowly below, where a body goes on beyond it."""
    window, _ = window_of(MARKS + np.array((1000, 800)), (4000, 5000))
    fade, (x, y) = window.fade(), window.places()
    assert fade[(np.abs(x) < 3.5) & (y < 3) & (y > -5.9)].min() == 1
    assert fade[(np.abs(x) > 6.0) | (y > 3.6) | (y < -11.0)].max() < 1e-6
    assert fade[-3].max() < 0.01
    assert fade[:, :2].max() < 0.01
    assert np.abs(np.gradient(fade)).max() * window.unit < 3.1
    assert np.abs(np.gradient(fade)[0][y < 2]).max() * window.unit < 0.35
