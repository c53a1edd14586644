"""The bootstrap trained by several processes."""

import csv
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from facerelight.cli import main, read_config
from facerelight.config import QUALITIES, quality_config
from facerelight.model.image_store import ImageStore
from facerelight.model.statistics import FaceStatistics
from facerelight.train.cross_validation import choose_face_options
from facerelight.train.run import train

CONFIG = Path(__file__).parents[2] / "configs" / "tiny.yaml"


def test_two_processes_learn_the_same_statistics_as_one(tmp_path: Path) -> None:
    """Each held to one thread: with more, rounding turns eigenvectors that are nearly tied."""
    options = ["-m", "facerelight.cli", "train", "--config", str(CONFIG), "--heads", "5", "--workers", "0", "--output"]
    shared = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    for name, launcher in (("one", []), ("two", shared)):
        command = [sys.executable, *launcher, *options, str(tmp_path / name)]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=120, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        assert done.returncode == 0, done.stderr
    one, two = (FaceStatistics.load(tmp_path / name / "statistics.safetensors").state_dict() for name in ("one", "two"))
    assert one.keys() == two.keys()
    assert all(torch.allclose(one[name], two[name], atol=1e-5) for name in one)
    assert not (tmp_path / "two" / "images").exists()


def test_rank_and_temper_are_chosen_where_asked(tmp_path: Path) -> None:
    """The options of the statistics are those that cross-validation over the same heads takes."""
    config = replace(read_config(CONFIG), heads=7, height=24, width=21, lights=12, choose_rank=True)
    train(config, tmp_path, workers=0, keep_images=True)
    statistics = FaceStatistics.load(tmp_path / "statistics.safetensors")
    every = torch.stack([torch.from_numpy(array.copy()) for array in ImageStore(tmp_path / "images")])
    choice = choose_face_options(every, statistics.lights, options=config.fit)
    assert statistics.face is not None
    assert statistics.options == choice.options
    assert len(statistics.face.n) == choice.options.face_rank != config.fit.face_rank
    assert float(statistics.face.temper) == choice.options.temper
    assert choice.errors[choice.options.face_rank, choice.options.temper] == min(choice.errors.values())


def test_the_quick_form_of_the_trade_off_runs(tmp_path: Path) -> None:
    script = Path(__file__).parents[2] / "scripts" / "measure" / "accuracy_vs_time.py"
    command = [sys.executable, str(script), "--quick", "--output", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "relighting.csv").read_text().splitlines()))
    assert {row["knob"] for row in rows} == {"model", "variance"}
    assert all(float(row["milliseconds"]) > 0 and 0 < float(row["rmse_side"]) < 100 for row in rows)
    assert (tmp_path / "trade_off.png").stat().st_size > 1000
    assert "**whole-face**" in (tmp_path / "relighting.md").read_text()
    recognition = list(csv.DictReader((tmp_path / "recognition.csv").read_text().splitlines()))
    assert [row["value"] for row in recognition] == ["80", "direct, no synthesis"]
    effects = {row["value"]: row for row in csv.DictReader((tmp_path / "rendering.csv").read_text().splitlines())}
    assert float(effects["auto"]["rmse"]) < 1e-3
    assert "on demand, whole-face" in (tmp_path / "poses.md").read_text()


@pytest.mark.parametrize("quality", list(QUALITIES))
def test_the_configs_are_the_qualities(quality: str) -> None:
    name = "default" if quality == "standard" else quality
    assert read_config(Path(__file__).parents[2] / "configs" / f"{name}.yaml") == quality_config(quality)


def test_an_unknown_quality_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match="draft, standard, reference"):
        quality_config("finest")
    assert main(["relight", "photo.jpg", "--quality", "finest"]) == 2
    assert "draft" in capsys.readouterr().err
