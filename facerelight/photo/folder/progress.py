"""How far a batch or a film is: a line that is written over on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from typing import TextIO

__all__ = ["Progress"]

EVERY = 0.2, 30.0  # seconds between lines, on a terminal and elsewhere


class Progress:
    """Counts photos, or other things, that ended.

    Args:
        total: of them in all, 0 where that is not known.
        stream: takes the lines.
        what: they are called.

    Example:
        >>> import io
        >>> progress = Progress(3, io.StringIO())
        >>> progress.step(failed=True)
        >>> progress.line(2.0)
        '1 of 3 photos, 1 failed, 0.5 a second, 0:04 left'
    """

    def __init__(self, total: int, stream: TextIO, what: str = "photos") -> None:
        self.total, self.stream, self.what = total, stream, what
        self.done = self.failed = 0
        self._started = self._shown = time.monotonic()

    def step(self, failed: bool = False) -> None:
        """One more has ended."""
        self.done += 1
        self.failed += failed
        now, terminal = time.monotonic(), self.stream.isatty()
        if now - self._shown < EVERY[not terminal] and not (terminal and self.done == self.total):
            return
        self._shown = now
        line = f"facerelight: {self.line(now - self._started)}"
        self.stream.write(f"\r\033[K{line}" + "\n" * (self.done == self.total) if terminal else f"{line}\n")
        self.stream.flush()

    def end(self) -> None:
        """Nothing more comes, though the total said otherwise."""
        if self.stream.isatty() and self.done != self.total:
            self.stream.write("\n")

    def line(self, seconds: float) -> str:
        """What is done after so many ``seconds``, how fast, and what time is left."""
        rate = self.done / max(seconds, 1e-9)
        left = round(max(self.total - self.done, 0) / max(rate, 1e-9))
        failed = f", {self.failed} failed" if self.failed else ""
        if not self.total:
            return f"{self.done} {self.what}{failed}, {rate:.2g} a second"
        done = f"{self.done} of {self.total} {self.what}{failed}"
        return f"{done}, {rate:.2g} a second, {left // 60}:{left % 60:02d} left"
