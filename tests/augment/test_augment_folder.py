"""``facerelight augment``: a relit training set on disk, in the layout it came in."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from facerelight.augment.folder import relit_copies, training_pictures
from facerelight.augment.random_face_relight import RandomFaceRelight
from facerelight.cli import main


@pytest.fixture(scope="module")
def pictures(crops, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two people, three pictures: grey, colour, and one that is black."""
    folder = tmp_path_factory.mktemp("people")
    faces = (255 * crops(10, 5)[:, 0] ** (1 / 2.2)).byte().numpy()
    for place in ("ann", "bob/more"):
        (folder / place).mkdir(parents=True)
    Image.fromarray(faces[0]).save(folder / "ann" / "one.png")
    Image.fromarray(np.repeat(faces[1][..., None], 3, 2)).save(folder / "bob" / "more" / "two.jpg", quality=95)
    Image.new("RGB", (112, 112)).save(folder / "bob" / "black.png")
    return folder


@pytest.fixture(autouse=True)
def _coarse(quick, monkeypatch):
    """The model is made once."""
    monkeypatch.setattr("facerelight.augment.quick.QuickRelighter", lambda relighter: quick)


def run(pictures: Path, output: Path, *more: str) -> int:
    arguments = ["augment", str(pictures), "--output", str(output), "--copies", "2", "--frame", "arcface112"]
    return main([*arguments, *more])


def rows(output: Path) -> list[dict[str, str]]:
    with (output / "manifest.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_training_set_is_written_again(pictures, tmp_path, capsys):
    assert run(pictures, tmp_path / "out", "--azimuth", "40", "70", "--json") == 1  # the black one was left out
    said = capsys.readouterr()
    assert json.loads(said.out) == {"output": str(tmp_path / "out"), "original": 3, "relit": 4, "left_out": 1}
    assert "black.png: expected a lit face" in said.err
    names = {path.relative_to(tmp_path / "out").as_posix() for path in training_pictures(tmp_path / "out")}
    copies = {"ann/one_00.png", "ann/one_01.png", "bob/more/two_00.jpg", "bob/more/two_01.jpg"}
    assert names == copies | {"ann/one.png", "bob/more/two.jpg", "bob/black.png"}
    for path in training_pictures(pictures):
        assert (tmp_path / "out" / path.relative_to(pictures)).read_bytes() == path.read_bytes()
    relit = np.array(Image.open(tmp_path / "out" / "ann" / "one_00.png"))
    assert relit.shape == (112, 112)  # grey stays grey
    assert relit[40:100, 30:50].mean() > 1.2 * relit[40:100, 62:82].mean()
    table = rows(tmp_path / "out")
    assert {row["output"] for row in table if row["status"] == "relit"} == copies
    assert all(40 <= float(row["azimuth"]) <= 70 for row in table if row["status"] == "relit")


def test_lamps_are_those_of_the_seed_and_nothing_is_overwritten(pictures, tmp_path):
    outs = [tmp_path / name for name in ("first", "second", "other")]
    for out, seed in zip(outs, ("3", "3", "4"), strict=True):
        run(pictures, out, "--seed", seed)
    assert rows(outs[0]) == rows(outs[1]) != rows(outs[2])
    relit = [(out / "ann" / "one_01.png").read_bytes() for out in outs]
    assert relit[0] == relit[1] != relit[2]
    assert run(pictures, outs[0]) == 2
    assert run(pictures, outs[0], "--force") == 1


@pytest.mark.parametrize("name", ["ann/one.png", "bob/more/two_01.jpg", "manifest.csv"])
def test_neither_pictures_nor_copies_nor_the_manifest_are_overwritten(pictures, tmp_path, capsys, name):
    there = tmp_path / name
    there.parent.mkdir(parents=True, exist_ok=True)
    there.write_bytes(b"mine")
    assert run(pictures, tmp_path) == 2
    assert f"{there}: exists already; --force" in capsys.readouterr().err
    assert there.read_bytes() == b"mine"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [there]


def test_copies_are_relit_a_few_at_a_time(crops, quick, monkeypatch):
    pixels = (255 * crops(10, 5)[0] ** (1 / 2.2)).byte().expand(3, -1, -1).permute(1, 2, 0).contiguous().numpy()
    relight, sizes = RandomFaceRelight(relighter=quick, p=1.0), []
    relight.register_forward_pre_hook(lambda _, given: sizes.append(len(given[0])))
    together = relit_copies(pixels, 5, relight, None, (3, 1))
    monkeypatch.setattr("facerelight.augment.folder.PIXELS_AT_ONCE", 2 * 112 * 112 + 5)
    apart = relit_copies(pixels, 5, relight, None, (3, 1))
    assert sizes == [5, 2, 2, 1]
    for (one, lamp), (other, same) in zip(together, apart, strict=True):
        assert lamp == same
        assert np.abs(one.astype(int) - other).max() <= 1  # sums of a batch are rounded in another order


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--copies", "0"), "copies: expected at least 1, got 0"),
        (("--seed", "-1"), "seed: expected 0 or more, got -1"),
        (("--frame", "1,2,3"), "landmarks: expected six numbers"),
        (("--elevation", "20", "10"), "elevation: expected two numbers"),
    ],
)
def test_options_that_are_none(pictures, tmp_path, capsys, more, said):
    assert run(pictures, tmp_path / "out", *more) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_places_that_are_none(pictures, tmp_path, capsys):
    assert run(pictures, pictures / "out") == 2
    assert "expected a place outside" in capsys.readouterr().err
    assert run(tmp_path / "nothing", tmp_path / "out") == 2
    (tmp_path / "clash").mkdir()
    for name in ("one.png", "one_01.png"):
        Image.new("L", (40, 40), 90).save(tmp_path / "clash" / name)
    assert run(tmp_path / "clash", tmp_path / "out") == 2
    assert "one_01.png: is a picture and a copy" in capsys.readouterr().err
