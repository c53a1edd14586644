import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from facerelight.geometry.alignment import CropFrame, fit_similarity, invert_similarity, warp_from_crop, warp_to_crop


@given(st.floats(0.2, 5), st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
def test_similarity_is_recovered(scale: float, angle: float, dx: float, dy: float) -> None:
    source = torch.tensor([[0.0, 0.0], [10.0, 1.0], [4.0, 9.0]], dtype=torch.float64)
    turn = torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)
    target = scale * source @ turn.T + torch.tensor([dx, dy], dtype=torch.float64)
    matrix = fit_similarity(source, target)
    assert torch.allclose(source @ matrix[:, :2].T + matrix[:, 2], target, atol=1e-8)
    back = invert_similarity(matrix)
    assert torch.allclose(target @ back[:, :2].T + back[:, 2], source, atol=1e-7)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([[5, 5], [5, 5], [5, 5]], "distinct"),
        ([[0, 0], [5, 5], [10, 10]], "collinear"),
        ([[0, 0], [float("nan"), 5], [10, 3]], "finite"),
    ],
)
def test_degenerate_landmarks(points: list[list[float]], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fit_similarity(torch.tensor(points, dtype=torch.float64), CropFrame(96, 84).landmarks)


def test_canonical_landmarks_follow_area_averages() -> None:
    """Halving the 192 x 168 crop by 2 x 2 averages moves pixel centres by a quarter of a pixel."""
    assert torch.allclose(CropFrame(96, 84).landmarks[0], torch.tensor([17.25, 22.75], dtype=torch.float64))
    assert torch.allclose(CropFrame(192, 168).landmarks[2], torch.tensor([84.0, 150.0], dtype=torch.float64))


def test_warp_there_and_back() -> None:
    y, x = torch.meshgrid(torch.arange(200.0), torch.arange(220.0), indexing="ij")
    image = (torch.sin(x / 12) + torch.cos(y / 15))[None, None]
    frame = CropFrame(128, 112, 0.25)
    matrix = fit_similarity(torch.tensor([[90.0, 80.0], [140.0, 84.0], [112.0, 140.0]]), frame.landmarks.float())[None]
    crop = warp_to_crop(image, matrix, frame)
    back = warp_from_crop(crop, matrix, (200, 220))
    inside = back != 0
    assert inside.sum() > 5000
    assert (back - image)[inside].abs().median() < 0.01


def test_large_photos_do_not_alias() -> None:
    """A fine checkerboard shrunk eightfold is grey, not moire."""
    image = (torch.arange(1536)[:, None] + torch.arange(1344)[None]).remainder(2).float()[None, None]
    frame = CropFrame(192, 168)
    matrix = fit_similarity(8 * frame.landmarks, frame.landmarks)[None]
    assert (warp_to_crop(image, matrix, frame) - 0.5).abs().max() < 0.02
