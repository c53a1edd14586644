"""Points of a face steady over time: a Kalman filter of constant velocity, smoothed backwards over the frames that
follow (Rauch, Tung and Striebel 1965), so that nothing trails behind a head that moves."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

__all__ = ["PointFilter", "State"]

JITTER = 0.005  # eye distances by which a point found in pictures of one still face varies
SHAKE = 0.0015  # eye distances a frame, by which the velocity of a still face changes
SURPRISE = 6.0  # times what is expected: larger mean squares are a movement, which is followed
MOVES = np.array(((1.0, 1.0), (0.0, 1.0)))


class State(NamedTuple):
    """Of one frame, places and velocities: ``ahead (2, N)``, predicted from the frames before, with covariance
    ``ahead_cov (2, 2)``; ``now`` and ``now_cov``, with what was found in it. All coordinates share one covariance."""

    ahead: np.ndarray
    ahead_cov: np.ndarray
    now: np.ndarray
    now_cov: np.ndarray


class PointFilter:
    """Takes the points of one frame after the other.

    Example:
        >>> points = PointFilter(unit=50.0)
        >>> states = [points.step(np.array([[x, 0.0, 0.0]])) for x in (0.0, 1.0, 2.0, 3.0)]
        >>> PointFilter.smoothed(states).round(1).tolist()  # of the first frame, from all four
        [[0.0, 0.0, 0.0]]
    """

    def __init__(self, unit: float) -> None:
        """``unit``: pixels between the eyes."""
        self._noise, self._shake = (JITTER * unit) ** 2, (SHAKE * unit) ** 2
        self._last: State | None = None

    def step(self, points: np.ndarray | None) -> State:
        """The next frame's ``points (N, 3)``; None where nothing was found in it, which is bridged.

        Raises:
            ValueError: nothing found in the first frame.
        """
        if self._last is None:
            if points is None:
                raise ValueError("points: expected some in the first frame, got none")
            place = np.stack((points.ravel(), np.zeros(points.size)))
            cov = np.diag((self._noise, 25 * self._noise))
            self._last = State(place, cov, place, cov)
            return self._last
        ahead = MOVES @ self._last.now
        cov = MOVES @ self._last.now_cov @ MOVES.T + self._shake * np.array(((0.25, 0.5), (0.5, 1.0)))
        if points is None:
            self._last = State(ahead, cov, ahead, cov)
            return self._last
        missed = points.ravel() - ahead[0]
        surprise = float(np.square(missed).mean()) / (cov[0, 0] + self._noise)
        if surprise > SURPRISE:  # a movement: what was known of the place counts less
            cov = cov * surprise
        gain = cov[:, 0] / (cov[0, 0] + self._noise)
        self._last = State(ahead, cov, ahead + gain[:, None] * missed, cov - np.outer(gain, cov[0]))
        return self._last

    @staticmethod
    def smoothed(states: list[State]) -> np.ndarray:
        """The points ``(N, 3)`` of the first of ``states``, with what the others say of them."""
        later = states[-1].now
        for state, following in zip(states[-2::-1], states[:0:-1], strict=True):
            back = state.now_cov @ MOVES.T @ np.linalg.inv(following.ahead_cov)
            later = state.now + back @ (later - following.ahead)
        return later[0].reshape(-1, 3)
