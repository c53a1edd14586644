"""The person's matte: found, mirrored and turned alike, sharp at edges, by GrabCut where there is no network."""

import cv2
import numpy as np
import pytest
import torch

from facerelight.geometry.alignment import CropFrame, fit_similarity
from facerelight.photo.bust import matte as matte_module
from facerelight.photo.bust.frame import Window, working_window
from facerelight.photo.bust.matte import NETWORK_SIZE, person_matte

CROP = CropFrame(48, 42, 0.25)
MARKS = np.array(((202.0, 101.0), (247.0, 103.0), (221.0, 144.0)))


def part_of(photo: np.ndarray, marks: np.ndarray) -> tuple[np.ndarray, Window]:
    """A photo's window at full resolution, and the window."""
    window = working_window(photo.shape, fit_similarity(torch.from_numpy(marks), CROP.landmarks).numpy(), CROP)
    part = np.ascontiguousarray(photo[window.rows, window.columns])
    return cv2.resize(part, window.size[::-1], interpolation=cv2.INTER_AREA), window


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


@pytest.fixture(scope="module")
def found(astronaut: np.ndarray) -> tuple[np.ndarray, Window]:
    image, window = part_of(astronaut, MARKS)
    return person_matte(image, window), window


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str) -> None:
        raise RuntimeError(f"{name}: expected a network of the package, got none")

    matte_module._network.cache_clear()
    monkeypatch.setattr(matte_module, "network_path", missing)
    yield
    matte_module._network.cache_clear()


def check(cover: np.ndarray, window: Window) -> None:
    """By eye on the photo: face, neck and suit are the person; flag, shuttle and sky around the head are not."""
    x, y = window.places()
    assert cover.shape == window.size
    assert cover.dtype == np.float32
    assert cover.min() >= 0
    assert cover.max() <= 1
    assert cover[np.hypot(x, (y + 0.42) / 1.42) < 0.8].min() > 0.95
    assert cover[(np.abs(x) < 1.5) & (y < -3.5) & (y > -4.5)].mean() > 0.95
    assert cover[(x < -2.2) & (y > -0.5)].mean() < 0.05
    assert cover[(x > 2.2) & (y > -0.5)].mean() < 0.05


def test_person_on_a_photo(found: tuple[np.ndarray, Window]) -> None:
    check(*found)
    cover = found[0]
    assert ((cover > 0.05) & (cover < 0.95)).mean() < 0.08  # sharp
    assert (cover == 0).mean() > 0.2
    assert (cover == 1).mean() > 0.2


def test_mirrored_photo_has_the_mirrored_matte(astronaut: np.ndarray, found: tuple[np.ndarray, Window]) -> None:
    marks = MARKS[[1, 0, 2]] * (-1, 1) + (511, 0)
    image, window = part_of(np.ascontiguousarray(astronaut[:, ::-1]), marks)
    covers = []
    for cover, place in ((person_matte(image, window), window), found):
        full = np.full((512, 512), np.nan, np.float32)
        full[place.rows, place.columns] = cover
        covers.append(full)
    gap = np.abs(covers[0][:, ::-1] - covers[1])
    assert np.isfinite(gap).mean() > 0.5
    assert np.nanmean(gap) < 0.01


