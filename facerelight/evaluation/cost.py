"""What work costs: seconds beside those of an operation that cannot be avoided, and memory."""

from __future__ import annotations

import ctypes
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

__all__ = ["Pair", "paired", "peak_memory_mb"]


class Pair(NamedTuple):
    """Medians: ``ours`` and ``bare`` in seconds, and the ``ratio`` of those that ran in turn."""

    ours: float
    bare: float
    ratio: float


def paired(ours: Callable[[], object], bare: Callable[[], object], repeats: int = 15, bares: int = 1) -> Pair:
    """Run both in turn, so that a busy machine slows both down.

    Args:
        ours: what is measured; run once before.
        bare: what it is compared with.
        repeats: how often.
        bares: how often ``bare`` runs each time, where it is short.
    """
    ours(), bare()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        ours()
        middle = time.perf_counter()
        for _ in range(bares):
            bare()
        times.append((middle - started, (time.perf_counter() - middle) / bares))
    return Pair(
        statistics.median(a for a, _ in times),
        statistics.median(b for _, b in times),
        statistics.median(a / b for a, b in times),
    )


def peak_memory_mb(run: Callable[[], object]) -> float:
    """Resident memory that ``run`` needs on top of what is there, in MB (Linux with glibc: the high-water mark is reset
    first)."""

    def status(field: str) -> int:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) for line in file if line.startswith(field))

    # What earlier work freed goes back to the system, and does not hide what this needs.
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    before = status("VmRSS")
    run()
    return max(0, status("VmHWM") - before) / 1024
