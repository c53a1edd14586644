"""Relighting measured on photographs with known lights: protocols, baselines and errors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from kornia.filters import gaussian_blur2d
from kornia.metrics import ssim
from torch import Tensor

from facerelight.evaluation.datasets import FaceImages, to_grid
from facerelight.geometry.lights import angular_distance
from facerelight.inference.detail import keep_detail
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.luminance import MEASURED_FLOOR, SHADOW

__all__ = [
    "SOURCES",
    "Scores",
    "baseline_images",
    "evaluate_folds",
    "held_out_lights",
    "inside_interval",
    "relighting_errors",
]

SOURCES = {"front": (0.0, 0.0), "side": (70.0, 0.0)}
"""Azimuth and elevation of the input image's light, by the name of the case."""

REACH_95 = 1.959964  # standard deviations
EVERY = 8  # of the targets, one in so many is asked for its interval: a variance costs as much as conditioning


class Scores(NamedTuple):
    """Per relit image: ``rmse (M,)`` in grey levels after clamping to 0..255, ``ssim (M,)``, ``subset (M,)``,
    ``shadow (M,)`` RMSE inside the input's shadow (NaN where the target is not frontal), ``inside (M,)`` share of
    pixels within the central 95 % interval (NaN where it was not asked for)."""

    rmse: Tensor
    ssim: Tensor
    subset: Tensor
    shadow: Tensor
    inside: Tensor

    def summary(self) -> dict[str, object]:
        """Means over images, in all and by subset."""
        parts = sorted(set(self.subset.tolist()))
        return {
            "rmse": round(float(self.rmse.mean()), 3),
            "ssim": round(float(self.ssim.mean()), 4),
            "by_subset": {str(s): round(float(self.rmse[self.subset == s].mean()), 3) for s in parts},
            "shadow_rmse_frontal": round(float(self.shadow.nanmean()), 3),
            **({} if self.inside.isnan().all() else {"coverage95": round(100 * float(self.inside.nanmean()), 1)}),
            "images": len(self.rmse),
        }


def held_out_lights(faces: FaceImages) -> Tensor:
    """The lights that **yale-relight-newlights** keeps out of the statistics, ``(J,)`` bool: every fifth, never a
    source light."""
    out = torch.zeros(len(faces.lights), dtype=torch.bool)
    out[2::5] = True  # the lights come sorted by azimuth, then elevation
    for angles in SOURCES.values():
        out[_light_index(faces, angles)] = False
    return out


def _light_index(faces: FaceImages, angles: tuple[float, float]) -> int:
    match = (faces.angles - torch.tensor(angles)).abs().amax(1) < 0.5
    if not match.any():
        raise ValueError(
            f"lights: expected one at azimuth {angles[0]:g}, elevation {angles[1]:g} in the data, got none"
        )
    return int(match.nonzero()[0, 0])


def _score(relit: Tensor, truth: Tensor, subset: Tensor, source: Tensor, frontal: Tensor) -> Scores:
    relit = relit.clamp(0, 1)
    error = (relit - truth) * 255
    rmse = error.square().mean((1, 2)).sqrt()
    similarity = ssim(relit[:, None], truth[:, None], 11, padding="same").mean((1, 2, 3))
    dark = source < SHADOW
    shadow = torch.full_like(rmse, torch.nan)
    if dark.any() and frontal.any():
        shadow[frontal] = error[frontal][:, dark].square().mean(1).sqrt()
    return Scores(rmse, similarity, subset, shadow, torch.full_like(rmse, torch.nan))


def inside_interval(mean: Tensor, variance: Tensor, truth: Tensor) -> Tensor:
    """Share of the pixels of ``truth (Q, H, W)`` within the central 95 % interval, ``(Q,)``."""
    return ((truth - mean).square() <= REACH_95**2 * variance).double().mean((1, 2)).to(truth)


def baseline_images(mean_images: Tensor, source: Tensor, source_index: int, targets: Tensor) -> dict[str, Tensor]:
    """What one does without a model: copy the input; the average face; the input times the ratio of smoothed average
    faces.

    Args:
        mean_images: ``(J, H, W)``, the bootstrap's average face under each light.
        source: ``(H, W)``, the input.
        source_index: its light.
        targets: ``(Q,)`` indices of the target lights.
    """
    smooth = gaussian_blur2d(mean_images[:, None], (9, 9), (2.0, 2.0))[:, 0]
    ratio = (smooth[targets] + MEASURED_FLOOR) / (smooth[source_index] + MEASURED_FLOOR)
    return {
        "copy": source.expand(len(targets), -1, -1),
        "mean_face": mean_images[targets],
        "ratio_image": source * ratio,
    }


