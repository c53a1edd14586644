"""Lamps that move: where they stand at which second, and on the sphere between."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from facerelight.geometry.lights import angles_from_light, light_from_angles
from facerelight.geometry.sources import Lamp, LightMixture
from facerelight.photo.scenes import parse_lamp

__all__ = ["MovingLamp", "lamps_at", "largest_step", "take_moving"]

Source = Lamp | LightMixture
OPPOSITE = -0.9998  # cosine: no shortest way leads from a place to the one opposite


class Stand(NamedTuple):
    """``lamp`` as it is at ``time``, seconds from the film's start."""

    time: float
    lamp: Lamp


KEYFRAME = "AZIMUTH,ELEVATION,at=SECONDS[,lamp=NAME]"


class MovingLamp:
    """A lamp along keyframes: it takes the shortest way over the sphere, size, power and colour (linear) change evenly;
    before the first and behind the last it stands still.

    Args:
        stands: in any order.

    Raises:
        ValueError: none, two at one time, or two opposite ones after each other.

    Example:
        >>> lamp = MovingLamp([(0.0, Lamp(-60, 0)), (2.0, Lamp(60, 0, power=3))])
        >>> round(lamp.at(1.0).azimuth), lamp.at(1.0).power, lamp.at(9.0).azimuth
        (0, 2.0, 60)
    """

    def __init__(self, stands: Sequence[tuple[float, Lamp]]) -> None:
        self.stands = sorted((Stand(*stand) for stand in stands), key=lambda stand: stand.time)
        if not self.stands:
            raise ValueError("lamp: expected at least one keyframe, got none")
        for one, two in zip(self.stands, self.stands[1:], strict=False):
            if one.time == two.time:
                raise ValueError(f"lamp: expected one place for every second, got two at {one.time:g} s")
            if float(_towards(one.lamp) @ _towards(two.lamp)) < OPPOSITE:
                places = f"{one.lamp.azimuth:g},{one.lamp.elevation:g} and {two.lamp.azimuth:g},{two.lamp.elevation:g}"
                raise ValueError(f"lamp: expected a keyframe between {places}, which are opposite: any way leads there")

    def at(self, time: float) -> Lamp:
        """The lamp at a ``time`` in seconds."""
        behind = bisect.bisect_right([stand.time for stand in self.stands], time)
        if behind == 0 or behind == len(self.stands):
            return self.stands[max(behind - 1, 0)].lamp
        one, two = self.stands[behind - 1], self.stands[behind]
        share = (time - one.time) / (two.time - one.time)

        def between(a: float, b: float) -> float:
            return (1 - share) * a + share * b

        a, b = _towards(one.lamp), _towards(two.lamp)
        angle = math.acos(max(-1.0, min(1.0, float(a @ b))))
        ways = (1 - share, share) if angle < 1e-6 else (math.sin((1 - share) * angle), math.sin(share * angle))
        azimuth, elevation = angles_from_light(torch.nn.functional.normalize(ways[0] * a + ways[1] * b, dim=0))
        size, power = between(one.lamp.size, two.lamp.size), between(one.lamp.power, two.lamp.power)
        red, green, blue = (between(*pair) for pair in zip(one.lamp.colour, two.lamp.colour, strict=True))
        return Lamp(float(azimuth), float(elevation), size, power, (red, green, blue))


def take_moving(texts: Sequence[str], size: float = 5.0) -> tuple[list[MovingLamp], list[str]]:
    """The lamps that move among ``texts`` of a command line, and the texts that are left: what has ``at=SECONDS`` is a
    keyframe of one lamp, or of several that ``lamp=NAME`` tells apart.

    Raises:
        ValueError: another text, or keyframes that are no way.

    Example:
        >>> moving, still = take_moving(["-60,20,at=0", "60,20,at=5,size=10", "0,40,power=0.2"])
        >>> len(moving[0].stands), still
        (2, ['0,40,power=0.2'])
    """
    stands: dict[str, list[tuple[float, Lamp]]] = {}
    still = []
    for text in texts:
        parts = [part.partition("=") for part in text.split(",")]
        named = {name.strip().lower(): value.strip() for name, equals, value in parts if equals}
        rest = ",".join("".join(part) for part in parts if part[0].strip().lower() not in ("at", "lamp"))
        if "at" not in named:
            if "lamp" in named:
                raise ValueError(f"light: expected {KEYFRAME}, got {text!r} without at=")
            still.append(text)
            continue
        try:
            time = float(named["at"])
            if not (math.isfinite(time) and time >= 0):
                raise ValueError
        except ValueError:
            raise ValueError(f"light: expected {KEYFRAME}, the seconds from the film's start, got {text!r}") from None
        stands.setdefault(named.get("lamp", ""), []).append((time, parse_lamp(rest, size)))
    return [MovingLamp(one) for one in stands.values()], still


def lamps_at(lamps: Sequence[Source | MovingLamp], time: float) -> list[Source]:
    """All ``lamps`` as they are at a ``time``."""
    return [lamp.at(time) if isinstance(lamp, MovingLamp) else lamp for lamp in lamps]


def largest_step(one: Sequence[Source], two: Sequence[Source]) -> float:
    """Degrees by which the lamp that moved most moved, from ``one`` to ``two``; a change of size, power or colour by a
    tenth counts as a degree."""
    most = 0.0
    for a, b in zip(one, two, strict=True):
        if isinstance(a, Lamp) and isinstance(b, Lamp) and a != b:
            cosine = max(-1.0, min(1.0, float(_towards(a) @ _towards(b))))
            values = ((a.power, b.power), (a.size, b.size), *zip(a.colour, b.colour, strict=True))
            changed = max(abs(x - y) / max(abs(x), abs(y), 0.05) for x, y in values)
            most = max(most, math.degrees(math.acos(cosine)), 10 * changed)
    return most


def _towards(lamp: Lamp) -> torch.Tensor:
    return light_from_angles(float(lamp.azimuth), float(lamp.elevation)).double()
