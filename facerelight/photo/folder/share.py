"""A folder shared out among the processes of ``torchrun``, as heads are in training: each takes every N-th photo."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import NamedTuple, TypeVar

__all__ = ["Share", "join_processes"]

PATIENCE = timedelta(hours=6)  # the first to be done wait for the others, whose photos may be larger
SET_BY_TORCHRUN = ("WORLD_SIZE", "RANK", "MASTER_ADDR")
Item = TypeVar("Item")


class Share(NamedTuple):
    """Process number ``rank`` of ``processes``.

    Example:
        >>> Share(1, 3).of("abcdefg")
        ['b', 'e']
    """

    rank: int = 0
    processes: int = 1

    def of(self, items: Sequence[Item]) -> list[Item]:
        """What this process does of ``items``, which all processes have in one order."""
        return list(items[self.rank :: self.processes])

    def wait(self) -> None:
        """Until all processes are here.

        Raises:
            RuntimeError: one of them has ended, or does not come.
        """
        if self.processes > 1:
            from torch import distributed

            try:
                distributed.barrier()
            except RuntimeError as error:
                said = f"expected all {self.processes} within {PATIENCE}, got {error}; --resume goes on"
                raise RuntimeError(f"processes: {said}") from error


@contextmanager
def join_processes() -> Iterator[Share]:
    """This process's share, of what ``torchrun`` sets in the environment, as long as the block runs; all of it where
    ``WORLD_SIZE``, ``RANK`` or ``MASTER_ADDR`` is not set.

    Raises:
        ValueError: numbers there that are none, or a rank beyond them.
    """
    if any(not os.environ.get(name) for name in SET_BY_TORCHRUN):
        yield Share()
        return
    processes = _number("WORLD_SIZE", 1, None)
    _number("RANK", 0, processes - 1)
    if processes < 2:
        yield Share()
        return
    from torch import distributed

    if distributed.is_initialized():  # by the program that calls
        yield Share(distributed.get_rank(), distributed.get_world_size())
        return
    distributed.init_process_group("gloo", timeout=PATIENCE)
    try:
        yield Share(distributed.get_rank(), distributed.get_world_size())
    finally:
        distributed.destroy_process_group()


def _number(name: str, least: int, most: int | None) -> int:
    text = os.environ[name].strip()
    number = int(text) if text.isdecimal() else -1
    if number < least or (most is not None and number > most):
        bounds = f"of at least {least}" if most is None else f"from {least} to {most}"
        said = f"expected a whole number {bounds} in the environment, got {text!r}"
        raise ValueError(f"{name}: {said}; torchrun sets it, and without it all is done here")
    return number
