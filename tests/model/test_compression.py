"""Compressed statistics: what rounding may change, what it must not, and those that come with the package."""

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from facerelight.config import DEFAULT_CONFIG, PACKAGED, QUALITIES, default_statistics_folder, find_statistics
from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.compression import HALF_WAY, STEPS, checksum, compress, decompress, deflate_maps, inflate_maps
from facerelight.model.covariance import image_covariance
from facerelight.model.learning import FitOptions
from facerelight.model.light_terms import light_terms
from facerelight.model.statistics import FaceStatistics
from facerelight.photo import load_relighter

TRAINING = ("OpenGL", "jsonargparse", "matplotlib", "pyrender", "tqdm", "trimesh", "yaml")
UNIX = ("fcntl", "grp", "pwd", "resource", "termios")


def correlation(factor: torch.Tensor) -> torch.Tensor:
    """``F F^T`` at every pixel, ``(H, W, J, J)``."""
    return torch.einsum("irhw,jrhw->hwij", factor, factor)


def changed(first: FaceStatistics, second: FaceStatistics, images: torch.Tensor, lights: torch.Tensor) -> float:
    """RMS in grey levels between relit images."""
    made = [StatisticalRelighter(s, "face").condition(images, lights[3:4]).mean(lights) for s in (first, second)]
    return float((made[0] - made[1]).square().mean().sqrt()) * 255


