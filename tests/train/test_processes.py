"""Several processes on one cache, and what an interrupted one leaves."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from facerelight.cli import read_config
from facerelight.config import default_statistics_folder
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.image_store import ImageStore
from facerelight.train.dataset import make_dataset
from facerelight.train.lock import locked
from facerelight.train.run import rendered_statistics

CONFIG = Path(__file__).parents[2] / "configs" / "tiny.yaml"
HEADS = 4
TRAIN = f"""
from dataclasses import replace
from facerelight.cli import read_config
from facerelight.train.run import trained_folder
print(trained_folder(replace(read_config({str(CONFIG)!r}), heads={HEADS})))
"""


def together(cache: Path, count: int) -> list[str]:
    """The folders that ``count`` processes on one ``cache`` answer with."""
    there = {**os.environ, "FACERELIGHT_CACHE": str(cache), "OMP_NUM_THREADS": "1"}
    pipe = subprocess.PIPE
    running = [
        subprocess.Popen([sys.executable, "-c", TRAIN], stdout=pipe, stderr=pipe, text=True, env=there)
        for _ in range(count)
    ]
    answers = [process.communicate(timeout=300) for process in running]
    for process, (_, errors) in zip(running, answers, strict=True):
        assert process.returncode == 0, errors
    assert sum("training them once" in errors for _, errors in answers) == 1
    return [out.strip() for out, _ in answers]


def test_two_processes_train_one_cache_once(tmp_path: Path) -> None:
    one, two = together(tmp_path, 2)
    assert one == two
    assert StatisticalRelighter.from_pretrained(one).estimator is not None
    assert not list(tmp_path.rglob("*.part"))
    assert not (Path(one) / "images").exists()


def test_a_script_without_a_guard_is_told_so(tmp_path: Path) -> None:
    """Rendering starts workers, which import the script anew, and would wait for their own parent."""
    script = tmp_path / "script.py"
    script.write_text(TRAIN.replace(f"heads={HEADS}", "heads=24"))  # enough for workers
    there = {**os.environ, "FACERELIGHT_CACHE": str(tmp_path), "OMP_NUM_THREADS": "1"}
    running = subprocess.Popen([sys.executable, script], env=there, stderr=subprocess.PIPE, text=True)
    assert running.stderr is not None
    try:  # the parent may wait for a worker that died before it read its task: the line is what tells
        assert any("put what the script does under `if __name__ == '__main__':`" in line for line in running.stderr)
    finally:
        running.kill()
        running.wait()
        running.stderr.close()


def test_a_folder_in_use_is_waited_for_and_then_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hold = f"""
import time
from pathlib import Path
from facerelight.train.lock import locked
with locked(Path({str(tmp_path)!r})):
    print("held", flush=True)
    time.sleep(60)
"""
    holder = subprocess.Popen([sys.executable, "-c", hold], stdout=subprocess.PIPE, text=True)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(TimeoutError, match="another process"), locked(tmp_path, 0.3):
        pass
    assert "waiting for another process" in capsys.readouterr().err
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with locked(tmp_path, 5.0):  # a dead process holds nothing
        pass


def test_statistics_are_not_learned_from_part_of_the_heads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dataclasses import replace

    monkeypatch.setenv("FACERELIGHT_CACHE", str(tmp_path))
    config = replace(read_config(CONFIG), heads=HEADS)
    images = default_statistics_folder(config) / "images"
    dataset = make_dataset(config)
    for head in (0, 1):
        ImageStore(images).add(dataset[head].images, head)
    dataset.close()
    learned = rendered_statistics(config)
    assert learned.store is not None
    assert len(learned.store) == HEADS
    (images / "subject_000001.npy").write_bytes(b"damaged")
    again = rendered_statistics(config)
    assert all(torch.equal(learned.state_dict()[name], tensor) for name, tensor in again.state_dict().items())


if __name__ == "__main__":
    import tempfile

    for _ in range(int(sys.argv[1]) if len(sys.argv) > 1 else 10):
        with tempfile.TemporaryDirectory() as scratch:
            together(Path(scratch), 2)
