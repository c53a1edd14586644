"""Against real photographs, where they are at hand."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.evaluation import evaluate_folds, held_out_lights, relighting_errors
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.recognition import Enrolment, evaluate_galleries, training_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics


def test_public_folder_layout(tmp_path) -> None:
    """The sign of the light in the file names: +35 azimuth lights the image's left half."""
    folder = tmp_path / "yaleB01"
    folder.mkdir()
    ramp = np.repeat(np.linspace(220, 20, 168)[None], 192, 0).astype(np.uint8)  # bright at image-left
    for name, pixels in (("P00A+035E+40", ramp), ("P00A-035E+40", ramp[:, ::-1]), ("P00A+000E+00", ramp // 2 + 60)):
        Image.fromarray(np.ascontiguousarray(pixels)).save(folder / f"yaleB01_{name}.pgm")
    Image.fromarray(ramp).save(folder / "yaleB01_P00_Ambient.pgm")
    faces = load_yale(tmp_path, 48, 42)
    assert len(faces.images) == 3
    for image, light in zip(faces.images, faces.light, strict=True):
        toward_left = float(image[:, :21].mean() - image[:, 21:].mean())
        x = float(faces.lights[light][0])
        assert x == pytest.approx(0, abs=1e-6) or np.sign(toward_left) == -np.sign(x)
    with pytest.raises(ValueError, match="found none"):
        load_yale(folder, 48, 42)


def test_light_sign_on_yale(yale_path: Path) -> None:
    faces = load_yale(yale_path, 48, 42)
    balance = faces.images[:, :, :21].mean((1, 2)) - faces.images[:, :, 21:].mean((1, 2))
    x = faces.lights[faces.light][:, 0]
    side = x.abs() > 0.3
    assert (torch.sign(balance[side]) == -torch.sign(x[side])).float().mean() > 0.98


def test_relighting_beats_the_baselines(yale_path: Path) -> None:
    faces = load_yale(yale_path, 48, 42)
    images, valid = to_grid(faces)
    assert images.shape == (28, 64, 48, 42)
    assert int(held_out_lights(faces).sum()) == 13
    assert int(valid.sum()) == len(faces.images)

    def make(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        return FaceStatistics.fit(images, lights, valid, rank=8, face_rank=18, temper=30.0)

    with torch.no_grad():
        scores, _ = evaluate_folds(faces, 4, make, ["pixel", "face"])
    rmse = {case: {name: float(s.rmse.mean()) for name, s in by.items()} for case, by in scores.items()}
    assert rmse["front"]["pixel"] < 24.6
    assert rmse["side"]["pixel"] < 29
    assert rmse["side"]["face"] < 0.92 * rmse["side"]["pixel"]
    for by in rmse.values():
        assert by["face"] < min(by["copy"], by["mean_face"], by["ratio_image"])


def test_registration_takes_a_grey_level_off(yale_path: Path) -> None:
    """People brought into step and registered inputs, against neither, the same fold options otherwise."""
    faces = load_yale(yale_path, 48, 42)

    def aligned(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        return as_marked(align_people(images, lights, valid), lights, valid)

    def as_marked(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        return FaceStatistics.fit(images, lights, valid, rank=8, face_rank=18, temper=30.0, brightness=True)

    with torch.no_grad():
        before, _ = evaluate_folds(faces, 4, as_marked, ["face"])
        after, light = evaluate_folds(faces, 4, aligned, ["face"], register=True)
    for case in ("front", "side"):
        assert float(after[case]["face"].rmse.mean()) < float(before[case]["face"].rmse.mean()) - 1.0
    assert light["median_deg"] < 9


def test_fine_detail_pays_on_people_outside_the_bootstrap(yale_path: Path) -> None:
    """Relit images that keep half of the photograph's detail err less; with all of it, people are told apart across
    lights."""
    faces = load_yale(yale_path, 48, 42)
    images, valid = to_grid(faces)
    with torch.no_grad():
        statistics = FaceStatistics.fit(images[::2], faces.lights, valid[::2], rank=8, face_rank=10, brightness=True)
        others = list(range(1, 28, 2))
        for case in ("front", "side"):
            bare, kept = (relighting_errors(statistics, faces, case, detail)[others].nanmean() for detail in (0.0, 0.5))
            assert float(kept) < float(bare) - 0.1
        galleries = list(training_lights(faces, others, "random", 3))
        names = ["individual_pca_9+weber", "individual_pca_9+detail+cosine+weber_fine"]
        tallies = evaluate_galleries(
            faces, galleries, StatisticalRelighter(statistics, "face"), names, Enrolment(shift=1)
        )
    plain, detailed = (float(torch.cat([t.right for t in tallies[name]]).float().mean()) for name in names)
    assert detailed > plain + 0.15  # at 96 x 84 detail is finer still
