"""The fast path beside the exact one: how far relit crops are apart, and what a batch costs."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from statistics import median

import torch
from torch import Tensor

from facerelight.augment.crop_relighter import CropRelighter
from facerelight.augment.random_face_relight import RandomFaceRelight

__all__ = ["batch_seconds", "relit_apart"]


@torch.no_grad()
def relit_apart(crops: Tensor, fast: CropRelighter, exact: CropRelighter, seed: int = 0) -> Tensor:
    """Root mean square difference of relit crops, ``(B',)`` in grey levels, of those that both take for lit faces.

    Args:
        crops: ``(B, 1, H, W)`` linear radiance in Yale B's frame; each is relit by a random lamp alone.
        fast, exact: what relights them.
        seed: of the lamps.
    """
    torch.manual_seed(seed)
    made = []
    params: dict[str, Tensor] | None = None
    known = torch.ones(len(crops), dtype=torch.bool)
    for relighter in (exact, fast):
        relight = RandomFaceRelight("yale", mix=(0.0, 0.0), encoding="linear", relighter=relighter, p=1.0)
        made.append(relight(crops, params=params))
        params = relight._params
        known = known & params["relit"]
    return 255 * (made[0] - made[1])[known].square().mean((1, 2, 3)).sqrt()


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
