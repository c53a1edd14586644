"""Rank and temper of the whole-face model chosen by cross-validation: relighting people who were left out of the
bootstrap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.lights import light_from_angles, nearest_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.learning import FitOptions
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.checks import check_radiance, check_valid

__all__ = ["Choice", "choose_face_options"]

SOURCES = ((0.0, 0.0), (70.0, 0.0), (-70.0, 0.0), (0.0, 45.0))
"""Lights of the inputs, azimuth and elevation; the nearest bootstrap lights are taken."""


class Choice(NamedTuple):
    """``options`` with the best rank and temper, and ``errors``: RMSE in radiance by (rank, temper)."""

    options: FitOptions
    errors: dict[tuple[int, float], float]


def choose_face_options(
    images: Tensor,
    lights: Tensor,
    valid: Tensor | None = None,
    options: FitOptions | None = None,
    ranks: Sequence[int] = (10, 20, 40, 80),
    tempers: Sequence[float] = (10.0, 30.0, 100.0, 300.0, 1000.0),
    folds: int = 4,
) -> Choice:
    """Try every rank and temper on left-out people, one input image each, all their other images as targets.

    Args:
        images: ``(N, J, H, W)`` of the bootstrap; people in turn are left out.
        lights: ``(J, 3)``.
        valid: ``(N, J)``, which images exist; None: all.
        options: everything else about the fit.
        ranks: to try; those that the people left in cannot support are skipped.
        tempers: to try.
        folds: groups of people left out in turn.

    Example:
        >>> lights = torch.nn.functional.normalize(torch.randn(6, 3) + torch.tensor([0, 0, 2.0]), dim=1)
        >>> choice = choose_face_options(torch.rand(8, 6, 8, 7), lights, ranks=(1, 2), tempers=(1.0, 10.0), folds=2)
        >>> choice.options.face_rank in (1, 2)
        True
    """
    check_radiance(images, "images", "N J H W", (len(lights), None, None), missing=True)
    if valid is not None:
        valid = check_valid(valid, "valid", "N J", images.shape[:2])
    options = options or FitOptions()
    there = torch.ones(images.shape[:2], dtype=torch.bool) if valid is None else valid
    least = min(len(images) - len(images[fold::folds]) for fold in range(folds)) - 2
    usable = sorted({min(rank, least) for rank in ranks})
    if usable[0] < 1:
        raise ValueError(
            f"images: expected enough people to leave out one of {folds} groups and learn from 3 or more,"
            f" got {len(images)}"
        )
    sources = nearest_lights(torch.stack([light_from_angles(*angles) for angles in SOURCES]), lights).unique().tolist()
    totals: dict[tuple[int, float], list[float]] = {}
    for fold in range(folds):
        out = torch.arange(len(images)) % folds == fold
        for rank in usable:
            statistics = FaceStatistics.fit(images[~out], lights, there[~out], replace(options, face_rank=rank))
            relighter = StatisticalRelighter(statistics, "face")
            assert statistics.face is not None
            for temper in tempers:
                statistics.face.temper.fill_(temper)
                for person, kept in zip(images[out], there[out], strict=True):
                    found = [_error(relighter, person, lights, kept, source) for source in sources]
                    totals.setdefault((rank, temper), []).extend(error for error in found if error is not None)
    errors = {key: (sum(squares) / len(squares)) ** 0.5 for key, squares in totals.items()}
    rank, temper = min(errors, key=errors.__getitem__)
    return Choice(replace(options, face_rank=rank, temper=temper), errors)


def _error(relighter: StatisticalRelighter, person: Tensor, lights: Tensor, valid: Tensor, source: int) -> float | None:
    """Mean square error of ``person (J, H, W)``, relit from the image under light ``source`` to all others; None where
    that is missing."""
    targets = valid.clone()
    targets[source] = False
    if not valid[source] or not targets.any():
        return None
    relit = relighter.condition(person[None, source : source + 1], lights[source : source + 1]).mean(lights[targets])[0]
    return float((relit.clamp(0, 1) - person[targets]).square().mean())
