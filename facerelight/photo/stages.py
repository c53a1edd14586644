"""What a render did and what it cost: only what a scene calls for is simulated, and each stage says whether it ran and
why."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

__all__ = ["Stage", "StageLog"]


class Stage(NamedTuple):
    """One stage: its ``name``, whether it ``ran``, the ``reason``, and its ``seconds``."""

    name: str
    ran: bool
    reason: str
    seconds: float


class StageLog:
    """Stages in the order in which they were reached.

    Example:
        >>> log = StageLog()
        >>> with log.measure("matte", "the picture shows more than the face"):
        ...     pass
        >>> log.stages[0].name
        'matte'
    """

    def __init__(self) -> None:
        self.stages: list[Stage] = []

    @contextmanager
    def measure(self, name: str, reason: str) -> Iterator[None]:
        """Time what is done inside."""
        started = time.perf_counter()
        yield
        self.stages.append(Stage(name, True, reason, time.perf_counter() - started))

    def forget(self, *names: str) -> None:
        """Leave out what was noted under ``names``: it is about to happen anew."""
        self.stages = [stage for stage in self.stages if stage.name not in names]

    def skip(self, name: str, reason: str) -> None:
        """Note a stage that nothing called for."""
        self.stages.append(Stage(name, False, reason, 0.0))
