"""The fast path beside the exact one: how far relit crops are apart, and what a batch costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import torch
from torch import Tensor

from facerelight.augment.crop_relighter import CropRelighter
from facerelight.augment.random_face_relight import RandomFaceRelight

__all__ = ["batch_seconds", "relit_apart"]


@torch.no_grad()
def relit_apart(
    crops: Tensor, fast: Mapping[str, CropRelighter], exact: CropRelighter, seed: int = 0
) -> dict[str, Tensor]:
    """How far crops relit by each of ``fast`` are from those of ``exact``: root mean square differences ``(B',)`` in
    grey levels, of those that both take for lit faces.

    Args:
        crops: ``(B, 1, H, W)`` linear radiance in Yale B's frame; each is relit by a random lamp and a fill.
        fast, exact: what relights them.
        seed: of the lamps.
    """
    torch.manual_seed(seed)
    options: dict[str, Any] = {"mix": (0.0, 0.0), "encoding": "linear", "p": 1.0}
    relight = RandomFaceRelight("yale", relighter=exact, **options)
    truth, params = relight(crops), relight._params
    known = params["relit"]
    apart = {}
    for name, relighter in fast.items():
        made = RandomFaceRelight("yale", relighter=relighter, **options)(crops, params=params)
        both = known & params["relit"]
        apart[name] = 255 * (made - truth)[both].square().mean((1, 2, 3)).sqrt()
    return apart


def batch_seconds(calls: Mapping[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Median seconds of each of ``calls``, taken in turn ``rounds`` times after one that does not count."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(rounds + 1):
        for name, call in calls.items():
            begun = time.perf_counter()
            call()
            if number:
                taken[name].append(time.perf_counter() - begun)
    return {name: median(seconds) for name, seconds in taken.items()}
