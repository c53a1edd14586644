"""``facerelight recognize``, from folders and group photos to exit codes."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from facerelight.cli import main
from facerelight.recognition.sface import sface_weights

CLASSIFIERS = ["individual_pca", *(["sface"] if sface_weights() else [])]


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


@pytest.fixture(scope="module")
def folder(astronaut: np.ndarray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``people``: a woman, and her narrowed mirror image as somebody else, beside photos that cannot be used;
    ``group.png``, both of them; ``probes``: a darker copy, and no face."""
    place = tmp_path_factory.mktemp("recognize")
    narrow = cv2.resize(astronaut[:, ::-1], (368, 512), interpolation=cv2.INTER_AREA)
    (place / "people" / "eileen").mkdir(parents=True)
    (place / "probes").mkdir()
    Image.fromarray(astronaut).save(place / "people" / "eileen" / "1.png")
    Image.fromarray(np.full((90, 90, 3), 120, np.uint8)).save(place / "people" / "eileen" / "wall.png")
    (place / "people" / "broken.jpg").write_bytes(b"no photo")
    Image.fromarray(narrow).save(place / "people" / "narrow.png")
    Image.fromarray(np.hstack((narrow[:300], astronaut[:300]))).save(place / "group.png")
    Image.fromarray((astronaut * 0.7).astype(np.uint8)).save(place / "probes" / "darker.png")
    Image.fromarray(np.full((90, 90, 3), 120, np.uint8)).save(place / "probes" / "wall.png")
    return place


@pytest.mark.parametrize("classifier", CLASSIFIERS)
def test_enroll_list_identify_remove(classifier: str, folder: Path, tmp_path: Path, capsys) -> None:
    gallery = str(tmp_path / "g.safetensors")
    command = ["recognize", gallery]
    assert main([*command, "--enroll", str(folder / "people"), "--classifier", classifier]) == 1  # two were skipped
    said = capsys.readouterr().err
    assert "wall.png: skipped: found no face" in said
    assert "broken.jpg: skipped: expected a photo" in said
    assert f"2 people from 2 photos, {classifier}" in said
    assert main([*command, "--enroll", str(folder / "people")]) == 2
    assert "is there already; --add" in capsys.readouterr().err
    table = tmp_path / "answers.csv"
    asked = [*command, "--photos", str(folder / "probes"), "--json", "--csv", str(table), "--far", "0.2", "--top", "2"]
    assert main(asked) == 1  # the wall
    told = json.loads(capsys.readouterr().out)
    assert told["enrolled"] == {"eileen": 1, "narrow": 1}
    assert list(told["skipped"]) == [str(folder / "probes" / "wall.png")]
    answer = told["answers"][str(folder / "probes" / "darker.png")][0]
    assert answer["matches"][0]["name"] == "eileen"
    assert 0 <= answer["matches"][1]["probability"] <= answer["matches"][0]["probability"] <= 1
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert [row["person"] for row in rows] == [match["name"] for match in answer["matches"]]
    assert [row["rank"] for row in rows] == ["1", "2"]
    assert main([*command, "--photos", str(folder / "people" / "broken.jpg"), str(tmp_path / "none.png")]) == 2
    assert main([*command, "--photos", str(folder / "people" / "broken.jpg"), str(folder / "group.png")]) == 1
    capsys.readouterr()
    assert main([*command, "--remove", "eileen", "--list"]) == 0
    assert capsys.readouterr().out == "narrow: 1 photo\n"
    assert main([*command, "--remove", "eileen"]) == 2
    assert "expected one of the 1 people enrolled" in capsys.readouterr().err


@pytest.mark.parametrize("classifier", CLASSIFIERS)
def test_every_face_of_a_group(classifier: str, folder: Path, tmp_path: Path, capsys) -> None:
    command = ["recognize", str(tmp_path / "g.safetensors")]
    group = str(folder / "group.png")
    assert main([*command, "--enroll", group, "--names", "one", "--classifier", classifier]) == 2
    assert "expected one for each of 2 faces" in capsys.readouterr().err
    assert main([*command, "--enroll", group, "--names", "left", "right", "--classifier", classifier]) == 0
    assert main([*command, "--photos", group, "--json", "--far", "0.3"]) in (0, 1)
    faces = json.loads(capsys.readouterr().out)["answers"][group]
    by_place = sorted(faces, key=lambda face: face["box"][0])
    assert [face["matches"][0]["name"] for face in by_place] == ["left", "right"]
    assert main([*command, "--enroll", group, "--add"]) == 0
    assert main([*command, "--list"]) == 0
    assert [line.split(":")[0] for line in capsys.readouterr().out.splitlines()] == [
        "group-1",
        "group-2",
        "left",
        "right",
    ]


def test_what_cannot_be_asked(folder: Path, tmp_path: Path, capsys) -> None:
    command = ["recognize", str(tmp_path / "g.safetensors")]
    for wrong, why in (
        ([], "expected --enroll PLACE, --photos"),
        (["--list"], "expected a gallery, got No such file"),
        (["--enroll", str(tmp_path / "nobody")], "nobody"),
        (["--enroll", str(folder / "people"), "--far", "2"], "false accept rate"),
        (["--list", "--force"], "with --add, --force or --names"),
        (["--enroll", str(folder / "probes" / "wall.png"), "--top", "0"], "at least 1 person"),
        (["--enroll", str(folder / "people"), "--names", "a", "--classifier", "individual_pca"], "with one photo"),
    ):
        assert main([*command, *wrong]) == 2, wrong
        said = capsys.readouterr().err
        assert why in said
        assert "Errno" not in said
    assert main([*command, "--enroll", str(folder / "probes" / "wall.png"), "--classifier", "individual_pca"]) == 1
    assert "found no face" in capsys.readouterr().err


def test_strangers_have_a_name_of_ones_choice(folder: Path, tmp_path: Path, capsys) -> None:
    command = ["recognize", str(tmp_path / "g.safetensors")]
    group = str(folder / "group.png")
    assert main([*command, "--enroll", group, "--names", "a", "b", "--classifier", "individual_pca"]) == 0
    capsys.readouterr()
    assert main([*command, "--photos", group, "--far", "1e-12", "--unknown", "who?"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert all(": who? (" in line for line in lines)
    assert main([*command, "--photos", group, "--classifier", "sface"]) == 2
    assert "one of individual_pca" in capsys.readouterr().err
