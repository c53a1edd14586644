import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from facerelight.cli import main
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.soft import fit_soft_light
from facerelight.photo import PhotoRelighter, relight
from facerelight.photo.faces.landmarks import LandmarksNotFoundError, find_landmarks
from facerelight.photo.files.disk import read_photo, write_photo

CONFIG = Path(__file__).parents[2] / "configs" / "tiny.yaml"
MARKS = ((202.0, 101.0), (247.0, 103.0), (221.0, 144.0))


@pytest.fixture(scope="module")
def astronaut() -> np.ndarray:
    return pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()


def test_relight_lights_the_right_side_and_nothing_else(folder: Path, astronaut: np.ndarray) -> None:
    """The whole person goes with the light, cheeks and shoulders; the background stays exactly as it was."""
    relighter = StatisticalRelighter.from_pretrained(folder)
    session = PhotoRelighter(astronaut, MARKS, relighter)
    pictures = [session.render(azimuth, 0) for azimuth in (60, -60)]
    left, right = (picture.astype(float).mean(2) for picture in pictures)
    cheek_left, cheek_right = (slice(115, 130), slice(198, 208)), (slice(115, 130), slice(236, 246))
    assert left[cheek_left].mean() > 1.2 * left[cheek_right].mean()
    assert right[cheek_right].mean() > 1.2 * right[cheek_left].mean()
    person, background = session.matte > 0.9, session.matte == 0
    shoulder_left, shoulder_right = (slice(240, 330), slice(60, 150)), (slice(240, 330), slice(310, 400))
    assert (left - right)[shoulder_left][person[shoulder_left]].mean() > 10
    assert (right - left)[shoulder_right][person[shoulder_right]].mean() > 10
    assert background.mean() > 0.3
    for picture in pictures:
        assert np.array_equal(picture[background], astronaut[background])
        assert (picture != astronaut).any(2)[person].mean() > 0.9
    assert session.std(60, 0).max() > 0


def test_relight_keeps_the_type(folder: Path, astronaut: np.ndarray) -> None:
    relighter = StatisticalRelighter.from_pretrained(folder)
    before = astronaut.copy()
    array = relight(astronaut, 30, 10, MARKS, relighter)
    image = relight(Image.fromarray(astronaut), 30, 10, MARKS, relighter)
    assert isinstance(array, np.ndarray)
    assert isinstance(image, Image.Image)
    assert np.array_equal(array, np.asarray(image))
    assert np.array_equal(before, astronaut)


@pytest.mark.parametrize("kind", ["noise", "jpeg"])
def test_nearly_the_same_photo_again_changes_little(astronaut: np.ndarray, kind: str) -> None:
    """The face moves by at most two grey levels RMS, which is what a compressed photo alone would do."""
    noise = np.random.default_rng(0).normal(0, 1, astronaut.shape).round()
    again = {
        "noise": (astronaut + noise).clip(0, 255).astype(np.uint8),
        "jpeg": cv2.imdecode(cv2.imencode(".jpg", astronaut, (cv2.IMWRITE_JPEG_QUALITY, 75))[1], cv2.IMREAD_COLOR),
    }[kind]
    lights = light_from_angles(torch.tensor([51.0, -52.0, 0.0]), torch.tensor([6.0, 12.0, 30.0])).float()
    models = [PhotoRelighter(astronaut, more=more).model for more in ((), (again,))]
    once, twice = (model.exposure * model.crops(lights) for model in models)
    assert (once - twice).square().mean().sqrt() < 2 / 255


def test_black_photo_stays_finite(folder: Path) -> None:
    relighter = StatisticalRelighter.from_pretrained(folder)
    out = relight(np.zeros((256, 256, 3), np.uint8), 30, 0, ((90, 100), (160, 100), (125, 170)), relighter)
    assert out.shape == (256, 256, 3)


def test_landmarks_of_a_real_photo(astronaut: np.ndarray) -> None:
    found = find_landmarks(astronaut, "haar")
    assert (found - torch.tensor(MARKS, dtype=torch.float64)).abs().max() < 6
    with pytest.raises(LandmarksNotFoundError, match="by hand"):
        find_landmarks(np.zeros((200, 200, 3), np.uint8), "haar")


@pytest.mark.parametrize(
    ("marks", "words"),
    [
        ([(1, 2), (3, 4)], "three"),
        ([(-50, 2), (30, 4), (10, 50)], "inside"),
        ([(10, 10), (10, 10), (30, 40)], "two different eyes"),
        ([(10, 10), (20, 20), (30, 30)], "collinear"),
    ],
)
def test_bad_landmarks(folder: Path, marks: list[tuple[float, float]], words: str) -> None:
    relighter = StatisticalRelighter.from_pretrained(folder)
    with pytest.raises(ValueError, match=words):
        relight(np.zeros((64, 64, 3), np.uint8), landmarks=marks, relighter=relighter)


def test_soft_light_is_a_mixture() -> None:
    basis = torch.rand(6, 12, 10, generator=torch.Generator().manual_seed(0)) ** 3
    amounts = torch.tensor([0.0, 0.5, 0.0, 0.0, 1.2, 0.0])
    found = fit_soft_light(basis, torch.tensordot(amounts, basis, 1), torch.ones(12, 10), steps=5000)
    assert torch.allclose(found, amounts, atol=0.02)
    assert fit_soft_light(basis, torch.zeros(12, 10), torch.ones(12, 10)).sum() < 1e-6


