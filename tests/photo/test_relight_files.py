"""End to end: photographs relit from the command line and from Python keep what they hold."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from test_files import WIDE

from facerelight.cli import main
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import relight
from facerelight.photo.files.disk import read_photo
from facerelight.photo.files.sixteen_bits import write_png

MARKS = ((202.0, 101.0), (247.0, 103.0), (221.0, 144.0))
TEXT = ",".join(str(v) for point in MARKS for v in point)


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


def run(folder: Path, *arguments: str | Path) -> int:
    return main(["relight", *map(str, arguments), "--statistics", str(folder)])


def unchanged(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return (before == after).reshape(*before.shape[:2], -1).all(axis=2)


def test_sixteen_bits_in_sixteen_bits_out(folder: Path, astronaut: np.ndarray, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, astronaut.shape).astype(np.uint16)
    deep = astronaut.astype(np.uint16) * 256 + noise
    with (tmp_path / "deep.png").open("wb") as file:
        write_png(file, deep, WIDE, None, (300, 300))
    options = ["--landmarks", TEXT, "--light", "-60,20", "--output", tmp_path / "out.png"]
    assert run(folder, tmp_path / "deep.png", *options) == 0
    out = read_photo(tmp_path / "out.png")
    assert out.bits == 16
    assert out.icc == WIDE
    same = unchanged(deep, out.stored)
    assert 0.5 < same.mean() < 1
    assert same[:100, :100].all()  # the flag
    assert len(np.unique(out.stored[~same] % 257)) > 200


def test_profile_and_exif_kept_and_background_to_the_bit(folder: Path, astronaut: np.ndarray, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x010F] = "camera"
    Image.fromarray(astronaut).save(tmp_path / "in.png", icc_profile=WIDE, exif=exif)
    options = ["--landmarks", TEXT, "--azimuth", "60", "--output", tmp_path / "out.png"]
    assert run(folder, tmp_path / "in.png", *options) == 0
    with Image.open(tmp_path / "out.png") as image:
        assert image.info["icc_profile"] == WIDE
        assert image.getexif()[0x010F] == "camera"
        same = unchanged(astronaut, np.asarray(image))
    assert same[:60, :150].all()
    assert not same[110:140, 205:240].all()


def test_pillow_images_are_turned_and_keep_their_mode(folder: Path, astronaut: np.ndarray) -> None:
    relighter = StatisticalRelighter.from_pretrained(folder)
    image = ImageOps.expand(Image.fromarray(astronaut), (0, 0, 40, 0))
    turned = image.transpose(Image.Transpose.ROTATE_90)  # orientation 6 turns it back
    turned.getexif()[0x0112] = 6
    out = relight(turned, 60, 0, MARKS, relighter)
    assert out.size == image.size
    assert out.getexif().get(0x0112, 1) == 1
    assert np.array_equal(np.asarray(out), np.asarray(relight(image, 60, 0, MARKS, relighter)))
    assert relight(image.convert("L"), 60, 0, MARKS, relighter).mode == "L"
    assert relight(image.convert("RGBA"), 60, 0, MARKS, relighter).mode == "RGBA"


def test_report(folder: Path, astronaut: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.fromarray(astronaut).save(tmp_path / "in.png")
    lights, places = ["--azimuth", "10.2", "10.4"], ["--output", tmp_path / "r.png", "--variance", tmp_path / "v.png"]
    assert run(folder, tmp_path / "in.png", *lights, *places, "--json", "--explain") == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert [Path(path).name for path in report["output"]] == ["r_+10.2_+0.0.png", "r_+10.4_+0.0.png", "v.png"]
    assert report["face"]["index"] == 1
    assert set(report["pose"]) == {"yaw", "pitch", "roll"}
    assert all(set(stage) == {"name", "ran", "reason", "seconds"} for stage in report["stages"])
    assert report["stages"][0]["name"] in said.err
    assert np.abs(np.array(report["landmarks"]) - MARKS).max() < 8


@pytest.mark.parametrize(
    "marks",
    ["247,103,202,101,221,144", "202,101,247,103,225,40", "202,101,202,101,221,144", "202,101,247,103,9999,144"],
    ids=["eyes swapped", "mouth in the sky", "one eye", "outside"],
)
def test_landmarks_of_no_face_are_refused(
    marks: str,
    folder: Path,
    astronaut: np.ndarray,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    Image.fromarray(astronaut).save(tmp_path / "in.png")
    assert run(folder, tmp_path / "in.png", "--landmarks", marks, "--output", tmp_path / "out.png") == 2
    said = capsys.readouterr().err
    assert "in.png: landmarks: expected" in said
    assert "--landmarks" in said
    assert not (tmp_path / "out.png").exists()
