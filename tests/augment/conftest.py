"""The packaged model on a coarse fast path, and people that it makes up."""

import pytest
import torch

from facerelight.augment.frames import FaceWarp, frame_landmarks
from facerelight.augment.quick import QuickRelighter
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.photo.face_model import crop_frame, load_relighter

PEOPLE = 6


def made_up(relighter: StatisticalRelighter, light: torch.Tensor, count: int = PEOPLE) -> torch.Tensor:
    """People of the model's own whole-face code under one light ``(3,)``, on its crop, ``(count, 1, H, W)``."""
    statistics = relighter.statistics
    code = 0.7 * torch.randn(count, 40, generator=torch.Generator().manual_seed(4))
    terms = light_terms(statistics, statistics.face.residual, light[None], statistics.face)
    images = terms.mean + code @ loadings_at(statistics.face, terms)[0]
    return images.unflatten(1, statistics.size).clamp(0.01, 1)[:, None]


@pytest.fixture(scope="session")
def packaged() -> StatisticalRelighter:
    return load_relighter()


@pytest.fixture(scope="session")
def quick(packaged: StatisticalRelighter) -> QuickRelighter:
    return QuickRelighter(packaged, block=4, cells=24)


@pytest.fixture(scope="session")
def crops(packaged: StatisticalRelighter):
    """``crops(azimuth, elevation)``: linear radiance ``(6, 1, 112, 112)`` in ArcFace's frame."""

    def at(azimuth: float, elevation: float) -> torch.Tensor:
        images = made_up(packaged, light_from_angles(azimuth, elevation))
        return FaceWarp(frame_landmarks("arcface112", 112, 112)[None], (112, 112), crop_frame(packaged)).to_crop(images)

    return at
