"""A folder shared out among the processes of ``torchrun``, as heads are in training: each takes every N-th photo."""

from __future__ import annotations

import os
from collections.abc import Sequence
from datetime import timedelta
from typing import NamedTuple, TypeVar

__all__ = ["Share", "join_processes"]

PATIENCE = timedelta(days=30)  # the first to be done wait for the others
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
        """Until all processes are here."""
        if self.processes > 1:
            from torch import distributed

            distributed.barrier()


def join_processes() -> Share:
    """This process's share: of ``RANK`` and ``WORLD_SIZE`` that ``torchrun`` sets; without it all of it."""
    if int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return Share()
    from torch import distributed

    if not distributed.is_initialized():
        distributed.init_process_group("gloo", timeout=PATIENCE)
    return Share(distributed.get_rank(), distributed.get_world_size())