def relighting_errors(statistics: FaceStatistics, faces: FaceImages, case: str, detail: float = 0.0) -> Tensor:
    """RMSE in grey levels of every person's image under every other light, ``(people, J)``, NaN where there is none;
    whole-face model.

    Args:
        statistics: of other people, or of rendered heads.
        faces: the data.
        case: "front" or "side", the input's light.
        detail: how much of the input's fine detail relit images keep, see
            :func:`facerelight.inference.detail.keep_detail`.
    """
    images, valid = to_grid(faces)
    source = _light_index(faces, SOURCES[case])
    relighter = StatisticalRelighter(statistics, "face")
    errors = torch.full(valid.shape, torch.nan)
    for person in valid[:, source].nonzero()[:, 0].tolist():
        targets = valid[person].clone()
        targets[source] = False
        photo = images[person, source]
        relit = relighter.condition(photo[None, None], faces.lights[source][None]).mean(faces.lights[targets])[0]
        relit = keep_detail(relit, photo, detail)
        errors[person, targets] = ((relit.clamp(0, 1) - images[person, targets]) * 255).square().mean((1, 2)).sqrt()
    return errors


def evaluate_folds(
    faces: FaceImages,
    folds: int,
    make: Callable[[Tensor, Tensor, Tensor], FaceStatistics],
    covariances: list[str],
    new_lights: bool = False,
    estimated: bool = False,
    register: bool = False,
    detail: float = 0.0,
) -> tuple[dict[str, dict[str, Scores]], dict[str, float]]:
    """Protocols **yale-relight** and **yale-relight-newlights**.

    Subjects are sorted; fold f tests those of rank f modulo ``folds`` with statistics made by
    ``make(images, lights, valid)`` from the rest.

    Args:
        faces: photographs under labelled lights.
        folds: how many.
        make: learns (or returns) statistics.
        covariances: models to score: "pixel", "face".
        new_lights: learn without the lights that are then asked for.
        estimated: estimate the input's light instead of taking its label.
        register: find where each face lies beside the model's.
        detail: how much of the input's fine detail relit images keep, see
            :func:`facerelight.inference.detail.keep_detail`.

    Returns:
        Scores by case ("front", "side") and method (the covariances and the baselines), and figures about light
        estimation.
    """
    images, valid = to_grid(faces)
    held_out = held_out_lights(faces) if new_lights else torch.zeros(len(faces.lights), dtype=torch.bool)
    subset = torch.zeros(len(faces.lights), dtype=torch.long).index_copy_(0, faces.light, faces.subset)
    frontal = angular_distance(faces.lights, torch.tensor((0.0, 0.0, 1.0)).expand_as(faces.lights)) < 1
    scores: dict[str, dict[str, list[Scores]]] = {}
    angles: list[Tensor] = []
    for train, test in _split(len(images), folds):
        statistics = make(images[train][:, ~held_out], faces.lights[~held_out], valid[train][:, ~held_out])
        estimator = LikelihoodIlluminationEstimator(statistics)
        mean = (images[train] * valid[train][..., None, None]).sum(0) / valid[train].sum(0).clamp_min(1)[:, None, None]
        for person in test:
            for kept in valid[person].nonzero()[:, 0]:
                found = estimator(images[person, kept][None, None]).direction[0, 0]
                angles.append(angular_distance(found, faces.lights[kept]))
        for covariance in covariances:
            relighter = StatisticalRelighter(statistics, covariance, estimator)  # type: ignore[arg-type]
            for case, source_angles in SOURCES.items():
                source = _light_index(faces, source_angles)
                for person in test:
                    targets = valid[person] & (held_out if new_lights else True)
                    targets[source] = False
                    if not valid[person, source] or not targets.any():
                        continue
                    index = targets.nonzero()[:, 0]
                    given = None if estimated else faces.lights[source][None]
                    image = images[person, source][None, None]
                    posterior = relighter.condition(image, given, register=register)
                    made = posterior.mean(faces.lights[index])[0]
                    results = {covariance: keep_detail(made, image[0, 0], detail)}
                    if covariance == covariances[0]:
                        results |= baseline_images(mean, image[0, 0], source, index)
                    for name, relit in results.items():
                        scored = _score(relit, images[person, index], subset[index], image[0, 0], frontal[index])
                        if name == covariance:
                            asked = index[::EVERY]
                            sure = posterior.variance(faces.lights[asked])[0]
                            scored.inside[::EVERY] = inside_interval(made[::EVERY], sure, images[person, asked])
                        scores.setdefault(case, {}).setdefault(name, []).append(scored)
    joined = {
        case: {name: Scores(*map(torch.cat, zip(*parts, strict=True))) for name, parts in by.items()}
        for case, by in scores.items()
    }
    error = torch.stack(angles)
    return joined, {"median_deg": round(float(error.median()), 2), "mean_deg": round(float(error.mean()), 2)}


def _split(count: int, folds: int) -> Iterator[tuple[list[int], list[int]]]:
    for fold in range(folds):
        yield [i for i in range(count) if i % folds != fold], [i for i in range(count) if i % folds == fold]
