"""What is measured on photographs without truth, on pictures whose faults are known."""

import numpy as np
import pytest
import torch

from facerelight.evaluation.photographs import MEASURES, photograph_measures
from facerelight.geometry.alignment import CropFrame

FRAME = CropFrame(96, 84, 0.25)
LANDMARKS = np.array([[115.0, 110.0], [185.0, 110.0], [150.0, 186.0]])
SHAPE = (330, 300)


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    """Skin all over, a dark beard below the mouth."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    light = (1 + 0.05 * np.sin(x / 9) * np.cos(y / 11))[..., None]
    skin = (light * np.array([190.0, 140.0, 115.0])).round().astype(np.uint8)
    beard = (np.abs(x - 150) < 30) & (np.abs(y - 205) < 12)
    skin[beard] = (28, 22, 20)
    return skin


def inside(radius: float) -> np.ndarray:
    """Where the oval of the face is, on the photo."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.hypot((x - 150) / 70, ((110 - y) / 70 + 0.42) / 1.42) < radius


def darker(photo: np.ndarray, where: np.ndarray, share: float = 0.5) -> np.ndarray:
    out = photo.copy()
    out[where] = (out[where] * share).astype(np.uint8)
    return out


def test_no_change_no_fault(photo: np.ndarray) -> None:
    matte = np.ones(SHAPE)
    matte[:2] = 0
    values = photograph_measures(photo, photo, LANDMARKS, FRAME, matte, 1)
    assert set(values) == set(MEASURES)
    assert values["pigment"] == pytest.approx(1)
    for name in ("cut", "step", "lit_half", "black", "halo", "clipped"):
        assert values[name] == 0
    nobody = photograph_measures(photo, photo, LANDMARKS, FRAME, np.zeros(SHAPE), 1)
    assert np.isnan(nobody["clipped"])
    assert np.isnan(nobody["step"])


def test_a_cut_at_the_crops_top(photo: np.ndarray) -> None:
    scale = 70 / float(FRAME.landmarks[1, 0] - FRAME.landmarks[0, 0])
    border = 110 - float(FRAME.landmarks[0, 1]) * scale  # the crop's first row, on the photo
    y = np.mgrid[: SHAPE[0], : SHAPE[1]][0]
    assert photograph_measures(photo, darker(photo, y > border - 0.5), LANDMARKS, FRAME)["cut"] > 0.5
    assert photograph_measures(photo, darker(photo, y > 0), LANDMARKS, FRAME)["cut"] == pytest.approx(0, abs=0.02)
    high = LANDMARKS - [0, 60]  # the crop begins above the photo
    assert np.isnan(photograph_measures(photo, photo, high, FRAME)["cut"])


def test_soot_beside_an_untouched_ear(photo: np.ndarray) -> None:
    x = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    soot = darker(photo, inside(0.95) & (x > 150))
    left = photograph_measures(photo, soot, LANDMARKS, FRAME, side=1)
    assert left["step"] > 1.5
    assert left["lit_half"] == pytest.approx(0, abs=0.02)
    right = photograph_measures(photo, soot, LANDMARKS, FRAME, side=-1)  # the lamp on the dark side
    assert right["step"] == pytest.approx(0, abs=0.02)
    assert right["lit_half"] < -1.5
    assert np.isnan(photograph_measures(photo, soot, LANDMARKS, FRAME)["step"])


def test_bleached_beard_black_skin_halo_and_clipping(photo: np.ndarray) -> None:
    beard = photo.max(-1) < 40
    pale = photo.copy()
    pale[beard] = (60, 50, 45)
    assert photograph_measures(photo, pale, LANDMARKS, FRAME)["pigment"] > 2
    black = darker(photo, inside(0.5) & ~beard, 0.05)
    assert 0.1 < photograph_measures(photo, black, LANDMARKS, FRAME)["black"] < 0.6
    changed = photo.copy()
    changed[5, 5, 1] += 7
    changed[150, 150] = 255
    matte = inside(1.2).astype(np.float32)
    values = photograph_measures(photo, changed, LANDMARKS, FRAME, matte)
    assert values["halo"] == 7
    assert values["clipped"] == pytest.approx(1 / (matte > 0.5).sum())


def test_sizes_must_agree(photo: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected two uint8"):
        photograph_measures(photo, photo[:-1], torch.tensor(LANDMARKS).numpy(), FRAME)
