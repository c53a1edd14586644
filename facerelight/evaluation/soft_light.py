"""Relighting photographs that many lights made: protocol *yale-soft*.

Light adds up, so sums of real photographs of a head that kept still are real photographs under several lights. Each of
five lights makes one input a person; every single light of the person is then asked for, the soft-to-hard direction,
which is the difficult one. As a second table the five lights are asked for, given the photograph under the frontal
flash.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from kornia.metrics import ssim
from torch import Tensor

from facerelight.evaluation.datasets import FaceImages, to_grid
from facerelight.evaluation.relighting import EVERY, inside_interval
from facerelight.geometry.sums import LightSum
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.soft import fit_soft_light, one_lamp_quotient
from facerelight.model.covariance import prior_mean
from facerelight.model.statistics import FaceStatistics

__all__ = ["SoftScores", "brought_to_one_lamp", "evaluate_soft_light", "soft_lights"]

Make = Callable[[Tensor, Tensor, Tensor], FaceStatistics]


class SoftScores(NamedTuple):
    """Per relit image: ``rmse (M,)`` in grey levels and ``ssim (M,)``, after one gain a person; ``coverage (M',)``, the
    share of pixels inside the central 95 % interval, no gain fitted."""

    rmse: Tensor
    ssim: Tensor
    coverage: Tensor

    def summary(self) -> dict[str, float]:
        """Means over images; the coverage in percent where there is one."""
        found = {"rmse": round(float(self.rmse.mean()), 2), "ssim": round(float(self.ssim.mean()), 4)}
        return found | ({"coverage95": round(100 * float(self.coverage.mean()), 1)} if len(self.coverage) else {})


def soft_lights(angles: Tensor, lights: Tensor) -> dict[str, Tensor]:
    """The protocol's five lights as amounts ``(J,)`` of the single lights at ``angles (J, 2)`` degrees, ``lights (J,
    3)``; not yet normalised.

    Example:
        >>> from facerelight.geometry.lights import light_from_angles
        >>> soft_lights(torch.zeros(1, 2), light_from_angles(torch.zeros(1), torch.zeros(1)))["overcast"]
        tensor([1.])
    """
    azimuth, elevation = angles.unbind(1)

    def lobe(a: float, e: float, width: float) -> Tensor:
        return torch.exp(-((azimuth - a) ** 2 + (elevation - e) ** 2) / (2 * width**2))

    return {
        "window": lobe(45, 10, 35),
        "overhead": lobe(0, 60, 35),
        "key_fill": lobe(40, 20, 12) + 0.4 * lobe(-50, 0, 15),
        "overcast": lights[:, 2].clamp_min(0),
        "two_sides": lobe(85, 0, 15) + lobe(-85, 0, 15),
    }


def evaluate_soft_light(
    faces: FaceImages,
    folds: int,
    make: Make,
    estimated: bool = False,
    register: bool = False,
    draws: int = 16,
) -> dict[str, dict[str, SoftScores]]:
    """Protocol **yale-soft**.

    Args:
        faces: photographs under labelled single lights.
        folds: how many; fold f tests the people of rank f modulo ``folds``.
        make: learns (or returns) statistics from ``images, lights, valid`` of the others.
        estimated: estimate the amounts instead of taking the true ones.
        register: find where each face lies beside the model's.
        draws: samples of an estimated light.

    Returns:
        Scores by row and light: "exact", the posterior under the whole light; "quotient", the photograph brought to one
        lamp by the quotient of average faces; "one_lamp", its light taken for one lamp; "average_face"; and
        "from_front", the five lights as targets.
    """
    images, valid = to_grid(faces)
    mixed = soft_lights(faces.angles, faces.lights)
    scores: dict[str, dict[str, list[SoftScores]]] = {}

    def add(row: str, light: str, relit: Tensor, truth: Tensor, coverage: Tensor | None = None) -> None:
        scores.setdefault(row, {}).setdefault(light, []).append(_score(relit, truth, coverage))

    for fold in range(folds):
        out = torch.arange(len(images)) % folds == fold
        statistics = make(images[~out], faces.lights, valid[~out])
        relighter = StatisticalRelighter(statistics, "face", SoftLightEstimator(statistics))
        average = prior_mean(statistics, faces.lights).unflatten(1, statistics.size).clamp_min(0)
        for person, kept in zip(images[out], valid[out], strict=True):
            targets, truth = faces.lights[kept], person[kept]
            for name, amounts in mixed.items():
                true = amounts * kept / (amounts * kept).sum()
                photo = torch.tensordot(true, person, 1)
                given = None if estimated else LightSum(faces.lights, true[None])
                posterior = relighter.condition(photo[None, None], given, draws=draws, register=register)
                add("exact", name, posterior.mean(targets)[0], truth, _covered(posterior, targets, truth))
                rough = fit_soft_light(average, photo, torch.ones_like(photo)) if estimated else true
                equivalent, middle = brought_to_one_lamp(statistics, average, rough, photo)
                for row, image in (("quotient", equivalent), ("one_lamp", photo)):
                    single = relighter.condition(image[None, None], middle, register=register)
                    add(row, name, single.mean(targets)[0], truth)
                add("average_face", name, average[kept], truth)
            _from_front(relighter, faces, person, kept, mixed, register, estimated, add)
    return {
        row: {light: SoftScores(*map(torch.cat, zip(*parts, strict=True))) for light, parts in by.items()}
        for row, by in scores.items()
    }


def _from_front(
    relighter: StatisticalRelighter,
    faces: FaceImages,
    person: Tensor,
    kept: Tensor,
    mixed: dict[str, Tensor],
    register: bool,
    estimated: bool,
    add: Callable[..., None],
) -> None:
    """The second table: the five lights as targets from the frontal flash."""
    front = int((faces.lights[:, 2] * kept).argmax())
    amounts = torch.stack([light * kept / (light * kept).sum() for light in mixed.values()])
    given = None if estimated else faces.lights[front][None]
    posterior = relighter.condition(person[front][None, None], given, register=register)
    relit, truth = posterior.mean(LightSum(faces.lights, amounts))[0], torch.tensordot(amounts, person, 1)
    relit = relit * _gain(relit, truth)
    for index, name in enumerate(mixed):
        add("from_front", name, relit[index][None], truth[index][None])


def brought_to_one_lamp(
    statistics: FaceStatistics, average: Tensor, amounts: Tensor, photo: Tensor
) -> tuple[Tensor, Tensor]:
    """``photo (H, W)`` as under one lamp in the middle of its light, by the quotient of average faces, and that lamp
    ``(1, 3)``.

    Args:
        statistics: of the average face.
        average: ``(J, H, W)``, it under each of the statistics' lights, never negative.
        amounts: ``(J,)`` of these in the photograph's light.
        photo: radiance.
    """
    strength = amounts.sum().clamp_min(1e-12)
    share = amounts / strength
    middle = torch.nn.functional.normalize(share @ statistics.lights, dim=0)[None]
    single = prior_mean(statistics, middle).view(statistics.size)
    return photo / strength * one_lamp_quotient(single, torch.tensordot(share, average, 1)), middle


def _covered(posterior: Posterior, targets: Tensor, truth: Tensor) -> Tensor:
    """The share of pixels inside the interval, of every few targets."""
    mean, variance = posterior.render(targets[::EVERY])
    return inside_interval(mean[0], variance[0], truth[::EVERY])


def _gain(relit: Tensor, truth: Tensor) -> Tensor:
    return (relit * truth).sum() / relit.square().sum().clamp_min(1e-9)


def _score(relit: Tensor, truth: Tensor, coverage: Tensor | None) -> SoftScores:
    """Of one person's images ``(Q, H, W)``, brought to the truth's brightness by one gain."""
    shown = (_gain(relit, truth) * relit).clamp(0, 1)
    rmse = ((shown - truth) * 255).square().mean((1, 2)).sqrt()
    similarity = ssim(shown[:, None], truth[:, None], 11, padding="same").mean((1, 2, 3))
    return SoftScores(rmse, similarity, rmse.new_zeros(0) if coverage is None else coverage)
