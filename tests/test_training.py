"""The bootstrap trained by several processes."""

import os
import subprocess
import sys
from pathlib import Path

import torch

from facerelight.cli import main
from facerelight.statistics import FaceStatistics

CONFIG = Path(__file__).parent.parent / "configs" / "tiny.yaml"


def test_two_processes_learn_the_same_statistics_as_one(tmp_path: Path) -> None:
    options = ["train", "--config", str(CONFIG), "--heads", "5", "--workers", "0", "--output"]
    assert main([*options, str(tmp_path / "one")]) == 0
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "facerelight.cli"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([*command, *options, str(tmp_path / "two")], capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    one, two = (FaceStatistics.load(tmp_path / name / "statistics.safetensors").state_dict() for name in ("one", "two"))
    assert one.keys() == two.keys()
    assert all(torch.allclose(one[name], two[name], atol=1e-5) for name in one)
    assert not (tmp_path / "two" / "images").exists()
