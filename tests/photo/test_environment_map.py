"""Environment maps from disk: each kind is read as linear light, and what is broken is named."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.photo.files.environment_map import read_environment
from facerelight.photo.scenes import parse_environment


@pytest.fixture
def radiance() -> np.ndarray:
    values = np.full((32, 64, 3), 0.25, np.float32)
    values[8:12, 40:44] = (40.0, 20.0, 10.0)  # beyond what a picture of bytes can hold
    return values


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_high_range_files_keep_it(tmp_path: Path, radiance: np.ndarray, suffix: str) -> None:
    import os

    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    import cv2

    path = tmp_path / f"map{suffix}"
    try:
        written = cv2.imwrite(str(path), radiance[..., ::-1])
    except cv2.error:
        written = False
    if not written:
        pytest.skip(f"this OpenCV does not write {suffix}")
    assert np.allclose(read_environment(path).numpy(), radiance, rtol=0.02)


def test_a_picture_is_taken_for_srgb(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    Image.fromarray(np.full((16, 32, 3), (188, 0, 255), np.uint8)).save(path)
    assert np.allclose(read_environment(path)[0, 0].numpy(), (0.503, 0, 1), atol=2e-3)


def test_files_that_are_no_map(tmp_path: Path, radiance: np.ndarray) -> None:
    square = tmp_path / "square.png"
    Image.fromarray(np.zeros((16, 16, 3), np.uint8)).save(square)
    broken = tmp_path / "broken.hdr"
    broken.write_bytes(b"#?RADIANCE\nnothing more")
    for path, said in (
        (square, "twice as wide"),
        (broken, "readable"),
        (tmp_path / "none.exr", "no such file"),
        (tmp_path / "map.txt", "expected an environment map"),
    ):
        with pytest.raises(ValueError, match=said):
            read_environment(path)
    black = tmp_path / "black.png"
    Image.fromarray(np.zeros((16, 32, 3), np.uint8)).save(black)
    with pytest.raises(ValueError, match=r"black\.png: environment: expected a map with some light"):
        parse_environment(str(black))


def test_turn_and_exposure_of_an_option(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    Image.fromarray(np.full((16, 32, 3), 128, np.uint8)).save(path)
    plain, turned = parse_environment(str(path)), parse_environment(f"{path},turn=90,exposure=1")
    assert torch.allclose(turned.weights.sum(), 2 * plain.weights.sum())
    with pytest.raises(ValueError, match="turn=DEGREES"):
        parse_environment(f"{path},spin=3")