@pytest.mark.parametrize("degrees", [90, 35])
def test_turned_photo_has_the_turned_matte(
    astronaut: np.ndarray, found: tuple[np.ndarray, Window], degrees: float
) -> None:
    """The network sees the bust upright, however the camera was held."""
    matrix = cv2.getRotationMatrix2D((255.5, 255.5), degrees, 0.7)
    turned = cv2.warpAffine(astronaut, matrix, (512, 512), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
    marks = MARKS @ matrix[:, :2].T + matrix[:, 2]
    image, window = part_of(turned, marks)
    cover = person_matte(image, window)
    x, y = window.places()
    near = (np.hypot(x, y + 0.5) < 2.5) & (cover >= 0)
    column, row = ((np.stack((x, y, np.ones_like(x)), -1) @ _from_bust(found[1])[k]).astype(np.float32) for k in (0, 1))
    upright = cv2.remap(found[0], column, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    assert np.abs(cover - upright)[near].mean() < 0.03


def _from_bust(window: Window) -> np.ndarray:
    full = np.vstack((window.to_bust, (0, 0, 1)))
    return np.linalg.inv(full)[:2]


def test_network_sees_all_of_the_window() -> None:
    """The corners of an upright window are those of the network's picture, up stays up."""
    for scale in (1.0, 4.0):
        marks = CROP.landmarks.numpy().astype(float) * scale + 120
        window = part_of(np.zeros((600, 900, 3), np.uint8), marks)[1]
        to_network = matte_module._upright(window)
        height, width = window.size
        corners = np.array(((-0.5, -0.5), (width - 0.5, -0.5), (-0.5, height - 0.5), (width - 0.5, height - 0.5)))
        there = corners @ to_network[:, :2].T + to_network[:, 2]
        right, bottom = NETWORK_SIZE[0] - 0.5, NETWORK_SIZE[1] - 0.5
        assert np.allclose(there, ((-0.5, -0.5), (right, -0.5), (-0.5, bottom), (right, bottom)), atol=1e-3)


def test_grabcut_answers_where_the_network_is_missing(
    astronaut: np.ndarray, found: tuple[np.ndarray, Window], no_network: None
) -> None:
    image, window = part_of(astronaut, MARKS)
    cover = person_matte(image, window)
    assert cover.dtype == np.float32
    x, y = window.places()
    assert cover[np.hypot(x, (y + 0.42) / 1.42) < 0.8].min() > 0.95
    assert cover[(np.abs(x) > 2.4) & (y > -0.5)].mean() < 0.05
    both = (cover > 0.5) & (found[0] > 0.5)
    either = (cover > 0.5) | (found[0] > 0.5)
    assert both.sum() / either.sum() > 0.85
    assert np.array_equal(cover, person_matte(image, window))


@pytest.mark.parametrize("value", [0, 255])
def test_flat_pictures_are_finite(value: int, no_network: None) -> None:
    window = part_of(np.zeros((120, 120, 3), np.uint8), np.array(((48.0, 48), (72, 48), (60, 72))))[1]
    image = np.full((*window.size, 3), value, np.uint8)
    cover = person_matte(image, window)
    assert np.isfinite(cover).all()
    x, y = window.places()
    assert cover[np.hypot(x, (y + 0.42) / 1.35) < 0.75].min() > 0.8


def test_cover_follows_the_pictures_edges(monkeypatch: pytest.MonkeyPatch) -> None:
    """A vague cover before a sharp edge becomes sharp there: within 2 pixels of it, from 3 where it was 10 off."""
    window = part_of(np.zeros((300, 300, 3), np.uint8), np.array(((120.0, 120), (180, 120), (150, 180))))[1]
    image = np.zeros((*window.size, 3), np.uint8)
    edge = window.size[1] // 2
    image[:, edge:] = (220, 180, 150)
    ramp = np.clip((np.arange(window.size[1]) - edge) / 24 + 0.5, 0, 1).astype(np.float32)
    monkeypatch.setattr(
        matte_module, "_network_cover", lambda image, window: np.broadcast_to(ramp, window.size).astype(np.float32)
    )
    cover = person_matte(image, window)
    assert cover[:, : edge - 4].max() < 0.35
    assert cover[:, edge + 4 :].min() > 0.65
    jump = cover[:, edge + 1] - cover[:, edge - 2]
    assert jump.min() > 0.4 > 2 * (ramp[edge + 1] - ramp[edge - 2])
    assert cover[:, : edge - 30].max() == 0
    assert cover[:, edge + 30 :].min() == 1
