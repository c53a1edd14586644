"""Shared fixtures: a small synthetic world without OpenGL, and the real data where a path to it is given."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from facerelight.geometry.lights import even_hemisphere
from facerelight.model.statistics import FaceStatistics
from facerelight.photo.faces.landmarks import Face
from facerelight.recognition.embedding import CropPoints

SIZE = (24, 21)


def shaded_people(count: int, lights: torch.Tensor, seed: int) -> torch.Tensor:
    """Bumpy Lambertian people with attached shadows: ``(count, J, 24, 21)``, smooth over pixels, varied over people."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.linspace(1, -1, SIZE[0]), torch.linspace(-1, 1, SIZE[1]), indexing="ij")
    waves = torch.stack([torch.sin(a * x + b * y) for a, b in ((1, 2), (3, 1), (2, 4), (4, 3))])
    bumps = torch.einsum("nk,kyx->nyx", torch.randn(count, 4, generator=generator) * 0.15, waves)
    height = 0.8 * (1 - 0.5 * x**2 - 0.4 * y**2) + bumps * 0.4
    slope_y, slope_x = torch.gradient(height, dim=(1, 2))
    normal = torch.stack((-slope_x * 10, slope_y * 12, torch.ones_like(height)), 1)
    normal = torch.nn.functional.normalize(normal, dim=1)
    albedo = 0.5 + 0.1 * torch.randn(count, 1, 1, generator=generator) + 0.3 * bumps
    return torch.einsum("ncyx,jc->njyx", normal, lights).clamp_min(0) * albedo[:, None] + 0.02


class MeanColour:
    """An embedding of three numbers: the mean colour of a crop of 8 pixels, at unit length."""

    name = "mean-colour"
    crop = CropPoints(8, ((2.0, 2.0), (5.0, 2.0), (3.5, 4.0), (2.5, 6.0), (4.5, 6.0)))

    def __call__(self, crops: np.ndarray) -> torch.Tensor:
        means = torch.from_numpy(crops.astype(np.float32)).mean((1, 2)) + 1e-3
        return torch.nn.functional.normalize(means, dim=1)


def marked_face(x: float = 40.0, y: float = 40.0, unit: float = 20.0) -> Face:
    """A face by its landmarks alone: the eyes lie ``unit`` apart about (x, y), the mouth as far below."""
    landmarks = np.array(((x - unit / 2, y), (x + unit / 2, y), (x, y + unit)))
    return Face(landmarks, None, (x - unit, y - unit, x + unit, y + 1.5 * unit), 1.0, None, True, 1.0)


@pytest.fixture(scope="session")
def lights() -> torch.Tensor:
    return even_hemisphere(30)


@pytest.fixture(scope="session")
def people(lights: torch.Tensor) -> torch.Tensor:
    return shaded_people(16, lights, 0)


@pytest.fixture(scope="session")
def statistics(people: torch.Tensor, lights: torch.Tensor) -> FaceStatistics:
    return FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, temper=10.0, basis=12)


@pytest.fixture(scope="session")
def yale_path() -> Path:
    path = Path(os.environ.get("FACERELIGHT_YALE", ""))
    if not path.is_file():
        pytest.skip("Extended Yale B is not at hand; set FACERELIGHT_YALE to the path of its .npz file")
    return path


@pytest.fixture(scope="session")
def posed(tmp_path_factory: pytest.TempPathFactory):
    """A small rendered bootstrap under any view."""
    from facerelight.config import TrainConfig
    from facerelight.viewpoint.pose import BootstrapViews

    config = TrainConfig(heads=20, source="makehuman", height=48, width=42, supersample=1)
    return BootstrapViews(config, tmp_path_factory.mktemp("views"))


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Statistics of the tiny config, trained through the command line."""
    from facerelight.cli import main

    path = tmp_path_factory.mktemp("tiny")
    config = Path(__file__).parent.parent / "configs" / "tiny.yaml"
    assert main(["train", "--config", str(config), "--output", str(path), "--workers", "0"]) == 0
    return path


@pytest.fixture(scope="session")
def packaged():
    """The relighter of the package's own statistics."""
    from facerelight.photo.face_model import load_relighter

    return load_relighter()


@pytest.fixture(scope="session")
def quick(packaged):
    """A coarse fast path of it."""
    from facerelight.augment.quick import QuickRelighter

    return QuickRelighter(packaged, block=4, cells=24)


@pytest.fixture(scope="session")
def crops(packaged):
    """``crops(azimuth, elevation)``: six people of the packaged model's own code, linear radiance ``(6, 1, 112, 112)``
    in ArcFace's frame."""
    from facerelight.augment.frames import FaceWarp, frame_landmarks
    from facerelight.geometry.lights import light_from_angles
    from facerelight.model.light_terms import light_terms, loadings_at
    from facerelight.photo.face_model import crop_frame

    statistics = packaged.statistics
    code = 0.7 * torch.randn(6, 40, generator=torch.Generator().manual_seed(4))

    def at(azimuth: float, elevation: float) -> torch.Tensor:
        light = light_from_angles(azimuth, elevation)[None]
        terms = light_terms(statistics, statistics.face.residual, light, statistics.face)
        images = (terms.mean + code @ loadings_at(statistics.face, terms)[0]).unflatten(1, statistics.size)
        frame = frame_landmarks("arcface112", 112, 112)[None]
        return FaceWarp(frame, (112, 112), crop_frame(packaged)).to_crop(images.clamp(0.01, 1)[:, None])

    return at
