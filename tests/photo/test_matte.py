"""The person's matte: found, mirrored and turned alike, sharp at edges, by GrabCut where there is no network."""

import cv2
import numpy as np
import pytest
import torch

from facerelight.geometry.alignment import CropFrame, fit_similarity
from facerelight.photo.bust import matte as matte_module
from facerelight.photo.bust.frame import Window, working_window
from facerelight.photo.bust.matte import NETWORK_SIZE, ground_behind, person_matte

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


def near(window: Window) -> np.ndarray:
    """Head and shoulders."""
    x, y = window.places()
    return (np.abs(x) < 4.6) & (y > -6.2)


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
    assert ((cover > 0.05) & (cover < 0.95))[near(found[1])].mean() < 0.08  # sharp
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
    bust = np.zeros((512, 512), bool)
    bust[found[1].rows, found[1].columns] = near(found[1])
    gap = np.abs(covers[0][:, ::-1] - covers[1])[bust]
    assert np.isfinite(gap).sum() > 0.5 * 512 * 512
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
        to_network = matte_module._upright(window, (np.inf, np.inf, np.inf))
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
    both = (cover > 0.5) & (found[0] > 0.5) & near(window)
    either = ((cover > 0.5) | (found[0] > 0.5)) & near(window)
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
    image[:, edge:] += np.random.default_rng(0).integers(
        0, 6, (window.size[0], window.size[1] - edge, 1), dtype=np.uint8
    )
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


def portrait(ground: int, plain: bool = True) -> tuple[np.ndarray, Window, np.ndarray]:
    """A picture of a figure on a ground, its window, and where the figure is."""
    window = part_of(np.zeros((300, 300, 3), np.uint8), np.array(((120.0, 100), (180, 100), (150, 160))))[1]
    x, y = window.places()
    figure = (np.hypot(x, y + 0.4) < 1.7) | ((np.abs(x) < 1.5) & (y < 0))
    noise = np.random.default_rng(0).integers(-9, 10, (*window.size, 1))
    image = np.where(figure[..., None], np.array((120, 90, 70)) + noise, ground + (0 if plain else noise))
    return image.astype(np.uint8), window, figure


def covered(monkeypatch: pytest.MonkeyPatch, image: np.ndarray, window: Window, cover: np.ndarray) -> np.ndarray:
    """The matte where the network's answer is ``cover``."""
    monkeypatch.setattr(matte_module, "_network_cover", lambda image, window: cover.astype(np.float32))
    return person_matte(image, window)


def test_blank_ground_is_no_person(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a network takes all of a cut-out for a person, its one-coloured ground is not; a plain coat is."""
    image, window, figure = portrait(235)
    far = cv2.dilate(figure.astype(np.uint8), np.ones((25, 25))) == 0
    everything = np.ones(window.size)
    assert covered(monkeypatch, image, window, everything)[far].max() < 0.05
    assert (
        covered(monkeypatch, image, window, everything)[cv2.erode(figure.astype(np.uint8), np.ones((9, 9))) > 0].min()
        > 0.9
    )
    image[figure & (window.places()[1] < -2.2)] = (20, 40, 160)  # a coat of one colour that reaches the border
    coat = cv2.erode((image == (20, 40, 160)).all(-1).astype(np.uint8), np.ones((9, 9))) > 0
    assert covered(monkeypatch, image, window, everything)[coat].min() > 0.9


def test_gaps_in_hair_show_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """A hole in the hair through which a plain ground shows is no person; a ground that varies says nothing."""
    wall = np.random.default_rng(1).integers(-3, 4, (400, 400, 1))
    for roughness, share in ((1, (0.0, 0.3)), (14, (0.8, 1.0))):
        image, window, figure = portrait(0)
        x, y = window.places()
        hole = np.hypot(x - 1.5, y + 0.4) < 0.12
        rough = 190 + roughness * wall[: window.size[0], : window.size[1]]
        image = np.where((figure & ~hole)[..., None], image, rough).clip(0, 255).astype(np.uint8)
        seen = covered(monkeypatch, image, window, figure)[np.hypot(x - 1.5, y + 0.4) < 0.05].mean()
        assert share[0] <= seen <= share[1]


def test_ground_behind_an_outline() -> None:
    """The ground under a half-covered outline is what stands beside it, not a mixture with the person."""
    cover = np.clip((np.arange(200) - 90) / 20, 0, 1).astype(np.float32)[None].repeat(80, 0)
    behind = np.linspace(0.2, 0.6, 80, dtype=np.float32)[:, None, None] * np.ones((1, 200, 3), np.float32)
    scene = behind + cover[..., None] * (0.9 - behind)
    found = ground_behind(scene, cover, 60.0)
    assert np.abs(found - behind)[10:-10, 80:105].max() < 0.06
