import numpy as np
import pytest
import reference
import torch
from safetensors.torch import save_file

from facerelight.geometry.lights import thesis_grid
from facerelight.model.image_store import ImageStore
from facerelight.model.statistics import FaceStatistics


def test_fit_matches_slow_reference(statistics: FaceStatistics, people: torch.Tensor, lights: torch.Tensor) -> None:
    for y, x in ((3, 4), (12, 10), (20, 18)):
        n, v = reference.fit(people[:12, :, y, x].double().numpy(), lights.double().numpy())
        assert np.allclose(statistics.n_mean[:, y, x], n.mean(0), atol=1e-5)
        assert np.allclose(statistics.v_mean[:, y, x], v.mean(0), atol=1e-5)
        factor = statistics.pixel.n_factor[..., y, x].double().numpy()
        assert np.allclose(factor @ factor.T, np.cov(n.T), atol=1e-5)
        assert np.allclose(statistics.pixel.v_std[:, y, x], np.maximum(v.std(0, ddof=1), 2e-3), atol=1e-5)


def test_full_rank_factor_holds_the_sample_correlation(people: torch.Tensor, lights: torch.Tensor) -> None:
    full = FaceStatistics.fit(people[:12], lights, rank=11, floor=1e-6)
    _, v = reference.fit(people[:12, :, 12, 10].double().numpy(), lights.double().numpy())
    factor = full.pixel.v_factor[..., 12, 10].double().numpy()
    assert np.allclose(factor @ factor.T, np.corrcoef(v.T), atol=1e-3)


def test_update_one_by_one_equals_fit(
    people: torch.Tensor, lights: torch.Tensor, statistics: FaceStatistics, tmp_path
) -> None:
    one = FaceStatistics(lights, statistics.options, ImageStore(tmp_path))
    for subject in people[:12]:
        one.update(subject)
    one.solve()
    for a, b in zip(one.state_dict().values(), statistics.state_dict().values(), strict=True):
        assert torch.allclose(a, b, atol=1e-6)


def test_merge_equals_fit_of_all(people: torch.Tensor, lights: torch.Tensor, statistics: FaceStatistics) -> None:
    parts = [FaceStatistics(lights, statistics.options) for _ in range(2)]
    for index, subject in enumerate(people[:12]):
        parts[index >= 5].update(subject)
    merged = parts[0].merge(parts[1]).solve()
    assert torch.allclose(merged.pixel.v_std, statistics.pixel.v_std, atol=1e-6)


def test_missing_images_are_filled_from_the_same_person(
    people: torch.Tensor, lights: torch.Tensor, statistics: FaceStatistics
) -> None:
    valid = torch.ones(12, 30, dtype=torch.bool)
    valid[3, 7] = valid[5, 7] = valid[8, 20] = False
    images = people[:12].clone()
    images[~valid] = 0
    partial = FaceStatistics.fit(images, lights, valid, statistics.options)
    assert (partial.v_mean - statistics.v_mean).abs().max() < 0.02
    assert (partial.pixel.v_std - statistics.pixel.v_std).abs().max() < 0.04
    assert torch.isfinite(partial.face.v).all()


def test_rank_zero_face_is_the_pixel_model(people: torch.Tensor, lights: torch.Tensor) -> None:
    """Left-out residuals at rank 0 are the centred fields, in scale too."""
    from facerelight.model.subjects import face_operators, gather_grams, total_gram

    store = ImageStore()
    for subject in people[:12]:
        store.add(subject)
    grams = gather_grams(store, lights, 512)
    operators = face_operators(total_gram(grams, {}), 0)
    field = people[:12].flatten(1)
    residual = operators.residual @ field
    assert torch.allclose(residual.square().sum(0) / 12, field.var(0), atol=1e-6)


def test_save_and_load(statistics: FaceStatistics, tmp_path) -> None:
    statistics.metadata = {"source": "test"}
    statistics.save(tmp_path / "s.safetensors")
    loaded = FaceStatistics.load(tmp_path / "s.safetensors")
    assert loaded.metadata == {"source": "test"}
    for (name, a), (other, b) in zip(statistics.state_dict().items(), loaded.state_dict().items(), strict=True):
        assert name == other
        assert torch.equal(a, b)
    with pytest.raises(RuntimeError, match="not kept"):
        loaded.update(torch.zeros(30, 24, 21))


def test_bad_files(tmp_path) -> None:
    missing, garbage, other = tmp_path / "missing", tmp_path / "garbage", tmp_path / "other"
    garbage.write_bytes(b"not safetensors at all")
    save_file({"a": torch.zeros(1)}, other)
    for path in (missing, garbage, other):
        with pytest.raises(ValueError, match=path.name):
            FaceStatistics.load(path)


def test_bad_input(lights: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="divide by 255"):
        FaceStatistics(lights).update(torch.full((30, 24, 21), 200.0))
    with pytest.raises(ValueError, match="finite"):
        FaceStatistics(lights).update(torch.full((30, 24, 21), torch.nan))
    with pytest.raises(ValueError, match="linearly independent"):
        FaceStatistics(torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    with pytest.raises(ValueError, match="at least 2 subjects"):
        FaceStatistics(lights).update(torch.rand(30, 24, 21)).solve()
    with pytest.raises(RuntimeError, match="solve"):
        _ = FaceStatistics(lights).size


def test_repeated_poles_are_merged() -> None:
    grid = thesis_grid()
    statistics = FaceStatistics(grid)
    for _ in range(3):
        statistics.update(torch.rand(101, 8, 8))
    assert statistics.solve().v_mean.shape == (83, 8, 8)


def test_brightness_is_taken_out_and_put_back(people: torch.Tensor, lights: torch.Tensor) -> None:
    """People who differ by a factor alone leave nothing else to learn, and a new one is relit without error."""
    from facerelight.inference.relighter import StatisticalRelighter

    factors = torch.linspace(0.6, 1.6, 8)
    images = factors[:, None, None, None] * people[:1] * 0.8
    statistics = FaceStatistics.fit(images, lights, rank=3, brightness=True, kernel_width=0.2)
    assert statistics.pixel.v_std.max() <= statistics.options.floor * 1.01
    assert abs(float(statistics.gain_spread) - float(factors.log().std())) < 0.01
    out = StatisticalRelighter(statistics)(people[:1, :1] * 0.9, lights[9:10], source_lights=lights[:1])
    assert torch.allclose(out.mean[0], people[0, 9:10] * 0.9, atol=0.02)