@pytest.fixture(scope="module")
def packed(statistics: FaceStatistics, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "statistics.safetensors"
    statistics.save(path, 1.0)
    return path


# -- maps -------------------------------------------------------------------------------------------------------------
@settings(max_examples=40, deadline=None)
@given(
    shape=st.sampled_from([(1, 1), (3, 5), (2, 8, 7), (2, 3, 6, 4), (0, 5, 5)]),
    size=st.sampled_from([0.0, 0.1, 10.0, 3e4]),
    step=st.sampled_from([1e-3, 0.1]),
    seed=st.integers(0, 99),
)
def test_maps_come_back_to_within_a_step(shape: tuple[int, ...], size: float, step: float, seed: int) -> None:
    maps = torch.randn(shape, generator=torch.Generator().manual_seed(seed)) * size
    back = inflate_maps(**deflate_maps(maps, step))
    assert back.shape == maps.shape
    assert back.dtype == torch.float32
    error = (back - maps).square().sum(dim=(-2, -1)).sqrt()  # the transform is orthonormal
    length = maps.square().sum(dim=(-2, -1)).sqrt()
    assert (error <= HALF_WAY * step * (shape[-1] * shape[-2]) ** 0.5 + 1e-5 * length).all()


def test_smooth_maps_become_small() -> None:
    y, x = torch.meshgrid(torch.linspace(0, 3, 128), torch.linspace(0, 3, 112), indexing="ij")
    maps = torch.stack([torch.sin(x + shift) * torch.cos(y - shift) for shift in torch.linspace(0, 1, 20)])
    assert len(deflate_maps(maps, 1e-3)["codes"]) < maps.numel() * 4 / 40


# -- statistics -------------------------------------------------------------------------------------------------------
def test_what_comes_back(statistics: FaceStatistics) -> None:
    """Means and loadings as they were; factors up to a rotation, which no covariance sees."""
    full = statistics.state_dict()
    back = decompress(compress(full))
    assert back.keys() == full.keys()
    for name in ("n_mean", "v_mean", "face.n", "face.v"):
        error = (back[name] - full[name]).square().mean().sqrt()
        assert error < HALF_WAY * STEPS[name.rpartition(".")[2]], name
    for part in ("pixel", "face.residual"):
        ratio = back[f"{part}.v_std"] / full[f"{part}.v_std"]
        assert ratio.log().square().mean().sqrt() < STEPS["v_log_std"]
        n = [torch.einsum("dcyx,ecyx->deyx", t[f"{part}.n_factor"], t[f"{part}.n_factor"]) for t in (full, back)]
        assert (n[0] - n[1]).abs().max() < 5e-4
        v = [correlation(t[f"{part}.v_factor"]) for t in (full, back)]
        assert (v[0] - v[1]).square().mean().sqrt() < 2**0.5 * HALF_WAY * STEPS["v_factor"]  # rows are no longer than 1
    assert (back["face.v_power"] - full["face.v_power"]).abs().max() < 1e-3


@pytest.mark.parametrize(("coarseness", "most"), [(0.1, 0.05), (1.0, 0.4)])
def test_relit_faces_hardly_change(
    statistics: FaceStatistics,
    people: torch.Tensor,
    lights: torch.Tensor,
    tmp_path: Path,
    coarseness: float,
    most: float,
) -> None:
    statistics.save(tmp_path / "statistics.safetensors", coarseness)
    back = FaceStatistics.load(tmp_path / "statistics.safetensors")
    assert changed(statistics, back, people[12:, :1], lights) < most


@pytest.mark.parametrize("coarseness", [1.0, 30.0])
@pytest.mark.parametrize("residual", [False, True])
def test_covariances_stay_semidefinite(
    statistics: FaceStatistics, tmp_path: Path, coarseness: float, residual: bool
) -> None:
    statistics.save(tmp_path / "statistics.safetensors", coarseness)
    back = FaceStatistics.load(tmp_path / "statistics.safetensors")
    assert back.face is not None
    part, face = (back.face.residual, back.face) if residual else (back.pixel, None)
    assert part.v_std.min() > 0
    assert part.v_factor.square().sum(1).max() <= 1 + 1e-6
    terms = light_terms(back, part, even_hemisphere(60), face)
    values = torch.linalg.eigvalsh(image_covariance(back, part, terms, terms))
    assert (values >= -1e-12 - 1e-9 * values[:, -1:]).all()


def test_columns_that_turn_from_pixel_to_pixel_cost_little(statistics: FaceStatistics) -> None:
    full = statistics.state_dict()
    factor = full["pixel.v_factor"]
    noise = torch.randn(*factor.shape[2:], 6, 6, generator=torch.Generator().manual_seed(0))
    turned = torch.einsum("jrhw,hwrs->jshw", factor, torch.linalg.qr(noise).Q)
    packed = [compress({"pixel.v_factor": each}) for each in (factor, turned)]
    sizes = [len(each["pixel.v_factor.codes"]) for each in packed]
    assert sizes[1] < 1.15 * sizes[0]
    back = decompress(packed[1])["pixel.v_factor"]
    assert (correlation(back) - correlation(factor)).square().mean().sqrt() < 2**0.5 * HALF_WAY * STEPS["v_factor"]


def test_a_model_without_loadings_or_factor(people: torch.Tensor, lights: torch.Tensor, tmp_path: Path) -> None:
    plain = FaceStatistics.fit(people[:6], lights, rank=0)
    plain.save(tmp_path / "plain.safetensors", 1.0)
    back = FaceStatistics.load(tmp_path / "plain.safetensors")
    assert back.face is None
    assert back.pixel is not None
    assert back.pixel.v_factor.shape[1] == 0


def test_save_pretrained_compressed(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, tmp_path: Path
) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    relighter = StatisticalRelighter(statistics, "face", estimator)
    statistics.metadata["source"] = "a small world"
    relighter.save_pretrained(tmp_path / "full")
    relighter.save_pretrained(tmp_path / "small", compress=True)
    for name, most in (("statistics", 0.25), ("estimator", 0.5)):
        sizes = [(tmp_path / kind / f"{name}.safetensors").stat().st_size for kind in ("small", "full")]
        assert sizes[0] < most * sizes[1], name
    back = StatisticalRelighter.from_pretrained(tmp_path / "small")
    assert back.covariance == "face"
    assert back.statistics.options == statistics.options
    assert back.statistics.metadata == {"source": "a small world"}
    assert back.estimator is not None
    found, before = (e(people[12:, :8]).direction for e in (back.estimator, estimator))
    assert (found - before).abs().max() < 0.03


# -- files that are broken --------------------------------------------------------------------------------------------
def test_a_changed_byte_is_found(packed: Path, tmp_path: Path) -> None:
    whole = packed.read_bytes()
    for place in (0.3, 0.6, 0.95):
        content = bytearray(whole)
        content[int(len(whole) * place)] ^= 1
        (tmp_path / "changed.safetensors").write_bytes(content)
        with pytest.raises(ValueError, match=r"changed\.safetensors: expected .* checksum .* got .*anew"):
            FaceStatistics.load(tmp_path / "changed.safetensors")


@pytest.mark.parametrize("part", [0.0, 0.01, 0.5, 0.99])
def test_a_file_cut_short_is_named(packed: Path, tmp_path: Path, part: float) -> None:
    whole = packed.read_bytes()
    (tmp_path / "short.safetensors").write_bytes(whole[: int(len(whole) * part)])
    with pytest.raises(ValueError, match=r"short\.safetensors: expected"):
        FaceStatistics.load(tmp_path / "short.safetensors")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("v_mean.codes", torch.zeros(9, dtype=torch.uint8)),
        ("v_mean.codes", torch.zeros(0, dtype=torch.uint8)),
        ("v_mean.shape", torch.tensor([30, 24, 22])),
        ("v_mean.shape", torch.tensor([-30, 24, -21])),
        ("v_mean.shape", torch.tensor([24])),
        ("v_mean.step", torch.tensor([0.1, 0.1])),
        ("v_mean.step", torch.tensor(torch.nan)),
        ("v_mean.step", None),
        ("v_mean.codes", None),
    ],
)
def test_codes_that_do_not_fit(packed: Path, tmp_path: Path, name: str, value: torch.Tensor | None) -> None:
    """With a right checksum: a mistake, or malice."""
    tensors = {key: tensor for key, tensor in load_file(packed).items() if key != name}
    tensors |= {} if value is None else {name: value}
    with safe_open(packed, "pt") as file:
        header = json.loads(file.metadata()["facerelight"])
    header["checksum"] = checksum(tensors)
    path = tmp_path / "odd.safetensors"
    save_file(tensors, path, metadata={"facerelight": json.dumps(header)})
    with pytest.raises(ValueError, match=r"odd\.safetensors: .*v_mean.*anew"):
        FaceStatistics.load(path)


