"""Files that are broken, hostile or merely odd: each ends in one line and exit code 2, or is read rightly."""

import io
import json
import pickle
import signal
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors.torch import load_file, save_file

from facerelight.cli import main
from facerelight.model.statistics import FaceStatistics
from facerelight.photo.files.disk import read_photo
from facerelight.recognition.gallery.file import VERSION

CONFIG = Path(__file__).parent.parent / "configs" / "tiny.yaml"
MARKS = "20,24,44,24,32,44"


def encoded(kind: str, mode: str = "RGB") -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).convert(mode).save(buffer, kind)
    return buffer.getvalue()


def bad_photos() -> dict[str, bytes]:
    """Contents by file name."""
    files: dict[str, bytes] = {
        "empty.png": b"",
        "text.jpg": b"not a picture",
        "html.png": b"<html></html>",
        "zeros.tif": bytes(500),
    }
    for kind in ("JPEG", "PNG", "TIFF", "PPM", "BMP", "WEBP"):
        whole = encoded(kind)
        for part in (1, 2, 5, 10, 20, 30, 40, 50, 60, 70):
            files[f"cut_{part}.{kind.lower()}"] = whole[: max(len(whole) * part // 100, 3)]
        files[f"head_gone.{kind.lower()}"] = whole[12:]
        files[f"other_head.{kind.lower()}"] = b"GIF89a" + whole[6:]
        for seed in range(4):
            noise = np.random.default_rng(seed).integers(0, 256, 16).astype(np.uint8).tobytes()
            files[f"noisy_head_{seed}.{kind.lower()}"] = noise + whole[16:]
    files["animated.gif"] = encoded("GIF", "P")
    files["pickle.png"] = pickle.dumps({"a": 1})
    files["huge.png"] = _png_header(100_000, 100_000)
    files["flat.png"] = _png_header(0, 10)
    files["large.ppm"] = b"P6 30000 30000 255\n" + bytes(100)
    for name, value in (("nan", np.nan), ("inf", np.inf)):
        buffer = io.BytesIO()
        Image.fromarray(np.full((64, 64), value, np.float32)).save(buffer, "TIFF")
        files[f"{name}.tif"] = buffer.getvalue()
    return files


def _png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
        + chunk(b"IDAT", b"")
        + chunk(b"IEND", b"")
    )


def bad_statistics(good: Path) -> dict[str, bytes]:
    whole = (good / "statistics.safetensors").read_bytes()
    files = {
        "empty": b"",
        "text": b"hello",
        "pickle": pickle.dumps([1]),
        "huge_header": struct.pack("<Q", 2**60) + whole[8:],
    }
    for part in (1, 10, 50, 90, 99):
        files[f"cut_{part}"] = whole[: len(whole) * part // 100]
    tensors = load_file(good / "statistics.safetensors")
    size = struct.unpack("<Q", whole[:8])[0]
    header = json.loads(json.loads(whole[8 : 8 + size])["__metadata__"]["facerelight"])

    def write(changed: dict[str, torch.Tensor], notes: dict[str, object]) -> bytes:
        path = good / "scratch.safetensors"
        save_file({k: v.contiguous() for k, v in changed.items()}, path, metadata={"facerelight": json.dumps(notes)})
        content = path.read_bytes()
        path.unlink()
        return content

    for name in (
        "lights",
        "light_widths",
        "n_mean",
        "v_mean",
        "pixel.n_factor",
        "pixel.v_std",
        "pixel.v_factor",
        "face.n",
        "face.residual.v_std",
    ):
        files[f"without_{name}"] = write({k: v for k, v in tensors.items() if k != name}, header)
        files[f"nan_in_{name}"] = write({**tensors, name: tensors[name] * torch.nan}, header)
        files[f"short_{name}"] = write({**tensors, name: tensors[name][..., :-1]}, header)
        files[f"flat_{name}"] = write({**tensors, name: tensors[name].flatten()[:5]}, header)
    files["future"] = write(tensors, {**header, "version": 99})
    files["another_format"] = write(tensors, {**header, "format": "other"})
    files["no_header"] = write(tensors, {})
    files["odd_options"] = write(tensors, {**header, "options": {"rank": -5}})
    files["more_options"] = write(tensors, {**header, "options": {"colour": 3}})
    return files


BAD_CONFIGS = [
    "heads: -1", "heads: 0", "heads: 1", "heads: many", "heads: 1.5", "heads: [1]", "heads: null", "hats: 3",
    "lights: moon", "lights: 2", "lights: -4", "height: tall", "height: -8", "height: 0", "width: 0", "margin: -3",
    "margin: wide", "seed: x", "effects: glow", "supersample: 0", "supersample: -1", "source: /nowhere", "source: ''",
    "fit: 3", "fit: {rank: -1}", "fit: {rank: x}", "fit: {floor: 0}", "fit: {face_rank: -2}", "fit: {temper: 0}",
    "fit: {basis: 0}", "fit: {block: 0}", "fit: {nugget_width: 0}", "fit: {what: 1}", "fit: {kernel_width: -1}",
    "domain: {tone_low: 2}", "domain: {tone_low: 0}", "domain: {texture: -1}", "domain: {specular: -1}",
    "domain: {fill: -1}", "domain: {roughness: 0}", "domain: {colour: red}", "domain: 7", "[1, 2]", "just words",
    "heads: {a: 1}", "!!python/object/apply:os.system ['echo hacked']", "heads: 5\nheads: [", "\t\t:", "a: b: c", "{",
    "%YAML 9", "\x00",
]  # fmt: skip


def test_at_least_200_bad_files_are_refused_in_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Through the command line's main: exit code 2, the file named, no traceback, nothing written, nothing executed."""
    output = tmp_path / "out" / "relit.png"
    count = 0

    def refused(arguments: list[str], name: str) -> None:
        nonlocal count
        code = main(arguments)
        said = capsys.readouterr()
        assert code == 2, f"{name}: exit code {code}: {said.err}"
        assert "Traceback" not in said.err, name
        assert not output.exists(), name
        assert "hacked" not in said.out + said.err, name
        count += 1

    relight = ["relight", "--landmarks", MARKS, "--output", str(output), "--statistics"]
    for name, content in bad_photos().items():
        path = tmp_path / name
        path.write_bytes(content)
        refused([*relight, str(folder), str(path)], name)
    good = tmp_path / "good.png"
    good.write_bytes(encoded("PNG"))
    for name, content in bad_statistics(folder).items():
        place = tmp_path / "statistics" / name
        place.mkdir(parents=True)
        (place / "statistics.safetensors").write_bytes(content)
        refused([*relight, str(place), str(good)], name)
    whole = (folder / "estimator.safetensors").read_bytes()
    for name, content in {"empty": b"", "cut": whole[:300], "text": b"x" * 100, "pickle": pickle.dumps(1)}.items():
        place = tmp_path / "estimator" / name
        place.mkdir(parents=True)
        (place / "statistics.safetensors").write_bytes((folder / "statistics.safetensors").read_bytes())
        (place / "estimator.safetensors").write_bytes(content)
        refused([*relight, str(place), str(good)], f"estimator {name}")
    for index, text in enumerate(BAD_CONFIGS):
        path = tmp_path / f"config_{index}.yaml"
        path.write_text(text)
        refused(["train", "--config", str(path), "--output", str(tmp_path / "never")], text)
    for index, (name, content) in enumerate(bad_meshes().items()):
        place = tmp_path / f"meshes_{index}"
        place.mkdir()
        (place / name).write_bytes(content[0])
        if content[1] is not None:
            (place / name).with_suffix(".points.txt").write_text(content[1])
        training = [
            "train",
            "--config",
            str(CONFIG),
            "--heads",
            "2",
            "--workers",
            "0",
            "--output",
            str(tmp_path / f"m{index}"),
        ]
        (place / f"second{Path(name).suffix}").write_bytes(content[0])
        (place / "second.points.txt").write_text(content[1] or "")
        refused([*training, "--source", str(place)], f"{index} {name}")
    for name, content in bad_galleries().items():
        path = tmp_path / f"{name}.safetensors"
        path.write_bytes(content)
        refused(["recognize", str(path), "--photos", str(good), "--statistics", str(folder)], name)
    for value in (
        "",
        "1,2,3",
        "a,b,c,d,e,f",
        "1,1,1,1,1,1",
        "0,0,5,5,9,9",
        "-900,0,40,0,20,40",
        "nan,0,40,0,20,40",
        "1e9,0,40,0,20,40",
    ):
        refused(
            ["relight", f"--landmarks={value}", "--statistics", str(folder), "--output", str(output), str(good)],
            f"landmarks {value!r}",
        )
    print(f"{count} bad files refused")
    assert count >= 200, count
    assert not (tmp_path / "never").exists() or not list((tmp_path / "never").rglob("*.safetensors"))
    assert not list(tmp_path.rglob("*.part"))


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
POINTS = "-0.5 0 0\n0.5 0 0\n0 -1 0.4\n"


def bad_meshes() -> dict[str, tuple[bytes, str | None]]:
    return {
        "no_faces.obj": (TRIANGLE.encode(), POINTS),
        "nan.obj": (b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", POINTS),
        "empty.obj": (b"", POINTS),
        "text.ply": (b"hello", POINTS),
        "cut.glb": (b"glTF\x02\x00\x00\x00", POINTS),
        "no_points.obj": ((TRIANGLE + "f 1 2 3\n").encode(), None),
        "two_points.obj": ((TRIANGLE + "f 1 2 3\n").encode(), "0 0 0\n1 0 0\n"),
        "collinear_points.obj": ((TRIANGLE + "f 1 2 3\n").encode(), "0 0 0\n1 0 0\n2 0 0\n"),
        "nan_points.obj": ((TRIANGLE + "f 1 2 3\n").encode(), "0 0 nan\n1 0 0\n2 1 0\n"),
        "word_points.obj": ((TRIANGLE + "f 1 2 3\n").encode(), "left eye\n"),
    }


def bad_galleries() -> dict[str, bytes]:
    from safetensors.torch import save

    notes = {"format": "facerelight-gallery", "version": VERSION, "recognizer": "individual_pca"}
    notes |= {"key": {"model": "another", "crop": [48, 42, 0.25], "version": 4}, "owners": ["a"]}
    means, bases, probe = torch.zeros(1, 2, 9), torch.zeros(1, 2, 9, 2), torch.zeros(1, 9, 8)
    tensors = {"mean": means, "basis": bases, "probe": probe}

    def file(told: object = notes, parts: dict[str, torch.Tensor] = tensors) -> bytes:
        return save(parts, {"gallery": told if isinstance(told, str) else json.dumps(told)})

    return {
        "gallery_empty": b"",
        "gallery_cut": file()[:100],
        "gallery_pickle": pickle.dumps([1]),
        "gallery_bare": save(tensors),
        "gallery_no_header": file({}),
        "gallery_not_json": file("{"),
        "gallery_list": file([]),
        "gallery_other_statistics": file(),
        "gallery_no_key": file({part: value for part, value in notes.items() if part != "key"}),
        "gallery_future": file({**notes, "version": VERSION + 1}),
        "gallery_more_owners": file({**notes, "owners": ["a", "b"]}),
        "gallery_odd_owner": file({**notes, "owners": [1]}),
        "gallery_odd_recognizer": file({**notes, "recognizer": "phrenology"}),
        "gallery_nan": file(parts={**tensors, "basis": bases * torch.nan}),
        "gallery_whole_numbers": file(parts={**tensors, "mean": means.long()}),
        "gallery_without_probe": file(parts={"mean": means, "basis": bases}),
    }


def test_odd_meshes_are_read_rightly(tmp_path: Path) -> None:
    """A million faces, no normals in the file, several bodies in one scene."""
    import trimesh

    from facerelight.bootstrap.heads.meshes import MeshFolder

    large = trimesh.creation.icosphere(subdivisions=8)
    assert len(large.faces) > 1_000_000
    large.export(tmp_path / "a_large.ply", vertex_normal=False)
    trimesh.Scene([trimesh.creation.icosphere(), trimesh.creation.box()]).export(tmp_path / "b_scene.glb")
    for name in ("a_large", "b_scene"):
        (tmp_path / f"{name}.points.txt").write_text(POINTS)
    heads = MeshFolder(tmp_path)
    assert len(heads.head(0).triangles) == len(large.faces)
    scene = heads.head(1)
    assert len(scene.triangles) == len(trimesh.creation.icosphere().faces) + 12
    assert np.isfinite(scene.normals()).all()


def test_places_that_cannot_be_used(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = tmp_path / "good.png"
    good.write_bytes(encoded("PNG"))
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    common = ["relight", str(good), "--landmarks", MARKS, "--statistics", str(folder), "--output"]
    for arguments in (
        [*common, str(tmp_path / "file" / "out.png")],
        [*common, "/proc/version/out.png"],
        [*common, str(tmp_path / "out.xyz")],
        ["relight", str(tmp_path / "empty"), "--statistics", str(folder)],
        ["relight", str(tmp_path / "bad\x00name.png"), "--statistics", str(folder)],
        ["relight", str(good), "--statistics", str(tmp_path / "nowhere")],
        ["train", "--config", str(CONFIG), "--output", str(tmp_path / "file")],
        ["recognize", str(tmp_path / "none.safetensors"), "--photos", str(good), "--statistics", str(folder)],
        [
            "recognize",
            str(tmp_path / "none.safetensors"),
            "--enroll",
            str(tmp_path / "nowhere"),
            "--statistics",
            str(folder),
        ],
    ):
        assert main(arguments) == 2, arguments
        assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["relight", "nowhere.png"], ["train", "--heads", "x"], ["relight", "{cut}"]])
def test_real_commands_end_with_2(arguments: list[str], tmp_path: Path) -> None:
    cut = tmp_path / "cut.png"
    cut.write_bytes(encoded("PNG")[:200])
    command = [
        sys.executable,
        "-W",
        "error",
        "-m",
        "facerelight.cli",
        *(argument.format(cut=cut) for argument in arguments),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["JPEG", "PNG", "TIFF", "PPM", "BMP", "WEBP"]),
    place=st.floats(0, 1),
    value=st.binary(min_size=1, max_size=8),
)
def test_mutated_photos_are_read_or_refused(tmp_path: Path, kind: str, place: float, value: bytes) -> None:
    """A bounded fuzz; ``python tests/test_bad_files.py 10000`` runs a longer one."""
    read_mutated(tmp_path / "mutated", kind, place, value)


def read_mutated(path: Path, kind: str, place: float, value: bytes) -> None:
    content = bytearray(encoded(kind))
    start = int(place * (len(content) - len(value)))
    content[start : start + len(value)] = value
    path.write_bytes(content)
    try:
        photo = read_photo(path)
    except ValueError as refused:
        message = str(refused)
    else:
        message = f"{path}: expected"
        assert np.isfinite(photo.rgb).all()
        assert photo.rgb.min() >= 0
        assert photo.rgb.max() <= 1
    assert message.startswith(f"{path}: expected")


def test_training_stopped_by_a_signal_goes_on(tmp_path: Path) -> None:
    """Killed while rendering: no statistics, no half image; the same command finishes and equals an uninterrupted
    run."""
    options = ["--config", str(CONFIG), "--heads", "16", "--fit.face_rank", "0", "--workers", "0", "--output"]
    command = [sys.executable, "-m", "facerelight.cli", "train", *options, str(tmp_path / "killed")]
    for how in (signal.SIGTERM, signal.SIGINT):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        started = len(list((tmp_path / "killed" / "images").glob("*.npy")))
        deadline = time.monotonic() + 60
        while len(list((tmp_path / "killed" / "images").glob("*.npy"))) == started and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(how)
        assert process.wait(30) != 0
        assert not (tmp_path / "killed" / "statistics.safetensors").exists()
    (tmp_path / "killed" / "images" / "subject_000000.npy").write_bytes(b"damaged")
    assert main(["train", *options, str(tmp_path / "killed")]) == 0
    assert main(["train", *options, str(tmp_path / "whole")]) == 0
    killed, whole = (
        FaceStatistics.load(tmp_path / name / "statistics.safetensors").state_dict() for name in ("killed", "whole")
    )
    assert all(torch.equal(killed[name], whole[name]) for name in whole)


def test_a_full_disk_leaves_nothing_half_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    options = [
        "train",
        "--config",
        str(CONFIG),
        "--heads",
        "3",
        "--fit.face_rank",
        "0",
        "--workers",
        "0",
        "--output",
        str(tmp_path),
    ]
    real, written = np.save, []

    def full(file, array):
        written.append(1)
        if len(written) == 2:
            file.write(b"half")
            raise OSError(28, "No space left on device", str(tmp_path))
        real(file, array)

    monkeypatch.setattr(np, "save", full)
    assert main(options) == 2
    assert "No space left" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*.part"))
    assert main(options) == 0


if __name__ == "__main__":
    import tempfile

    generator = np.random.default_rng()
    with tempfile.TemporaryDirectory() as scratch:
        for _ in range(int(sys.argv[1]) if len(sys.argv) > 1 else 1000):
            kinds = ["JPEG", "PNG", "TIFF", "PPM", "BMP", "WEBP"]
            read_mutated(
                Path(scratch) / "mutated", str(generator.choice(kinds)), float(generator.random()), generator.bytes(4)
            )
