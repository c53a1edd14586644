"""The bootstrap trained by several processes."""

import os
import subprocess
import sys
from pathlib import Path

import torch

from facerelight.statistics import FaceStatistics

CONFIG = Path(__file__).parent.parent / "configs" / "tiny.yaml"


def test_two_processes_learn_the_same_statistics_as_one(tmp_path: Path) -> None:
    """Each held to one thread: with more, rounding turns eigenvectors that are nearly tied."""
    options = ["-m", "facerelight.cli", "train", "--config", str(CONFIG), "--heads", "5", "--workers", "0", "--output"]
    shared = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    for name, launcher in (("one", []), ("two", shared)):
        command = [sys.executable, *launcher, *options, str(tmp_path / name)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, env={**os.environ, "OMP_NUM_THREADS": "1"})
        assert done.returncode == 0, done.stderr
    one, two = (FaceStatistics.load(tmp_path / name / "statistics.safetensors").state_dict() for name in ("one", "two"))
    assert one.keys() == two.keys()
    assert all(torch.allclose(one[name], two[name], atol=1e-5) for name in one)
    assert not (tmp_path / "two" / "images").exists()
