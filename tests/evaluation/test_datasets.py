"""Photographs from files, made up here in the formats of the data sets."""

from pathlib import Path

import numpy as np
import pytest
import torch

from facerelight.evaluation.datasets import load_pie, to_grid
from facerelight.geometry.lights import light_from_angles

FLASHES = np.array([12, 2, 7])
ANGLES = np.array([[40.0, 5.0], [-60.0, 0.0], [0.0, 30.0]])


@pytest.fixture
def pie(tmp_path: Path) -> Path:
    """Two people; one was never seen under flash 7. A grey level tells who and under which flash."""
    taken = [(4, 2), (4, 12), (9, 7), (4, 7), (9, 12)]
    images = np.stack([np.full((55, 44), 10 * person + flash, np.uint8) for person, flash in taken])
    np.savez(
        tmp_path / "pie.npz",
        images=images,
        subject=np.array([person for person, _ in taken]),
        flash=np.array([flash for _, flash in taken]),
        flash_ids=FLASHES,
        flash_est_azimuth_deg=ANGLES[:, 0],
        flash_est_elevation_deg=ANGLES[:, 1],
    )
    return tmp_path / "pie.npz"


def test_pie_has_every_image_with_its_person_and_flash(pie: Path) -> None:
    faces = load_pie(pie)
    assert faces.names == ["4", "9"]
    assert faces.images.dtype == torch.float32
    expected = torch.tensor([light_from_angles(*map(float, angles)).tolist() for angles in ANGLES])
    assert torch.allclose(faces.lights, expected, atol=1e-6)
    assert float(faces.lights[0, 0]) < 0  # a positive azimuth is a light from image-left
    for image, person, light in zip(faces.images, faces.subject, faces.light, strict=True):
        level = 10 * int(faces.names[person]) + FLASHES[light]
        assert torch.allclose(image, torch.full((55, 44), float(level) / 255))
    images, valid = to_grid(faces)
    assert images.shape == (2, 3, 55, 44)
    assert valid.tolist() == [[True, True, True], [True, False, True]]
    assert float(images[1, 2].mean()) == pytest.approx(97 / 255)
    assert images[1, 1].abs().max() == 0


def test_another_file_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", images=np.zeros((1, 55, 44), np.uint8))
    with pytest.raises(ValueError, match=r"other\.npz: expected an \.npz file with images, subject, flash"):
        load_pie(tmp_path / "other.npz")
