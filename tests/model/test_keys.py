"""Who belongs to whom on disk: statistics, what is made with them, and the caches that hold them."""

from pathlib import Path

import pytest
import torch
from conftest import shaded_people

from facerelight import __version__, config
from facerelight.bootstrap.domain import Domain
from facerelight.config import DEFAULT_CONFIG, PACKAGED, TrainConfig, default_statistics_folder
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.file import replacing
from facerelight.model.image_store import ImageStore
from facerelight.model.statistics import FaceStatistics


def test_the_key_outlives_saving_and_compression(statistics: FaceStatistics, tmp_path: Path) -> None:
    assert len(statistics.key) == 16
    for name, coarseness in (("plain", 0.0), ("small", 1.0)):
        statistics.save(tmp_path / name, coarseness)
        loaded = FaceStatistics.load(tmp_path / name)
        assert loaded.key == statistics.key == loaded.double().key
        loaded.save(tmp_path / f"{name} again")
        assert FaceStatistics.load(tmp_path / f"{name} again").key == statistics.key
        assert "key" not in loaded.metadata
    packaged = [FaceStatistics.load(PACKAGED / "statistics.safetensors").key for _ in range(2)]
    assert packaged[0] == packaged[1] != statistics.key


def test_learning_anew_changes_the_key(people: torch.Tensor, lights: torch.Tensor) -> None:
    statistics = FaceStatistics.fit(people[:6], lights, rank=3)
    before = statistics.key
    statistics.update(people[6]).solve()
    assert statistics.key != before


def test_an_estimator_of_other_statistics_is_refused(
    statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, tmp_path: Path
) -> None:
    """As after a run that was interrupted between two files."""
    estimator = KernelIlluminationEstimator.fit(people[:12], lights)
    other = FaceStatistics.fit(people[:11], lights, rank=4)
    for compress in (0.0, 1.0):
        StatisticalRelighter(statistics, "face", estimator).save_pretrained(tmp_path / "a", compress)
        StatisticalRelighter(other, "pixel", estimator).save_pretrained(tmp_path / "b", compress)
        assert StatisticalRelighter.from_pretrained(tmp_path / "a").estimator is not None
        (tmp_path / "b" / "estimator.safetensors").replace(tmp_path / "a" / "estimator.safetensors")
        with pytest.raises(ValueError, match=f"one of statistics {other.key} beside statistics {statistics.key}"):
            StatisticalRelighter.from_pretrained(tmp_path / "a")


def test_numbers_with_gaps_are_not_written_over(tmp_path: Path) -> None:
    store = ImageStore(tmp_path)
    for subject in (0, 2, 7):
        store.add(torch.full((1, 2, 2), float(subject)), subject)
    store.add(torch.full((1, 2, 2), 8.0))
    assert [float(array.mean()) for array in store] == [0.0, 2.0, 7.0, 8.0]
    assert 8 in store


def test_statistics_are_not_merged_with_themselves(people: torch.Tensor, lights: torch.Tensor, tmp_path: Path) -> None:
    alone = FaceStatistics(lights).update(people[0]).update(people[1])
    with pytest.raises(ValueError, match="same people"):
        alone.merge(alone)
    one, two = (FaceStatistics(lights, store=ImageStore(tmp_path)) for _ in range(2))
    one.update(people[0])
    with pytest.raises(ValueError, match="same people"):
        one.merge(two)
    assert alone.store is not None
    assert len(alone.store) == 2


def test_a_cache_is_keyed_by_all_that_changes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = set()
    for name in ("a", "b"):  # the same relative folder, seen from two places
        meshes = tmp_path / name / "meshes"
        meshes.mkdir(parents=True)
        (meshes / "head.obj").write_text("v 0 0 0")
        monkeypatch.chdir(tmp_path / name)
        relative = TrainConfig(source="meshes").key()
        assert relative == TrainConfig(source=str(meshes)).key()
        keys.add(relative)
        (meshes / "notes.md").write_text("not a mesh")
        assert TrainConfig(source="meshes").key() == relative
        (meshes / "head.obj").write_text("v 0 0 0\nv 1 0 0")
        keys.add(TrainConfig(source="meshes").key())
        (meshes / "head.points.txt").write_text("0 0 0")
        keys.add(TrainConfig(source="meshes").key())
    heads = tmp_path / "ict_heads.npz"
    for content in (b"one", b"three"):
        heads.write_bytes(content)
        keys.add(TrainConfig(source=str(heads)).key())
    assert len(keys) == 8
    default = DEFAULT_CONFIG.key()
    assert default_statistics_folder(cache=tmp_path).name == default
    assert TrainConfig(domain=Domain(turn=0.5)).key() != default
    monkeypatch.setattr(config, "__version__", "0.1.9")
    assert DEFAULT_CONFIG.key() == default  # a patch changes no picture
    monkeypatch.setattr(config, "__version__", "0.2.0")
    assert DEFAULT_CONFIG.key() != default
    assert __version__.startswith("0.1."), "pack the statistics anew: scripts/data/pack_statistics.py"


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with replacing(path) as one, replacing(path) as two:
        assert one != two
        one.write_text("one")
        two.write_text("two")
    assert path.read_text() == "one"

    def fill_the_disk() -> None:
        with replacing(path) as partial:
            partial.write_text("half")
            raise OSError("full")

    with pytest.raises(OSError, match="full"):
        fill_the_disk()
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_people_of_one_bootstrap_are_told_from_another() -> None:
    lights = torch.nn.functional.normalize(torch.randn(6, 3, generator=torch.Generator().manual_seed(3)), dim=1)
    keys = {FaceStatistics.fit(shaded_people(4, lights, seed), lights, rank=2).key for seed in (1, 1, 2)}
    assert len(keys) == 2
