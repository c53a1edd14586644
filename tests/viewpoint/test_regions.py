"""Several pixels at a time (5.5), shrinkage, and every entry of Table 5.1."""

import numpy as np
import pytest
import torch
from sklearn.covariance import ledoit_wolf as sklearn_ledoit_wolf
from sklearn.covariance import oas as sklearn_oas

from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.shrinkage import block_shrinkage, ledoit_wolf, oas, sample_covariance, shrunk_covariance
from facerelight.viewpoint.pose import BootstrapViews, View
from facerelight.viewpoint.regions import (
    GroupRelighter,
    correlation_table,
    group_by_correlation,
    make_regions,
    random_groups,
)
from facerelight.viewpoint.views import LightViews

PIXELS = 24 * 21


@pytest.fixture(scope="module")
def views(statistics: FaceStatistics) -> LightViews:
    return LightViews(statistics)


@pytest.fixture(scope="module")
def samples(people: torch.Tensor) -> torch.Tensor:
    return people[:12].flatten(0, 1).flatten(1)


def test_shrinkage_equals_scikit_learn() -> None:
    generator = torch.Generator().manual_seed(0)
    batch = torch.randn(3, 15, 6, generator=generator, dtype=torch.float64) @ torch.randn(
        6, 6, generator=generator, dtype=torch.float64
    )
    for ours, theirs in ((ledoit_wolf, sklearn_ledoit_wolf), (oas, sklearn_oas)):
        for one, all_at_once in zip(batch, ours(batch), strict=True):
            assert np.allclose(all_at_once.numpy(), theirs(one.numpy(), assume_centered=True)[0], atol=1e-10)
    owner = torch.tensor([0, 0, 1, 1, 2, 2])
    kept = block_shrinkage(batch, owner)
    plain = sample_covariance(batch)
    within = owner[:, None] == owner
    assert torch.equal(kept[:, within], plain[:, within])
    ratio = kept[:, ~within] / plain[:, ~within]
    assert torch.allclose(ratio, ratio[:, :1].expand_as(ratio))
    assert ((ratio >= 0) & (ratio < 1)).all()
    assert (torch.linalg.eigvalsh(kept) > -1e-12).all()
    with pytest.raises(ValueError, match="expected one of sample"):
        shrunk_covariance(batch, "magic", owner)  # type: ignore[arg-type]


def test_algorithm_3_partitions_and_is_deterministic(samples: torch.Tensor) -> None:
    groups = group_by_correlation(samples, 10)
    assert sorted(torch.cat(groups).tolist()) == list(range(PIXELS))
    assert [len(group) for group in groups] == [10] * 50 + [4]
    table = correlation_table(samples)
    for a, b in zip(groups, group_by_correlation(samples, 10, table), strict=True):
        assert torch.equal(a, b)
    for group in groups[:5]:  # greedy: nobody who was left is more correlated with the first than those chosen
        later = torch.cat(groups)[torch.cat(groups).tolist().index(int(group[-1])) + 1 :]
        assert table[group[0], later].max() <= table[group[0], group].min() + 2e-5
    constant = group_by_correlation(torch.zeros(5, 7), 3)  # all tied: in the order of the pixels
    assert [group.tolist() for group in constant] == [[0, 1, 2], [3, 4, 5], [6]]
    assert sorted(torch.cat(random_groups(PIXELS, 7)).tolist()) == list(range(PIXELS))
    with pytest.raises(ValueError, match="at least 1"):
        group_by_correlation(samples, 0)


@pytest.mark.parametrize("inputs", [1, 3])
def test_one_pixel_a_group_is_the_single_pixel_model(people: torch.Tensor, lights: torch.Tensor, inputs: int) -> None:
    statistics = FaceStatistics.fit(people[:12], lights, rank=29)  # a factor of full rank, as the fields have
    regions = make_regions([torch.tensor([p]) for p in range(PIXELS)])
    group = GroupRelighter(LightViews(statistics), regions, noise=0)(
        people[13:15, :inputs], lights[:inputs], light_from_angles(12.0, 5.0)
    )
    single = StatisticalRelighter(statistics, noise=0)(
        people[13:15, :inputs], light_from_angles(12.0, 5.0)[None], source_lights=lights[:inputs]
    )
    assert torch.allclose(group.mean, single.mean[:, 0], atol=2e-6)
    assert torch.allclose(group.variance, single.variance[:, 0], atol=1e-6)


