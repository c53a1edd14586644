"""One process at a time in a folder: the others wait, and go on when it is done or dead."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

__all__ = ["locked"]

PATIENCE = 3600.0
"""Seconds to wait for another process: more than the finest statistics take."""
PAUSE = 0.2
LOCKED_AT = 1 << 20  # where Windows locks a byte: beyond the holder's number, which others read


@contextmanager
def locked(folder: Path, patience: float = PATIENCE) -> Iterator[None]:
    """Hold ``folder``, made where it does not exist; the system lets it go when this process ends, however it does.

    Raises:
        TimeoutError: another process still holds it after ``patience`` seconds.
        RuntimeError: the process that started this one as its worker holds it, and would wait for ever.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "in_use.lock"
    with path.open("a+") as file:
        started, told = time.monotonic(), False
        while not _taken(file):
            if time.monotonic() - started > patience:
                raise TimeoutError(
                    f"{folder}: expected to train there, got another process that has done so for {patience:.0f} s;"
                    " wait for it, stop it, or choose another folder"
                )
            if "__mp_main__" in sys.modules and _holder(file) == os.getppid():
                raise RuntimeError(
                    f"{folder}: expected workers to do as they are told, got one that runs the whole script again;"
                    " put what the script does under `if __name__ == '__main__':`"
                )
            if not told:
                print(f"waiting for another process that trains in {folder}", file=sys.stderr)
                told = True
            time.sleep(PAUSE)
        file.truncate(0)
        file.write(str(os.getpid()))
        file.flush()
        yield


def _holder(file: IO[str]) -> int | None:
    """Number of the process that wrote itself into ``file``; None where that cannot be read."""
    try:
        file.seek(0)
        return int(file.read())
    except (OSError, ValueError):
        return None


def _taken(file: IO[str]) -> bool:
    """Whether this process got the lock on ``file``, at once or not at all."""
    try:
        if sys.platform == "win32":
            import msvcrt

            file.seek(LOCKED_AT)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