def test_command_line(folder: Path, astronaut: np.ndarray, tmp_path, capsys) -> None:
    photo = tmp_path / "phöto.png"
    Image.fromarray(astronaut).save(photo)
    out = tmp_path / "relit.jpg"
    marks = ",".join(str(v) for point in MARKS for v in point)
    common = ["relight", str(photo), "--statistics", str(folder), "--landmarks", marks]
    code = main(
        [
            *common,
            "--azimuth",
            "-60",
            "60",
            "--elevation",
            "20",
            "--output",
            str(out),
            "--variance",
            str(tmp_path / "v.png"),
            "--json",
        ]
    )
    assert code == 0
    report = json.loads(capsys.readouterr().out)
    assert [Path(p).name for p in report["output"]] == ["relit_-60_+20.jpg", "relit_+60_+20.jpg", "v.png"]
    assert all(Path(p).exists() for p in report["output"])


def test_methods_from_the_command_line(folder: Path, astronaut: np.ndarray, tmp_path, capsys) -> None:
    """The most probable image; n without a prior from four photos, and refused from one; further photos as evidence."""
    relighter = StatisticalRelighter.from_pretrained(folder)
    photos = [tmp_path / f"{azimuth}.png" for azimuth in (0, 50, -50)]
    for path, light in zip(photos, ((0, 0), (50, 0), (-50, 0)), strict=True):
        Image.fromarray(relight(astronaut, *light, MARKS, relighter)).save(path)
    above = tmp_path / "above.png"
    Image.fromarray(relight(astronaut, 0, 45, MARKS, relighter)).save(above)
    everybody = [str(path) for path in (*photos, above)]
    marks = ",".join(str(v) for point in MARKS for v in point)
    common = ["--statistics", str(folder), "--landmarks", marks, "--azimuth", "30", "--json", "--output"]
    results = {}
    for name, paths in (
        ("expected", everybody[:1]),
        ("map", everybody[:1]),
        ("mle", everybody),
        ("evidence", everybody[:2]),
    ):
        method = "expected" if name == "evidence" else name
        assert (
            main(["relight", *paths, "--same-person", "--method", method, *common, str(tmp_path / f"{name}.png")]) == 0
        )
        assert json.loads(capsys.readouterr().out)["method"] == method
        results[name] = read_photo(tmp_path / f"{name}.png").rgb
    for name in ("map", "mle", "evidence"):
        difference = np.abs(results[name] - results["expected"]).mean()
        assert 0 < difference < 0.1
    assert main(["relight", *everybody[:2], "--same-person", "--method", "mle", *common, str(tmp_path / "no.png")]) == 2
    assert "expected at least 3 input images" in capsys.readouterr().err
    assert main(["relight", *everybody[:1], "--method", "best", *common, str(tmp_path / "no.png")]) == 2
    assert not (tmp_path / "no.png").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["relight", "nowhere.png"],
        ["relight"],
        ["relight", "x.png", "--azimuth", "left"],
        ["train", "--heads", "1"],
        ["train", "--config", "nowhere.yaml"],
        ["train", "--source", "nowhere"],
        ["dance"],
    ],
)
def test_bad_command_lines_exit_with_2(arguments: list[str], capsys, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("FACERELIGHT_CACHE", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_training_goes_on_where_it_stopped(folder: Path, tmp_path) -> None:
    arguments = [
        "train",
        "--config",
        str(CONFIG),
        "--heads",
        "3",
        "--fit.face_rank",
        "0",
        "--workers",
        "0",
        "--keep-images",
    ]
    assert main([*arguments, "--output", str(tmp_path)]) == 0
    image = tmp_path / "images" / "subject_000001.npy"
    stamp = image.stat().st_mtime_ns
    first = (tmp_path / "statistics.safetensors").read_bytes()
    (tmp_path / "images" / "subject_000002.npy").unlink()
    assert main([*arguments, "--output", str(tmp_path)]) == 0
    assert image.stat().st_mtime_ns == stamp
    assert (tmp_path / "statistics.safetensors").read_bytes() == first
    assert main(["train", "--config", str(CONFIG), "--heads", "4", "--workers", "0", "--output", str(tmp_path)]) == 2


def test_odd_files_are_read_rightly(tmp_path) -> None:
    rgb = np.arange(20 * 30 * 3).reshape(20, 30, 3).astype(np.uint8)
    base = Image.fromarray(rgb)
    base.convert("L").save(tmp_path / "grey.png")
    base.convert("P").save(tmp_path / "palette.png")
    base.convert("CMYK").save(tmp_path / "cmyk.tif")
    base.convert("1").save(tmp_path / "bits.png")
    base.convert("LA").save(tmp_path / "alpha.png")
    Image.fromarray(rgb[..., 0].astype(np.uint16) * 257).save(tmp_path / "deep.png")
    exif = Image.Exif()
    exif[0x0112] = 6  # turned
    base.save(tmp_path / "turned.jpg", exif=exif)
    for name in ("grey.png", "palette.png", "cmyk.tif", "bits.png", "alpha.png", "deep.png"):
        assert read_photo(tmp_path / name).rgb.shape == (20, 30, 3)
    assert read_photo(tmp_path / "turned.jpg").rgb.shape == (30, 20, 3)
    assert read_photo(tmp_path / "alpha.png").alpha is not None
    assert np.allclose(read_photo(tmp_path / "deep.png").rgb[..., 0], rgb[..., 0] / 255, atol=1e-4)


def test_bad_files_are_named(tmp_path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("hello")
    Image.fromarray(np.zeros((50, 50, 3), np.uint8)).save(tmp_path / "whole.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:60])
    for name in ("empty.png", "text.jpg", "cut.png", "missing.png", "."):
        with pytest.raises(ValueError, match="expected"):
            read_photo(tmp_path / name)
    with pytest.raises(ValueError, match="file name"):
        write_photo(tmp_path / "noise.xyz", np.zeros((4, 4, 3), np.uint8))
