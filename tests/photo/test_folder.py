"""Folders of photos: which are taken, what is written down, how a run is gone on with, and several processes."""

import csv
import io
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_command import FakeSession, made, photo, run  # noqa: F401 - a fixture
from torch import distributed

from facerelight.cli import main
from facerelight.photo.folder.progress import Progress
from facerelight.photo.folder.share import Share, join_processes


def rows(folder: str = "out") -> list[dict[str, str]]:
    with Path(folder, "manifest.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_folders_inside_are_relit_into_folders_like_them(made: list[FakeSession]) -> None:  # noqa: F811
    for name in ("all/a.png", "all/one/b.png", "all/one/two/b.png", "all/.hidden/c.png"):
        photo(name)
    assert run("all", "--output", "all/out") == 0
    assert sorted(str(path) for path in Path("all/out").rglob("*.png")) == [
        "all/out/a_relit.png",
        "all/out/one/b_relit.png",
        "all/out/one/two/b_relit.png",
    ]
    assert run("all", "--output", "all/out", "--force") == 0  # results are no photos
    assert len(list(Path("all/out").rglob("*.png"))) == 3


def test_the_manifest_says_what_was_done(made: list[FakeSession]) -> None:  # noqa: F811
    photo("in/a.png")
    Path("in/bad.png").write_text("no picture")
    assert run("in", "--output", "out", "--light", "60,20", "--light", "-40,0,size=20") == 1
    good, bad = rows()
    assert (good["status"], good["output"], good["light"]) == (
        "done", "out/a_relit.png", "60,20,size=5,power=1 + -40,0,size=20,power=1",
    )  # fmt: skip
    assert len(json.loads(good["landmarks"])) == 3
    assert (good["source_azimuth"], good["yaw"], good["error"]) == ("12.0", "30.0", "")
    assert "the head is turned" in good["warnings"]
    assert float(good["seconds"]) >= 0
    assert (bad["status"], bad["photo"]) == ("failed", "in/bad.png")
    assert "expected a photo" in bad["error"]


def test_a_run_is_gone_on_with(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    for name in ("in/a.png", "in/b.png", "in/c.png"):
        photo(name)
    assert run("in", "--output", "out") == 0
    Path("out/b_relit.png").unlink()
    before = len(made)
    assert run("in", "--output", "out", "--resume") == 0
    assert len(made) == before + 1
    assert "2 of 3 photos were done before" in capsys.readouterr().err
    later = time.time() + 10
    os.utime("in/c.png", (later, later))  # a photo that changed
    assert run("in", "--output", "out", "--resume") == 0
    assert len(made) == before + 2
    assert run("in", "--output", "out", "--resume", "--azimuth", "30") == 0  # another light
    assert len(made) == before + 5
    assert run("in", "--output", "out") == 2  # nothing is overwritten unasked
    assert run("in/a.png", "--resume") == 2
    assert run("in", "--output", "out", "--workers", "0") == 2


def test_progress_counts_and_says_what_is_left() -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    progress = Progress(2, stream)
    progress.step(False)
    progress.step(True)
    assert progress.line(4.0) == "2 of 2 photos, 1 failed, 0.5 a second, 0:00 left"
    assert stream.getvalue().endswith("left\n")


def test_several_processes_do_the_same(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    astronaut = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    (tmp_path / "in").mkdir()
    for name, mirrored in (("a.png", False), ("b.png", True)):
        pixels = astronaut[:256, 96:352]
        Image.fromarray(np.ascontiguousarray(pixels[:, ::-1] if mirrored else pixels)).save(tmp_path / "in" / name)
    (tmp_path / "in" / "c.jpg").write_bytes(b"\xff\xd8 no more")
    options = ["--azimuth", "50", "--statistics", str(folder), "--json"]
    outcome = {}
    for workers in ("1", "2"):
        out = tmp_path / workers
        assert main(["relight", str(tmp_path / "in"), "--output", str(out), "--workers", workers, *options]) == 1
        said = capsys.readouterr()
        assert "c.jpg: expected" in said.err
        assert len(said.out.splitlines()) == 3
        assert sorted(row["status"] for row in rows(str(out))) == ["done", "done", "failed"]
        outcome[workers] = [np.asarray(Image.open(out / f"{name}_relit.png")) for name in "ab"]
    for one, two in zip(*outcome.values(), strict=True):
        assert np.abs(one.astype(int) - two).max() <= 1


def test_an_interrupted_run_says_how_to_go_on(
    made: list[FakeSession],  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def stopped(self: FakeSession, *_: object, **__: object) -> np.ndarray:
        if len(made) == 2:
            raise KeyboardInterrupt
        return self.pixels

    monkeypatch.setattr(FakeSession, "render", stopped)
    for name in ("in/a.png", "in/b.png", "in/c.png"):
        photo(name)
    assert run("in", "--output", "out") == 130
    assert "--resume goes on" in capsys.readouterr().err
    assert [row["photo"] for row in rows()] == ["in/a.png"]


def test_processes_of_torchrun_share_a_folder(folder: Path, tmp_path: Path) -> None:
    astronaut = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
    (tmp_path / "in").mkdir()
    for name in ("a.png", "b.png"):
        Image.fromarray(np.ascontiguousarray(astronaut[:256, 96:352])).save(tmp_path / "in" / name)
    (tmp_path / "in" / "c.jpg").write_bytes(b"\xff\xd8 no more")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = [sys.executable, "-m", "facerelight.cli", "relight", str(tmp_path / "in"), "--statistics", str(folder)]
    asked = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    running = [
        subprocess.Popen(
            [*words, "--output", str(tmp_path / "out")],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, **asked, "RANK": str(rank)},
        )
        for rank in (0, 1)
    ]
    said = [process.communicate(timeout=300) for process in running]
    assert [process.returncode for process in running] == [1, 0], said  # the first takes a.png and c.jpg
    assert [Path(out.strip()).name for out, _ in said] == ["a_relit.png", "b_relit.png"]
    assert sorted((Path(row["photo"]).name, row["status"]) for row in rows(str(tmp_path / "out"))) == [
        ("a.png", "done"), ("b.png", "done"), ("c.jpg", "failed"),
    ]  # fmt: skip
    assert [path.name for path in (tmp_path / "out").glob("*.csv")] == ["manifest.csv"]


def test_what_other_processes_left_is_known(made: list[FakeSession]) -> None:  # noqa: F811
    for name in ("in/a.png", "in/b.png"):
        photo(name)
    assert run("in", "--output", "out") == 0
    Path("out/manifest.csv").rename("out/manifest.1.csv")  # of a run under torchrun that was interrupted
    before = len(made)
    assert run("in", "--output", "out", "--resume") == 0
    assert len(made) == before
    assert [row["status"] for row in rows()] == ["done", "done"]
    assert not Path("out/manifest.1.csv").exists()


def test_without_torchrun_a_folder_is_done_here(
    made: list[FakeSession],  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("RANK", "MASTER_ADDR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("WORLD_SIZE", "2")  # as a cluster's queue may leave it
    photo("in/a.png")
    photo("in/b.png")
    assert run("in", "--output", "out") == 0
    assert len(made) == 2
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    for size, rank, said in (
        ("two", "0", "WORLD_SIZE: expected a whole number of at least 1"),
        ("2", "first", "RANK: expected a whole number from 0 to 1"),
        ("2", "2", "got '2'"),
    ):
        monkeypatch.setenv("WORLD_SIZE", size)
        monkeypatch.setenv("RANK", rank)
        assert run("in", "--output", "out", "--force") == 2
        assert said in capsys.readouterr().err


def test_a_process_leaves_the_others_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []
    for name, value in {"WORLD_SIZE": "2", "RANK": "1", "MASTER_ADDR": "127.0.0.1"}.items():
        monkeypatch.setenv(name, value)

    def gone() -> None:
        raise RuntimeError("timed out")

    monkeypatch.setattr(distributed, "is_initialized", lambda: False)
    monkeypatch.setattr(distributed, "init_process_group", lambda _, timeout: calls.append(f"{timeout.days} days"))
    monkeypatch.setattr(distributed, "destroy_process_group", lambda: calls.append("left"))
    monkeypatch.setattr(distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(distributed, "get_world_size", lambda: 2)
    monkeypatch.setattr(distributed, "barrier", gone)
    with join_processes() as share, pytest.raises(RuntimeError, match=r"processes: expected all 2 .*--resume goes on"):
        share.wait()
    assert calls == ["0 days", "left"]
    assert share == Share(1, 2)
