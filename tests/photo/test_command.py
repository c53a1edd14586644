"""``facerelight relight``: options, files checked before the work, several faces and photos, what failure says."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from PIL import Image

import facerelight.photo
import facerelight.photo.faces.landmarks as landmarks_module
import facerelight.photo.session as session_module
from facerelight.cli import main
from facerelight.config import QUALITIES as CONFIGS
from facerelight.geometry.sources import Lamp
from facerelight.inference.methods import RELIGHTING_METHODS
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import command
from facerelight.photo.faces.landmarks import Face, LandmarksNotFoundError
from facerelight.photo.files.disk import read_photo
from facerelight.photo.scenes import Scene, join_values, parse_lamp, parse_scenes, scene_paths
from facerelight.recognition.gallery.command import QUALITIES

MARKS = "20,24,44,24,32,44"


class Pose(NamedTuple):
    yaw: float
    pitch: float
    roll: float


class Stage(NamedTuple):
    name: str
    ran: bool
    reason: str
    seconds: float


class FakeSession:
    """Adds one grey level to the face's box for every render; remembers how it was made."""

    made: list["FakeSession"] = []  # noqa: RUF012

    def __init__(self, pixels, landmarks, relighter, source_light=None, more=(), method="expected", face=None) -> None:
        if landmarks is not None and landmarks[0][0] > landmarks[1][0]:
            raise ValueError("landmarks: expected the eye at image-left first, got the eyes swapped")
        self.pixels, self.source_light, self.more, self.face = pixels, source_light, more, face
        self.landmarks = torch.tensor(landmarks if face is None else face.landmarks)
        self.pose, self.source_angles = Pose(30.0, 0.0, 1.0), (12.0, 3.0)
        self.stages = [Stage("matte", True, "one face", 0.5), Stage("bust", False, "too small", 0.0)]
        self.warnings = ["the head is turned by 30 degrees"]
        self.rendered: list[tuple] = []
        FakeSession.made.append(self)

    def render(self, lamps, fill=0.1, strength=1.0) -> np.ndarray:
        self.rendered.append((lamps, fill, strength))
        x0, y0, x1, y1 = (int(v) for v in (self.face.box if self.face else (20, 20, 44, 44)))
        out = self.pixels.copy()
        out[y0:y1, x0:x1] += 1
        return out

    def std(self, azimuth: float, elevation: float) -> np.ndarray:
        return np.ones(self.pixels.shape[:2], np.float32)


def face(x0: float, size: float, whole: bool = True) -> Face:
    points = np.array(((0.3, 0.4), (0.7, 0.4), (0.5, 0.8))) * size + (x0, 10)
    return Face(points, None, (x0, 10, x0 + size, 10 + size), 0.9, None, whole, 0.9)


@pytest.fixture
def made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[FakeSession]:
    """The sessions that were made; statistics, faces and the session are stand-ins, the working directory is empty."""
    FakeSession.made = []
    monkeypatch.setattr(session_module, "PhotoRelighter", FakeSession)
    monkeypatch.setattr(StatisticalRelighter, "from_pretrained", lambda *_: None)
    monkeypatch.setattr(landmarks_module, "find_faces", lambda photo: [face(5, 30), face(40, 15), face(0, 50, False)])
    monkeypatch.chdir(tmp_path)
    return FakeSession.made


def photo(name: str, size: tuple[int, int] = (64, 64), value: int = 100) -> str:
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((*size, 3), value, np.uint8)).save(name)
    return name


def run(*arguments: str) -> int:
    return main(["relight", *arguments, "--statistics", "unused"])


def test_choices_are_those_of_the_package() -> None:
    assert tuple(CONFIGS) == command.QUALITIES == QUALITIES
    assert command.RELIGHTING_METHODS == RELIGHTING_METHODS


def test_lamps_from_text() -> None:
    assert parse_lamp("-45,30") == Lamp(-45, 30)
    assert parse_lamp("45,30,size=15,power=.8") == Lamp(45, 30, 15, 0.8)
    red = parse_lamp("0,0,color=#ff8000").colour
    assert red == pytest.approx((1.0, 0.21586, 0.0), abs=1e-4)
    assert parse_lamp("0,0,colour=f80").colour == pytest.approx(parse_lamp("0,0,colour=ff8800").colour)
    bad = ("", "45", "45,x", "1,2,3", "45,30,glow=1", "45,30,size=", "45,30,colour=red", "400,0", "0,91", "nan,0")
    for text in bad:
        with pytest.raises(ValueError, match="light"):
            parse_lamp(text)
    assert join_values(["--light", "-45,30", "--json", "--light", "-.5,0", "--landmarks", "-1,2"]) == [
        "--light=-45,30",
        "--json",
        "--light=-.5,0",
        "--landmarks=-1,2",
    ]


