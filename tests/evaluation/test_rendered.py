"""Rendered heads of which all is known: their parts, the surroundings that light them, and what is measured."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import shaded_people

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.rendered.environments import environments
from facerelight.evaluation.rendered.surroundings import (
    ROWS,
    SurroundedHeads,
    measure_head,
    one_gain,
    render_heads,
    surroundings,
)
from facerelight.evaluation.rendered.truth import rendered_pictures
from facerelight.geometry.environment import environment_light
from facerelight.geometry.lights import angular_distance, even_hemisphere
from facerelight.geometry.sources import Lamp
from facerelight.geometry.sums import LightSum, even_sphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.model.statistics import FaceStatistics

SMALL = replace(DEFAULT_CONFIG, heads=2, seed=5, height=48, width=42, margin=0.3, supersample=1)


@pytest.fixture(scope="module")
def maps() -> dict[str, torch.Tensor]:
    return environments()


def test_surroundings_are_the_same_every_time(maps: dict[str, torch.Tensor]) -> None:
    again, other = environments(), environments(1)
    assert len(maps) == 20
    for name, radiance in maps.items():
        assert torch.equal(radiance, again[name])
        assert torch.isfinite(radiance).all()
        assert (radiance >= 0).all()
    assert sum(not torch.equal(maps[name], other[name]) for name in maps) >= 17  # an overcast sky is one
    assert float(maps["sun, high"].max() / maps["sun, high"].mean()) > 500
    assert float(maps["overcast, snow"].max() / maps["overcast, snow"].mean()) < 3


def test_both_forms_of_a_surrounding_are_one_light(maps: dict[str, torch.Tensor]) -> None:
    facing = even_hemisphere(100)
    for name, place in surroundings(maps).items():
        fine = (facing @ even_sphere(256).T).clamp_min(0) @ place.truth
        coarse = (facing @ place.light.directions.T).clamp_min(0) @ place.light.amounts[0]
        assert (fine - coarse).square().mean().sqrt() < 0.08 * coarse.square().mean().sqrt(), name
        read = LightSum.of(environment_light(maps[name]))
        assert torch.allclose(place.light.amounts, read.amounts)


def test_a_gain_is_no_error() -> None:
    truth = torch.rand(3, 24, 21) * 0.5
    assert one_gain(3 * truth, truth)["rmse"] < 1e-3
    assert one_gain(3 * truth, truth)["ssim"] > 0.999
    off = truth.clone()
    off[0] += 10 / 255
    assert 0 < one_gain(off, truth)["rmse"] < 10


def test_knowing_the_surrounding_helps(maps: dict[str, torch.Tensor]) -> None:
    lights, targets = even_hemisphere(30), even_hemisphere(8)
    statistics = FaceStatistics.fit(shaded_people(12, lights, 0), lights, rank=6, face_rank=5, temper=10.0, basis=12)
    relighter = StatisticalRelighter(statistics, "face", SoftLightEstimator(statistics))
    both = shaded_people(2, torch.cat((targets, even_sphere(256))), 9)
    heads = SurroundedHeads(both[:, :8], both[:, 8:])
    some = {name: maps[name] for name in ("one window", "studio", "sunset")}
    found = measure_head(relighter, heads, 0, targets, surroundings(some), 4)
    assert {row for _, row, _ in found} == set(ROWS)
    assert {name for name, _, _ in found} == set(some)
    mean = {
        row: sum(found[name, row, what]["rmse"] for name in some for what in ("single", "surroundings")) for row in ROWS
    }
    assert mean["labelled"] < 0.8 * mean["average face"]
    assert mean["labelled"] < min(mean["one lamp"], mean["quotient"])
    assert all(0 <= found[name, "labelled", "single"]["coverage95"] <= 100 for name in some)


def test_heads_sum_to_their_surroundings() -> None:
    config = replace(SMALL, heads=2, height=24, width=21, margin=0.0)
    heads = render_heads(config, even_hemisphere(2))
    assert heads.single.shape == (2, 2, 24, 21)
    assert heads.sphere.shape == (2, 256, 24, 21)
    front = even_sphere(256)[:, 2].argmax()
    assert (heads.sphere[:, front] - heads.single[:, 0]).abs().mean() < 0.05
    behind = even_sphere(256)[:, 2] < -0.9
    assert heads.sphere[:, behind].mean() < 0.2 * heads.single[:, 0].mean()


def test_a_rendered_picture_knows_its_parts() -> None:
    setups = {"camera": ([Lamp(0, 0, 1)], 0.0), "left": ([Lamp(50, 20, 5)], 0.2)}
    pictures = list(rendered_pictures(SMALL, setups))
    assert [name for name, _ in pictures] == ["camera", "left", "camera", "left"]
    for name, truth in pictures:
        assert truth.photo.shape == (48, 42, 3)
        assert truth.photo.dtype == np.uint8
        assert np.linalg.norm(truth.normal[truth.face], axis=-1) == pytest.approx(1, abs=1e-4)
        assert (truth.albedo[truth.face] > 0).all()
        lamp = setups[name][0][0]
        aside = float(truth.direction[0])
        assert (aside < -0.3) if lamp.azimuth else abs(aside) < 1e-6
    camera, left = pictures[0][1], pictures[1][1]
    lit = camera.irradiance[camera.face] / camera.normal[camera.face][:, 2].clip(0.2)
    assert np.median(np.abs(lit / np.median(lit) - 1)) < 0.1  # Lambert's cosine, and a little fill
    assert np.array_equal(camera.albedo, left.albedo)
    seen = left.photo[..., 0].astype(float)
    half = np.arange(42) < 21
    assert seen[left.face & half].mean() > 1.1 * seen[left.face & ~half].mean()


def test_the_middle_of_a_light_is_told() -> None:
    _, truth = next(iter(rendered_pictures(SMALL, {"one": ([Lamp(30, 10, 1)], 0.0)})))
    from facerelight.geometry.lights import light_from_angles

    assert float(angular_distance(truth.direction, light_from_angles(30.0, 10.0))) < 0.1