def test_groups_equal_a_slow_reference(views: LightViews, people: torch.Tensor, lights: torch.Tensor) -> None:
    """(5.6) written out for one group of three pixels and two inputs, in float64 NumPy."""
    group = torch.tensor([100, 101, 250])
    rest = torch.tensor([p for p in range(PIXELS) if p not in group.tolist()])
    out = GroupRelighter(views, make_regions([group, *rest[:, None]]), "sample", noise=0)(
        people[13:14, :2], lights[:2], lights[7]
    )
    known = views.fields([lights[7], *lights[:2]])
    fields = known.fields.double().numpy()[..., group.numpy()]  # (2, 3, N, 3)
    local = known.local.double().numpy()[..., group.numpy()]
    people_count = fields.shape[2]
    joint = np.zeros((9, 9))
    for a in range(3):
        for b in range(3):
            block = sum(part[a].T @ part[b] for part in fields) / (people_count - 1) + np.diag(local[a, b])
            joint[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = block
    mean = known.mean.double().numpy()[:, group.numpy()]
    y = people[13, :2].flatten(1).double().numpy()[:, group.numpy()].ravel() - mean[1:].ravel()
    expected = mean[0] + joint[:3, 3:] @ np.linalg.solve(joint[3:, 3:], y)
    variance = np.diag(joint[:3, :3] - joint[:3, 3:] @ np.linalg.solve(joint[3:, 3:], joint[3:, :3]))
    assert np.allclose(out.mean.flatten()[group].numpy(), expected, atol=1e-5)
    assert np.allclose(out.variance.flatten()[group].numpy(), variance, atol=1e-6)


@pytest.mark.parametrize("kind", ["sample", "block"])
def test_groups_are_consistent(
    views: LightViews, samples: torch.Tensor, people: torch.Tensor, lights: torch.Tensor, kind: str
) -> None:
    regions = make_regions(group_by_correlation(samples, 5))
    relighter = GroupRelighter(views, regions, kind, noise=0)  # type: ignore[arg-type]
    out = relighter(people[13:14, :2], lights[:2], lights[1])
    assert (out.mean - people[13, 1]).abs().max() < 0.5 / 255
    assert out.variance.max() < 1e-6


@pytest.mark.parametrize("pose", ["frontal", "turned"])
@pytest.mark.parametrize(("r_out", "r_in"), [(1, 1), (4, 4), (1, 5), (2, 6)])
@pytest.mark.parametrize("inputs", [1, 3])
def test_every_entry_of_table_5_1(
    posed: BootstrapViews,
    views: LightViews,
    people: torch.Tensor,
    lights: torch.Tensor,
    pose: str,
    r_out: int,
    r_in: int,
    inputs: int,
) -> None:
    """K = 1 and K > 1; r_out = r_in = 1, r_out = r_in > 1, r_out != r_in; frontal and turned: one interface."""
    if pose == "frontal":
        source, images, given, target, truth = (
            views,
            people[13:14, :inputs],
            list(lights[:inputs]),
            lights[7],
            people[13:14, 7],
        )
        samples = people[:12].flatten(0, 1).flatten(1)
    else:
        source, given, target = posed, [View(), View(20.0), View(-20.0)][:inputs], View(10.0)
        everybody = torch.stack([posed.images(view) for view in [*given, target]], 1)
        images, truth = everybody[:1, :-1], everybody[:1, -1]
        samples = everybody.flatten(0, 1).flatten(1)
    regions = make_regions(group_by_correlation(samples, r_out), samples, r_in)
    out = GroupRelighter(source, regions)(images, given, target)
    assert out.mean.shape == out.variance.shape == truth.shape
    assert torch.isfinite(out.mean).all()
    assert (out.variance >= 0).all()
    average = source.fields([target]).mean.view_as(truth)
    assert (out.mean - truth).square().mean() < (average - truth).square().mean()  # knows more than the average face


def test_bad_groups(
    views: LightViews,
    samples: torch.Tensor,
    people: torch.Tensor,
    lights: torch.Tensor,
    statistics: FaceStatistics,
    tmp_path,
) -> None:
    with pytest.raises(ValueError, match="at least the group's 4 pixels"):
        make_regions(group_by_correlation(samples, 4), samples, 2)
    relighter = GroupRelighter(views, make_regions(random_groups(PIXELS, 9)))
    with pytest.raises(ValueError, match=r"expected \(B, K, 24, 21\)"):
        relighter(people[13:14, :2], lights[:1], lights[3])
    statistics.save(tmp_path / "s.safetensors")
    with pytest.raises(ValueError, match="keep their images"):
        LightViews(FaceStatistics.load(tmp_path / "s.safetensors"))
