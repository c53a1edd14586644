"""What the model makes of a crop: exposure, noise and strength of the light in the photograph's own units; and which
pixels of it are the face."""

import numpy as np
import pytest
import torch
from conftest import shaded_people

from facerelight.geometry.alignment import CropFrame
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.photo.face_mask import face_mask
from facerelight.photo.face_model import MISFIT, FaceModel

TINT = torch.tensor([1.25, 0.95, 0.75])[:, None, None]
CAMERA, SIDE = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.1, 0.79]])


def crop_of(people: torch.Tensor, strength: float) -> torch.Tensor:
    """A stranger under two of the bootstrap's lights."""
    return strength * (0.7 * people[13, 4] + 0.3 * people[13, 9])[None] * TINT


@pytest.mark.parametrize("given", [None, (0.3, 0.1, 0.95)], ids=["own light", "known light"])
def test_a_lamp_at_the_camera_keeps_the_brightness(
    statistics: FaceStatistics, people: torch.Tensor, given: tuple[float, float, float] | None
) -> None:
    relighter = StatisticalRelighter(statistics, "face")
    for strength in (0.25, 0.8):
        model = FaceModel(relighter, [crop_of(people, strength)], None if given is None else torch.tensor(given))
        before = (model.luminance * model.mask).sum()
        after = (torch.from_numpy(model.radiance(CAMERA)[0]) * model.mask).sum()
        assert float(after / before) == pytest.approx(1, abs=1e-4)
        assert not 0.9 < model.exposure < 1.1


def test_everything_goes_with_exposure(statistics: FaceStatistics, people: torch.Tensor) -> None:
    """Half the light and half the noise: half the radiance and half its standard deviation, but for a new picture's own
    noise. Twice the noise: more of it."""
    whole, half, noisy = (
        FaceModel(
            StatisticalRelighter(statistics, "face", noise=(errors**2 - MISFIT**2) ** 0.5), [crop_of(people, strength)]
        )
        for strength, errors in ((0.8, 10.0), (0.4, 5.0), (0.8, 20.0))  # grey levels in all
    )
    assert np.allclose(half.radiance(SIDE), 0.5 * whole.radiance(SIDE), atol=1e-4)
    of_face = [(m.std(SIDE[0]) ** 2 - (m.relighter.noise / 255) ** 2) ** 0.5 for m in (half, whole)]
    assert np.allclose(of_face[0], 0.5 * of_face[1], rtol=2e-2, atol=1e-5)
    assert half.exposure == pytest.approx(0.5 * whole.exposure, rel=1e-3)
    more = [m.std(SIDE[0]) ** 2 - (m.relighter.noise / 255) ** 2 for m in (whole, noisy)]
    assert more[1].mean() > more[0].mean()
    assert (noisy.std(SIDE[0]) >= noisy.relighter.noise / 255).all()


def test_the_photographs_light_gives_the_photograph(statistics: FaceStatistics, people: torch.Tensor) -> None:
    """Its directions and weights, rendered and added up, within 15 % on the face."""
    for strength in (0.25, 0.8):
        model = FaceModel(StatisticalRelighter(statistics, "face"), [crop_of(people, strength)])
        made = np.tensordot(model.light.weights[:, 0].numpy(), model.radiance(model.light.directions.numpy()), 1)
        off = (torch.from_numpy(made) - model.luminance) * model.mask
        assert float(off.norm() / (model.luminance * model.mask).norm()) < 0.15


def test_light_from_behind_lights_the_rim_alone(lights: torch.Tensor, people: torch.Tensor) -> None:
    """As the bumpy Lambertian people of the fixture are lit from there: nearer to the truth than the light at the edge,
    which it joins without a step, and nothing of it where the face looks at the camera."""
    statistics = FaceStatistics.fit(people[:12], lights, rank=6, face_rank=5, temper=10.0, basis=12)
    model = FaceModel(StatisticalRelighter(statistics, "face"), [crop_of(people, 0.8)])
    behind = np.array([[np.sin(np.deg2rad(a)), 0.0, np.cos(np.deg2rad(a))] for a in (90.0, 90.5, 125.0, 179.0)])
    edge, step, rim, none = model.radiance(behind)
    assert np.abs(step - edge).max() < 0.05 * edge.max()
    assert (rim <= edge).all()
    truth = shaded_people(14, torch.from_numpy(behind[2:3]).float(), 0)[13, 0].numpy() - 0.02  # its ambient light
    seen = model.mask.numpy() > 0.5
    exposed = truth * (
        edge[seen].sum() / (shaded_people(14, torch.from_numpy(behind[:1]).float(), 0)[13, 0].numpy())[seen].sum()
    )
    assert np.abs(rim - exposed)[seen].mean() < 0.5 * np.abs(edge - exposed)[seen].mean()
    middle = seen & (model.normal[..., 2] > 0.97)
    assert middle.any()
    assert rim[middle].max() < 0.02 * edge.max()
    assert none[seen].max() < 0.05 * edge.max()


def painted(frame: CropFrame, skin: tuple[float, float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """A face of one colour before green leaves, under a blue hat; and the distance from its middle."""
    radius = frame.oval()
    crop = torch.tensor((0.05, 0.35, 0.08))[:, None, None].expand(3, frame.height, frame.width).clone()
    shade = 1 + 0.1 * torch.rand(frame.height, frame.width, generator=torch.Generator().manual_seed(0))
    crop = torch.where(radius < 1.05, torch.tensor(skin)[:, None, None] * shade, crop)
    eyes = float(frame.landmarks[0, 1])
    hat = int(eyes - 0.45 * float(frame.landmarks[1, 0] - frame.landmarks[0, 0]))
    crop[:, :hat] = torch.tensor((0.02, 0.03, 0.4))[:, None, None]
    return crop, radius


@pytest.mark.parametrize("skin", [(0.6, 0.4, 0.3), (0.09, 0.05, 0.035)], ids=["fair", "dark"])
def test_the_mask_is_the_face(skin: tuple[float, float, float]) -> None:
    """Skin, fair and dark alike, and not the hat, the leaves beside it or what is far outside the oval."""
    frame = CropFrame(96, 84, 0.25)
    crop, radius = painted(frame, skin)
    mask = face_mask(crop, frame)
    assert mask.shape == radius.shape
    assert 0 <= mask.min() <= mask.max() <= 1
    y = torch.arange(frame.height)[:, None].expand(mask.shape)
    unit = float(frame.landmarks[1, 0] - frame.landmarks[0, 0])
    face = (radius < 0.8) & (y > float(frame.landmarks[0, 1]))
    hat = y < float(frame.landmarks[0, 1]) - 0.6 * unit
    assert mask[face].mean() > 0.95
    assert mask[hat].max() < 0.1
    assert mask[(radius > 1.15) & ~hat].mean() < 0.1
    assert mask[radius > 1.3].max() < 0.05
    assert (face_mask(0.4 * crop, frame) - mask).abs().max() < 0.02  # exposure does not count