def test_file_names_tell_lights_apart() -> None:
    def names(*lights: tuple[float, float]) -> list[str]:
        return [path.stem for path in scene_paths(Path("r.png"), [Scene((), *light) for light in lights])]

    assert names((-60, 20), (60, 20)) == ["r_-60_+20", "r_+60_+20"]
    assert names((10.2, 0), (10.4, 0)) == ["r_+10.2_+0.0", "r_+10.4_+0.0"]
    assert names((-0.2, 0), (0.2, 0)) == ["r_-0.2_+0.0", "r_+0.2_+0.0"]
    assert names((10.2, 0)) == ["r"]
    with pytest.raises(ValueError, match="twice"):
        parse_scenes([], [10, 10], None)
    with pytest.raises(ValueError, match="both"):
        parse_scenes(["0,0"], [10], None)


def test_two_lights_two_files(made: list[FakeSession]) -> None:
    assert run(photo("a.png"), "--azimuth", "10.2", "10.4", "--output", "r.png") == 0
    assert sorted(path.name for path in Path().glob("r*")) == ["r_+10.2_+0.0.png", "r_+10.4_+0.0.png"]
    assert len(made) == 1


def test_light_options_reach_the_session(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    lamps = ["--light", "-45,30", "--light", "120,0,power=.5,colour=ffd0a0", "--size", "9"]
    assert run(photo("a.png"), *lamps, "--fill", "0.3", "--strength", ".5", "--source-light", "-20,10") == 0
    (both, fill, strength), session = made[0].rendered[0], made[0]
    assert [(lamp.azimuth, lamp.size, lamp.power) for lamp in both] == [(-45, 9, 1), (120, 9, 0.5)]
    assert (fill, strength) == (0.3, 0.5)
    assert session.source_light.shape == (3,)
    assert float(session.source_light[0]) * float(session.source_light[1]) != 0
    assert "a.png: azimuth 120: the lamp stands behind the face" in capsys.readouterr().err
    assert Path("relit.png").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--azimuth", "400"], "azimuth: expected degrees in [-180, 180]"),
        (["--azimuth", "nan"], "azimuth"),
        (["--elevation", "91"], "elevation: expected degrees in [-90, 90]"),
        (["--light", "0,0", "--azimuth", "3"], "--light"),
        (["--fill", "2"], "fill: expected"),
        (["--strength", "nan"], "strength: expected"),
        (["--source-light", "north"], "source-light: expected"),
        (["--face", "none"], "expected largest, all or a number"),
        (["--face", "0"], "expected largest, all or a number"),
        (["--face", "7"], "a.png: face: expected a number up to 3"),
        (["--face", "2", "--landmarks", MARKS], "both"),
        (["--landmarks", "1,2,3"], "landmarks: expected six numbers"),
        (["--landmarks", "44,24,20,24,32,44"], "a.png: landmarks: expected the eye at image-left first"),
        (["--output", "relit.xyz"], "image file name"),
        (["--output", "a.png/relit.png"], "folder"),
        (["--variance", "relit.png"], "relit.png: expected a file for every result"),
        (["--variance", "map.xyz"], "image file name"),
    ],
)
def test_bad_options(
    options: list[str],
    words: str,
    made: list[FakeSession],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(photo("a.png"), *options) == 2
    said = capsys.readouterr()
    assert words in said.err
    assert "Traceback" not in said.err
    assert [path.name for path in Path().iterdir()] == ["a.png"]


@pytest.mark.parametrize("missing", ["nosuch", "nosuch.png"])
def test_what_is_not_there_is_named_before_its_output(
    missing: str, made: list[FakeSession], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(missing, "-o", "folder") == 2
    assert capsys.readouterr().err.strip().endswith(f"{missing}: No such file or directory")
    assert not list(Path().iterdir())


def test_nothing_is_overwritten_without_a_word(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    photo("relit.png")
    before = Path("relit.png").read_bytes()
    for arguments in (
        [photo("a.png")],
        ["relit.png"],
        ["a.png", "--output", "a.png"],
        ["a.png", "--output", "b.png", "--variance", "relit.png"],
    ):
        assert run(*arguments) == 2
        assert "--force" in capsys.readouterr().err
    assert not made
    assert Path("relit.png").read_bytes() == before
    assert not Path("b.png").exists()
    photo("a_relit.png")
    assert run("a.png", "a_relit.png", "--output", ".", "--force") == 2  # one would be read after it was overwritten
    assert "a_relit.png: is itself a photo" in capsys.readouterr().err
    assert run("a.png", "--force") == 0
    assert Path("relit.png").read_bytes() != before


def test_one_face_of_several(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(photo("a.png"), "--json") == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["face"] == {"index": 1, "count": 3}
    assert "a.png: face 1 of 3" in said.err
    assert "a.png: the head is turned by 30 degrees" in said.err
    assert report["warnings"] == ["the head is turned by 30 degrees"]
    assert report["pose"] == {"yaw": 30.0, "pitch": 0.0, "roll": 1.0}
    assert report["source_light"] == {"azimuth": 12.0, "elevation": 3.0}
    assert [stage["name"] for stage in report["stages"]] == ["read", "statistics", "find", "matte", "bust"]
    assert report["stages"][3] == {"name": "matte", "ran": True, "reason": "one face", "seconds": 0.5}
    assert report["photo"] == "a.png"
    assert report["output"] == ["relit.png"]
    assert report["seconds"] >= 0
    assert run("a.png", "--face", "2", "--json", "--force") == 0
    assert json.loads(capsys.readouterr().out)["face"]["index"] == 2
    assert made[-1].face.box[0] == 40
    assert run("a.png", "--landmarks", MARKS, "--json", "--force") == 0
    assert json.loads(capsys.readouterr().out)["face"] is None


def test_all_faces_one_after_the_other(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(photo("a.png"), "--face", "all", "--azimuth", "-30", "30", "--json") == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert [one["index"] for one in report["faces"]] == [1, 2]
    for name in report["output"]:
        out = read_photo(name).pixels
        assert out[20, 10, 0] == out[20, 45, 0] == 101
        assert out[60, 60, 0] == 100
    assert "face 1 and 2 of 3" in said.err
    assert "border cuts the others" in said.err
    assert len(made) == 3  # the first face's session serves every light


def test_explain(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(photo("a.png"), "--explain") == 0
    said = capsys.readouterr()
    assert "matte" in said.err
    assert "0.50 s  one face" in said.err
    assert "not run  too small" in said.err
    assert said.out == "relit.png\n"


def test_no_face_is_exit_1(
    made: list[FakeSession],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(landmarks_module, "find_faces", lambda photo: [])
    assert run(photo("sky.png")) == 1
    said = capsys.readouterr().err
    assert "sky.png: found no face" in said
    assert "--landmarks" in said
    assert run(photo("b.png"), photo("c.png")) == 1


def test_other_failures_do_not_read_as_nothing_found(
    made: list[FakeSession],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise RuntimeError("Caught RuntimeError.\nOriginal Traceback (most recent call last):\nRuntimeError: no GL")

    monkeypatch.setattr(FakeSession, "render", fails)
    assert run(photo("a.png")) == 3
    assert capsys.readouterr().err.splitlines()[-1] == "facerelight: no GL"


def test_several_photos_are_a_batch(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    people = [photo("a.png"), photo("b.tif"), photo("c.bmp")]
    assert run(*people, "--output", "out", "--azimuth", "-30", "30") == 0
    names = ["a_relit_{}_+0.png", "b_relit_{}_+0.tif", "c_relit_{}_+0.bmp"]
    expected = [name.format(light) for name in names for light in ("+30", "-30")]
    assert sorted(path.name for path in Path("out").iterdir()) == [*expected, "manifest.csv"]
    assert all(len(session.more) == 0 for session in made)
    assert run(*people, "--output", "out.png") == 2
    said = capsys.readouterr().err
    assert "a.png, b.tif, c.bmp" in said
    assert "--same-person" in said
    assert run(*people, "--landmarks", MARKS) == 2
    assert run(*people, "--variance", "v.png") == 2


def test_a_folder_is_a_batch(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    photo("people/one.png")
    photo("people/two.JPG")
    Path("people/notes.txt").write_text("")
    assert run("people", "--json") == 0
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [one["photo"] for one in reports] == ["people/one.png", "people/two.JPG"]
    assert sorted(path.name for path in Path("relit").iterdir()) == ["manifest.csv", "one_relit.png", "two_relit.JPG"]
    Path("empty").mkdir()
    assert run("empty") == 2
    photo("other/one.png")
    assert run("people", "other", "--output", "elsewhere") == 2
    assert not Path("elsewhere").exists()


def test_one_bad_photo_does_not_end_the_batch(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    Path("bad.png").write_text("no picture")
    assert run("bad.png", photo("good.png"), "nowhere.png", "--json") == 1
    said = capsys.readouterr()
    assert "bad.png: expected a photo" in said.err
    assert "nowhere.png: expected" in said.err
    assert "2 of 3 photos" in said.err
    failed = [one["photo"] for one in map(json.loads, said.out.splitlines()) if "error" in one]
    assert failed == ["bad.png", "nowhere.png"]
    assert sorted(path.name for path in Path("relit").iterdir()) == ["good_relit.png", "manifest.csv"]
    assert run("bad.png", "nowhere.png", "--output", "x") == 2


def test_same_person_is_said(
    made: list[FakeSession],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(photo("a.png"), photo("b.png"), "--same-person") == 0
    assert len(made) == 1
    assert len(made[0].more) == 1
    assert Path("relit.png").exists()
    monkeypatch.setattr(landmarks_module, "find_faces", lambda pixels: [] if pixels[0, 0, 0] == 7 else [face(5, 30)])
    assert run("a.png", photo("sky.png", value=7), "--same-person", "--force") == 1
    assert "found no face in sky.png; leave it out" in capsys.readouterr().err


def test_a_picture_that_did_not_change_is_said(
    made: list[FakeSession],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(FakeSession, "render", lambda self, *_, **__: self.pixels)
    assert run(photo("a.png")) == 0
    assert "a.png: relit.png: nothing was changed" in capsys.readouterr().err
    assert run("a.png", "--strength", "0", "--force") == 0
    assert "nothing was changed" not in capsys.readouterr().err


def test_what_the_format_cannot_hold_is_said(made: list[FakeSession], capsys: pytest.CaptureFixture[str]) -> None:
    Image.fromarray(np.full((64, 64, 4), 90, np.uint8)).save("a.png")
    assert run("a.png", "--output", "r.jpg") == 0
    assert "a.png: r.jpg: JPEG holds no transparency: the photo is laid over white" in capsys.readouterr().err


def test_every_verb_finds_nothing_with_1(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, folder: Path) -> None:
    def none(*_: object) -> None:
        raise LandmarksNotFoundError("landmarks: found no face")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("facerelight.photo.session.find_landmarks", none, raising=False)
    monkeypatch.setattr(landmarks_module, "find_faces", lambda _: [])
    photo("people/sky.png")
    assert main(["relight", "people/sky.png", "--statistics", str(folder)]) == 1


def command_line(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-X", "importtime", "-m", "facerelight.cli", *arguments]
    return subprocess.run(line, capture_output=True, text=True, env={**os.environ, **environment}, check=False)


@pytest.mark.parametrize("verb", [[], ["relight"], ["recognize"]])
def test_help_is_plain_and_needs_no_torch(verb: list[str]) -> None:
    done = command_line(*verb, "--help", COLUMNS="120")
    assert done.returncode == 0
    assert "<function" not in done.stdout
    assert "locals" not in done.stdout
    assert "torch" not in done.stderr


def test_help_of_training() -> None:
    assert "<function" not in command_line("train", "--help").stdout


def test_without_egl_one_line(tmp_path: Path) -> None:
    arguments = ["train", "--heads", "2", "--workers", "0", "--output", str(tmp_path)]
    done = command_line(*arguments, PYOPENGL_PLATFORM="nonsense")
    assert done.returncode == 3
    said = [line for line in done.stderr.splitlines() if not line.startswith("import time")]
    assert len(said) == 1
    assert "EGL" in said[0]


def test_public_names_are_imported_when_asked_for() -> None:
    for name in facerelight.__all__:
        assert getattr(facerelight, name).__module__.startswith("facerelight.")
    for name in facerelight.photo.__all__:
        assert getattr(facerelight.photo, name).__module__.startswith("facerelight.")
    assert set(facerelight.__all__) <= set(dir(facerelight))
    with pytest.raises(AttributeError, match="no attribute"):
        _ = facerelight.nothing


def test_earlier_results_are_no_photos(made: list[FakeSession], tmp_path: Path) -> None:
    """A folder that holds results of an earlier run beside their photos is relit as it was then."""
    folder = tmp_path / "mine"
    folder.mkdir()
    for name in ("a.png", "b.png", "b_relit.png", "alone_relit.png"):
        photo(str(folder / name))
    assert run(str(folder), "--output", str(folder), "--force") == 0
    assert sorted(path.name for path in folder.iterdir()) == [
        "a.png",
        "a_relit.png",
        "alone_relit.png",
        "alone_relit_relit.png",
        "b.png",
        "b_relit.png",
        "manifest.csv",
    ]