def test_an_estimator_that_is_broken_is_named(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, tmp_path: Path
) -> None:
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    StatisticalRelighter(statistics, "face", estimator).save_pretrained(tmp_path, compress=True)
    path = tmp_path / "estimator.safetensors"
    tensors = load_file(path)
    tensors["prototypes.codes"] = tensors["prototypes.codes"][:-9]
    save_file(tensors, path)
    with pytest.raises(ValueError, match=r"estimator\.safetensors: expected a light estimator"):
        StatisticalRelighter.from_pretrained(tmp_path)


# -- the packaged statistics ------------------------------------------------------------------------------------------
def test_packaged_statistics_are_those_of_the_default_config() -> None:
    statistics = load_relighter().statistics
    assert statistics.metadata["config"] == json.loads(json.dumps(asdict(DEFAULT_CONFIG)))
    assert statistics.metadata["config_version"] == DEFAULT_CONFIG.key(), "run scripts/data/pack_statistics.py"
    assert statistics.options == DEFAULT_CONFIG.fit
    assert statistics.size == (DEFAULT_CONFIG.height, DEFAULT_CONFIG.width)
    assert torch.allclose(statistics.lights, DEFAULT_CONFIG.directions(), atol=1e-6)
    assert sum(path.stat().st_size for path in PACKAGED.iterdir()) < 10e6


def test_which_statistics_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Packaged ones for the default config, whatever is cached; cached ones for others, or where the cache is named."""
    monkeypatch.setenv("FACERELIGHT_CACHE", str(tmp_path))
    other = replace(DEFAULT_CONFIG, fit=FitOptions(rank=3))
    for config in (DEFAULT_CONFIG, QUALITIES["draft"]):
        place = default_statistics_folder(config)
        place.mkdir(parents=True)
        (place / "statistics.safetensors").write_bytes(b"")
    assert find_statistics(DEFAULT_CONFIG) == PACKAGED
    assert find_statistics(DEFAULT_CONFIG, tmp_path) == default_statistics_folder(DEFAULT_CONFIG)
    assert find_statistics(QUALITIES["draft"]) == default_statistics_folder(QUALITIES["draft"])
    assert find_statistics(other) is None
    with pytest.raises(RuntimeError, match=r"none of quality 'reference'.*--quality reference"):
        load_relighter("reference")


def run_without(modules: tuple[str, ...], code: str) -> subprocess.CompletedProcess[str]:
    """``code`` in a fresh interpreter in which ``modules`` cannot be imported."""
    blocked = f"""
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {modules!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Blocked())
"""
    return subprocess.run([sys.executable, "-c", blocked + code], capture_output=True, text=True, timeout=300)


def test_relighting_needs_nothing_that_training_needs(tmp_path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)).save(tmp_path / "a.png")
    arguments = ["relight", str(tmp_path / "a.png"), "--landmarks", "20,24,44,24,32,44", "--light", "60,0"]
    arguments += ["--output", str(tmp_path / "out.png")]
    done = run_without((*TRAINING, *UNIX), f"from facerelight.cli import main; sys.exit(main({arguments!r}))")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out.png").exists()


@pytest.mark.parametrize("missing", ["trimesh", "pyrender", "tqdm", "jsonargparse"])
def test_training_says_what_to_install(tmp_path: Path, missing: str) -> None:
    arguments = ["train", "--output", str(tmp_path / "statistics"), "--workers", "0"]
    done = run_without((missing,), f"from facerelight.cli import main; sys.exit(main({arguments!r}))")
    assert done.returncode == 3
    assert missing in done.stderr
    assert 'pip install "facerelight[train]"' in done.stderr
    assert "Traceback" not in done.stderr
