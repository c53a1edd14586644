"""Surroundings such as a camera would capture, made up: skies, windows, rooms, streets; the same ones every time.

Each is an equirectangular map in linear radiance, of high range: a sun has thousands of times the radiance of the sky.
They are read as any other map is, by :func:`facerelight.geometry.environment.environment_light`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from facerelight.geometry.environment import map_directions
from facerelight.geometry.lights import light_from_angles

__all__ = ["environments"]

HEIGHT = 64
WARM, COOL, WHITE = (1.0, 0.72, 0.42), (0.55, 0.75, 1.0), (1.0, 1.0, 1.0)


class _Place:
    """A map in the making, ``(H, 2 H, 3)``, and what is drawn at random for it."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.towards = map_directions(HEIGHT, 2 * HEIGHT).numpy()
        self.up = self.towards[..., 1]
        self.azimuth = np.degrees(np.arctan2(-self.towards[..., 0], self.towards[..., 2]))
        self.elevation = np.degrees(np.arcsin(self.up.clip(-1, 1)))
        self.radiance = np.zeros((*self.up.shape, 3))

    def between(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def add(self, where: np.ndarray, strength: float, colour: tuple[float, ...]) -> None:
        self.radiance += where[..., None] * strength * np.array(colour)

    def disc(self, azimuth: float, elevation: float, radius: float, strength: float, colour: tuple[float, ...]) -> None:
        """A soft-edged lamp of an angular ``radius`` in degrees; at least as large as a pixel, as bright in all."""
        middle = light_from_angles(azimuth, elevation).double().numpy()
        away = np.degrees(np.arccos((self.towards @ middle).clip(-1, 1)))
        least = 180 / HEIGHT
        self.add(
            np.clip((max(radius, least) - away) / least + 0.5, 0, 1), strength * min(1, radius / least) ** 2, colour
        )

    def window(self, azimuth: float, elevation: float, size: tuple[float, float], strength: float, bars: int) -> None:
        """Daylight through a window of ``size`` (wide, high) in degrees, with ``bars``, brighter towards its top."""
        across = (self.azimuth - azimuth + 180) % 360 - 180
        x, y = across / size[0] + 0.5, (self.elevation - elevation) / size[1] + 0.5
        inside = (x > 0) & (x < 1) & (y > 0) & (y < 1)
        framed = (np.abs((x * bars) % 1 - 0.5) < 0.44) if bars else np.ones_like(x, bool)
        self.add(inside * framed * (0.5 + y.clip(0, 1)), strength, COOL if self.rng.random() < 0.5 else WHITE)

    def ground(self, strength: float, colour: tuple[float, ...]) -> None:
        self.add(np.clip(-4 * self.up, 0, 1), strength, colour)

    def walls(self, strength: float, colour: tuple[float, ...] = WHITE) -> None:
        """What walls, ceiling and floor send back, uneven."""
        phase = self.between(0, 360)
        uneven = 1 + 0.4 * np.cos(np.radians(self.azimuth - phase)) + 0.3 * self.up
        self.add(uneven.clip(0), strength, colour)


def _sky(place: _Place, sun: float, haze: float) -> None:
    """A clear sky with a sun at an elevation of ``sun`` degrees; ``haze`` in 0..1 spreads it."""
    azimuth = place.between(-80, 80)
    place.add(np.clip(0.2 + 0.8 * place.up, 0, 1) * (place.up > 0), 1.0, COOL)
    low = max(0.0, 1 - sun / 40)
    colour = tuple(np.array(WHITE) * (1 - low) + np.array(WARM) * low)
    place.disc(azimuth, sun, 0.5, 32000 * (1 - 0.9 * haze), colour)
    if haze:
        place.disc(azimuth, sun, 25 * haze, 12 * haze, colour)
    place.ground(0.3, (0.9, 0.8, 0.6))


def _overcast(place: _Place, ground: float) -> None:
    """The sky of the CIE's overcast day, three times as bright above as at the horizon."""
    place.add((1 + 2 * place.up.clip(0)) / 3 * (place.up > 0), 2.0, WHITE)
    place.ground(ground, WHITE)


def _sunset(place: _Place) -> None:
    azimuth = place.between(-100, 100)
    near = np.cos(np.radians(place.azimuth - azimuth)).clip(0) ** 3
    place.add(near * np.exp(-((place.elevation / 14) ** 2)), 6.0, (1.0, 0.5, 0.2))
    place.add((place.up > 0) * 0.5, 1.0, (0.4, 0.45, 0.8))
    place.disc(azimuth, 4, 3, 60, (1.0, 0.55, 0.2))
    place.ground(0.15, (0.6, 0.5, 0.5))


def _windows(place: _Place, count: int) -> None:
    place.walls(0.06)
    side = 1 if place.rng.random() < 0.5 else -1
    for index in range(count):
        azimuth = side * place.between(30, 95) * (1 if index % 2 == 0 else -1)
        size = (place.between(20, 60), place.between(30, 60))
        place.window(azimuth, place.between(0, 20), size, place.between(3, 8), int(place.rng.integers(0, 4)))


def _lamps(place: _Place, count: int) -> None:
    place.walls(0.08, (1.0, 0.9, 0.75))
    for _ in range(count):
        azimuth, elevation = place.between(-110, 110), place.between(5, 65)
        place.disc(azimuth, elevation, place.between(3, 9), place.between(10, 60), WARM)


def _neon(place: _Place) -> None:
    place.walls(0.03, (0.6, 0.5, 1.0))
    for colour in ((1.0, 0.1, 0.6), (0.1, 0.8, 1.0), (0.5, 1.0, 0.2)):
        azimuth, elevation = place.between(-100, 100), place.between(-15, 35)
        wide, high = place.between(8, 40), place.between(3, 12)
        across = (place.azimuth - azimuth + 180) % 360 - 180
        place.add((np.abs(across) < wide) & (np.abs(place.elevation - elevation) < high), place.between(3, 12), colour)


def _forest(place: _Place) -> None:
    place.add((place.up > 0.1) * 0.15, 1.0, (0.5, 1.0, 0.4))
    for _ in range(25):
        place.disc(place.between(-180, 180), place.between(20, 85), place.between(1, 5), place.between(5, 40), WHITE)
    place.ground(0.08, (0.7, 0.6, 0.3))


def _street(place: _Place) -> None:
    place.walls(0.02, (0.5, 0.6, 1.0))
    for azimuth in (place.between(20, 60), place.between(-140, -60), place.between(60, 170)):
        place.disc(azimuth, place.between(35, 60), 2.5, place.between(60, 160), (1.0, 0.65, 0.25))
    place.window(place.between(-60, 0), -5, (45, 20), 1.5, 3)


def _studio(place: _Place) -> None:
    place.walls(0.02)
    side = 1 if place.rng.random() < 0.5 else -1
    place.window(side * place.between(35, 55), 25, (28, 36), 12.0, 0)
    place.window(-side * place.between(40, 70), 5, (45, 60), 1.5, 0)
    place.disc(-side * 140, 30, 6, 40, WHITE)


KINDS: list[tuple[str, Callable[[_Place], None]]] = [
    ("sun, high", lambda place: _sky(place, 60, 0.0)),
    ("sun, aside", lambda place: _sky(place, 30, 0.0)),
    ("sun, low", lambda place: _sky(place, 12, 0.0)),
    ("sun, hazy", lambda place: _sky(place, 40, 1.0)),
    ("overcast, dark ground", lambda place: _overcast(place, 0.1)),
    ("overcast, snow", lambda place: _overcast(place, 1.2)),
    ("sunset", _sunset),
    ("sunset, again", _sunset),
    ("one window", lambda place: _windows(place, 1)),
    ("one window, again", lambda place: _windows(place, 1)),
    ("two windows", lambda place: _windows(place, 2)),
    ("three windows", lambda place: _windows(place, 3)),
    ("two lamps", lambda place: _lamps(place, 2)),
    ("three lamps", lambda place: _lamps(place, 3)),
    ("six lamps", lambda place: _lamps(place, 6)),
    ("neon", _neon),
    ("neon, again", _neon),
    ("forest", _forest),
    ("street at night", _street),
    ("studio", _studio),
]


def environments(seed: int = 0) -> dict[str, Tensor]:
    """Twenty maps by name, ``(64, 128, 3)`` float32, linear; each depends on its place in the list and on
    ``seed`` alone.

    Example:
        >>> maps = environments()
        >>> len(maps), maps["sunset"].shape
        (20, torch.Size([64, 128, 3]))
    """
    maps = {}
    for index, (name, make) in enumerate(KINDS):
        place = _Place(np.random.default_rng((seed, index)))
        make(place)
        maps[name] = torch.from_numpy(place.radiance.astype(np.float32))
    return maps
