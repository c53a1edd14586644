"""Adaptation to a few people: the posterior mean, what unknown lights leave, and the command line."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.cli import main
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.train.adapt import Person, adapt, read_people


def person(images: torch.Tensor, lights: torch.Tensor) -> Person:
    return Person(images, lights, torch.ones(images.shape[1:]))


def mean_image(statistics: FaceStatistics) -> torch.Tensor:
    return statistics.v_mean + torch.einsum("jc,chw->jhw", statistics.lights, statistics.n_mean)


def test_the_mean_is_the_posterior_mean(people: torch.Tensor, lights: torch.Tensor) -> None:
    """Fully observed people of the prior's brightness: (k m0 + M m) / (k + M), to float32 rounding."""
    prior = FaceStatistics.fit(people[:8], lights, face_rank=2)
    others = people[8:11].flip(-1)
    reference = mean_image(prior)
    gain = (others * reference).sum((1, 2, 3), keepdim=True) / reference.square().sum()
    others = others / gain
    adapted = adapt(prior, [person(images, lights) for images in others], prior_heads=2.0)
    # the rendered heads move by their own gains, whose mean is 1
    expected = (2 * reference + 3 * others.mean(0)) / 5
    assert (mean_image(adapted) - expected).abs().max() < 1e-4
    assert adapted.metadata["adapted_to"] == 3
    assert (mean_image(prior) - reference).abs().max() == 0  # the prior is left as it was


def test_adapting_helps_with_people_of_that_kind(people: torch.Tensor, lights: torch.Tensor) -> None:
    """A world whose lamps are brighter at the side, told by four people under half of the lights; others of it are
    relit."""
    lamp = (1 + 0.6 * (1 - lights[:, 2]))[:, None, None]
    prior = FaceStatistics.fit(people[:8], lights, face_rank=2)
    told = [person((people[i] * lamp)[::2], lights[::2]) for i in range(8, 12)]
    errors = []
    for statistics in (prior, adapt(prior, told)):
        relit = (
            StatisticalRelighter(statistics, "face")
            .condition(people[12:, :1], lights[None, :1].expand(4, 1, 3))
            .mean(lights)
        )
        errors.append(float((relit - people[12:] * lamp).square().mean()))
    assert errors[1] < 0.8 * errors[0]


def test_what_cannot_be_adapted_is_refused(people: torch.Tensor, lights: torch.Tensor, tmp_path: Path) -> None:
    prior = FaceStatistics.fit(people[:4], lights)
    with pytest.raises(ValueError, match="one person or more"):
        adapt(prior, [])
    with pytest.raises(ValueError, match="prior_heads"):
        adapt(prior, [person(people[5], lights)], prior_heads=0)
    prior.save(tmp_path / "prior.safetensors")
    with pytest.raises(RuntimeError, match="loaded"):
        adapt(FaceStatistics.load(tmp_path / "prior.safetensors"), [person(people[5], lights)])


def test_photos_are_read_with_their_lights(tmp_path: Path) -> None:
    """An aligned crop lands on the frame pixel for pixel; a labelled light is known, another is not."""
    (tmp_path / "ann").mkdir()
    ramp = np.tile(np.linspace(40, 200, 84).astype(np.uint8), (96, 1))
    Image.fromarray(ramp).save(tmp_path / "ann" / "ann_P00A+035E-20.png")
    Image.fromarray(ramp).save(tmp_path / "bob.png")
    ann, bob = read_people(tmp_path, CropFrame(96, 84))
    assert torch.allclose(ann.lights[0], light_from_angles(35.0, -20.0))
    assert bob.lights.isnan().all()
    coded = torch.from_numpy(ramp).float() / 255
    linear = torch.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    assert ((ann.images[0] - linear).abs() * ann.mask).max() < 2e-3
    assert read_people(tmp_path, CropFrame(96, 84, 0.25))[0].mask[0, 0] == 0  # outside of the photo


def test_training_adapts_to_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    grey = np.full((192, 168), 90, np.uint8)
    grey[40:60] = 140
    (tmp_path / "people").mkdir()
    Image.fromarray(grey).save(tmp_path / "people" / "ann_A+000E+00.png")
    options = [
        "--heads",
        "3",
        "--lights",
        "6",
        "--height",
        "24",
        "--width",
        "21",
        "--workers",
        "0",
        "--fit.face_rank",
        "1",
    ]
    assert main(["train", *options, "--adapt", str(tmp_path / "people")]) == 2
    assert "--output" in capsys.readouterr().err
    assert main(["train", *options, "--adapt", str(tmp_path / "people"), "--output", str(tmp_path / "out")]) == 0
    assert FaceStatistics.load(tmp_path / "out" / "statistics.safetensors").metadata["adapted_to"] == 1
    assert main(["train", *options, "--adapt", str(tmp_path / "nobody"), "--output", str(tmp_path / "out")]) == 2
