"""Relighting rendered heads that twenty surroundings lit: protocol *rendered-surroundings*.

A head's pictures under 256 directions all over the sphere, once rendered, sum to its picture under any map. Each
surrounding gives one input a head; single lights, and other surroundings, are asked for. The methods know a surrounding
through the package's own reader of maps, as 80 directions, or estimate its light from the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from kornia.metrics import ssim
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.config import TrainConfig
from facerelight.evaluation.relighting import inside_interval
from facerelight.evaluation.soft_light import brought_to_one_lamp
from facerelight.geometry.behind import nearest_side
from facerelight.geometry.environment import environment_light, map_directions
from facerelight.geometry.lights import nearest_lights
from facerelight.geometry.sums import LightSum, even_sphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.soft import fit_soft_light
from facerelight.model.covariance import prior_mean
from facerelight.numerics.luminance import LUMINANCE
from facerelight.train.dataset import make_dataset

__all__ = ["ROWS", "Surrounded", "SurroundedHeads", "measure_head", "one_gain", "render_heads", "surroundings"]

ROWS = ("average face", "one lamp", "quotient", "estimated", "labelled", "labelled, front")
DIRECTIONS = 256  # over the whole sphere, 8 degrees apart
BRIGHT = 0.995  # quantile of a picture that is exposed to white
EVERY = 4  # of the single lights one is asked for its interval
GATHERED_AT_ONCE = 2048


class Surrounded(NamedTuple):
    """One surrounding: ``truth (256,)``, amounts of the directions that heads were rendered under; ``light``, the same
    as the package reads it, amounts ``(1, 80)``."""

    truth: Tensor
    light: LightSum


class SurroundedHeads(NamedTuple):
    """``single (N, Q, H, W)`` under the lights asked for and ``sphere (N, 256, H, W)`` under directions all around."""

    single: Tensor
    sphere: Tensor


def surroundings(maps: Mapping[str, Tensor]) -> dict[str, Surrounded]:
    """The surroundings of ``maps (H, W, 3)``, linear, by name: as strong in both forms."""
    places, luma = even_sphere(DIRECTIONS), torch.tensor(LUMINANCE)
    found = {}
    for name, radiance in maps.items():
        light = LightSum.of(environment_light(radiance))
        height = len(radiance)
        towards = map_directions(height, radiance.shape[1]).float().flatten(0, 1)
        nearest = torch.cat([nearest_lights(part, places) for part in towards.split(GATHERED_AT_ONCE)])
        edge = torch.pi * torch.arange(height + 1) / height
        solid = (edge[:-1].cos() - edge[1:].cos()).repeat_interleave(radiance.shape[1])
        truth = torch.zeros(DIRECTIONS).index_add(0, nearest, solid * (radiance @ luma).flatten())
        found[name] = Surrounded(truth * (light.amounts.sum() / truth.sum()), light)
    return found


def render_heads(config: TrainConfig, targets: Tensor) -> SurroundedHeads:
    """All heads of ``config`` under ``targets (Q, 3)`` and all around."""
    lights = torch.cat((targets, even_sphere(DIRECTIONS)))
    images = make_dataset(config, lights).images()
    return SurroundedHeads(images[:, : len(targets)], images[:, len(targets) :])


def measure_head(
    relighter: StatisticalRelighter,
    heads: SurroundedHeads,
    index: int,
    targets: Tensor,
    places: Mapping[str, Surrounded],
    draws: int,
) -> dict[tuple[str, str, str], dict[str, float]]:
    """Errors of one head by surrounding, row of :data:`ROWS` and what is asked for, "single" lights or other
    "surroundings": root mean square in grey levels and SSIM after one gain for all, and of single lights percent inside
    the 95 % interval.

    Args:
        relighter: with an estimator of sums of lights.
        heads: rendered.
        index: which head.
        targets: ``(Q, 3)``, the single lights.
        places: the surroundings.
        draws: of an estimated light.
    """
    statistics, single, sphere = relighter.statistics, heads.single[index], heads.sphere[index]
    average = prior_mean(statistics, statistics.lights).unflatten(1, statistics.size).clamp_min(0)
    everywhere, found = torch.ones(statistics.size), {}
    pictures = {name: torch.tensordot(place.truth, sphere, 1) for name, place in places.items()}
    white = {name: picture.quantile(BRIGHT).clamp_min(1e-6) for name, picture in pictures.items()}
    pictures = {name: picture / white[name] for name, picture in pictures.items()}
    for name, place in places.items():
        photo = (pictures[name].clamp(0, 1) * 255).round() / 255
        light = LightSum(place.light.directions, place.light.amounts / white[name])
        others = [other for other in places if other != name]
        amounts = torch.stack([places[other].truth / white[other] for other in others])
        around = LightSum(even_sphere(DIRECTIONS), amounts)
        asked = {
            "single": (LightSum.single(targets), single),
            "surroundings": (around, torch.stack([pictures[other] for other in others])),
        }
        rough = fit_soft_light(average, photo, everywhere)
        equivalent, lamp = brought_to_one_lamp(statistics, average, rough, photo)
        middle = normalize(light.amounts @ light.directions, dim=1)
        ahead = (light.directions[:, 2] >= 0).to(photo)
        posteriors = {
            "one lamp": relighter.condition(photo[None, None], nearest_side(middle)),
            "quotient": relighter.condition(equivalent[None, None], lamp),
            "estimated": relighter.condition(photo[None, None], None, draws=draws),
            "labelled": relighter.condition(photo[None, None], light),
            "labelled, front": relighter.condition(
                photo[None, None], LightSum(light.directions, light.amounts * ahead)
            ),
        }
        for what, (lights, truth) in asked.items():
            bare = prior_mean(statistics, lights).unflatten(1, statistics.size).clamp_min(0)
            found[name, "average face", what] = one_gain(bare, truth)
            for row, posterior in posteriors.items():
                scores = one_gain(posterior.mean(lights)[0], truth)
                if row not in ("one lamp", "quotient") and what == "single":
                    mean, variance = posterior.render(targets[::EVERY])
                    inside = inside_interval(mean[0], variance[0], truth[::EVERY])
                    scores["coverage95"] = 100 * float(inside.mean())
                found[name, row, what] = scores
    return found


def one_gain(relit: Tensor, truth: Tensor) -> dict[str, float]:
    """``rmse`` in grey levels and ``ssim`` of ``relit (Q, H, W)``, after one gain for all."""
    gain = (relit * truth).sum() / relit.square().sum().clamp_min(1e-9)
    shown, wanted = (gain * relit).clamp(0, 1), truth.clamp(0, 1)
    error = ((shown - wanted) * 255).square().mean((1, 2)).sqrt()
    similar = ssim(shown[:, None], wanted[:, None], 11, padding="same").mean((1, 2, 3))
    return {"rmse": float(error.mean()), "ssim": float(similar.mean())}
