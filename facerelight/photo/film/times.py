"""Times in a film's file that go back, as they do where recordings were joined: what follows is put behind what came
before, picture and sound alike."""

from __future__ import annotations

from fractions import Fraction

__all__ = ["Times"]

SLACK = Fraction(1, 5)  # second: what goes back by less is a fault of a single time, and no join


class Times:
    """The times of one stream, which become larger from one to the next.

    Args:
        tick: seconds of the unit in which the stream counts.
        joins: seconds by which everything behind a join is later; the streams of one film share the list, so that its
            sound stays with its pictures.
        least: units from a time to the next.

    Example:
        >>> times = Times(Fraction(1, 10), [])
        >>> [times(time) for time in (0, 2, 4, 0, 2, 2)]
        [0, 2, 4, 6, 8, 9]
        >>> times.back
        0.4
    """

    def __init__(self, tick: Fraction, joins: list[Fraction], least: int = 1) -> None:
        self.tick, self.joins, self.least = tick, joins, least
        self.back: float | None = None  # seconds from the start, after which a time went back first
        self._first: int | None = None
        self._last: int | None = None
        self._shift, self._step = 0, least

    def __call__(self, given: int | None) -> int:
        """The time to write for a ``given`` one; for None the one that is due."""
        if self._first is None or self._last is None:
            self._first = self._last = given or 0
            return self._last
        due = self._last + self._step
        time = due if given is None else given + self._shift
        if given is not None and time < self._last + self.least:
            if self.back is None:
                self.back = float((self._last - self._first) * self.tick)
            if (self._last - time) * self.tick > SLACK:
                self._shift = self._joined(given, due)
                time = given + self._shift
            time = max(time, self._last + self.least)
        else:
            self._step = time - self._last
        self._last = time
        return time

    def _joined(self, given: int, due: int) -> int:
        """By how many units what follows is later: as in another stream, or so that ``given`` is ``due``."""
        fit = [join for join in self.joins if given * self.tick + join > due * self.tick - SLACK]
        if not fit:
            fit = [(due - given) * self.tick]
            self.joins += fit
        return round(min(fit) / self.tick)
