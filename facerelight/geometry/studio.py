"""Set-ups that portrait photographers know by name, as lamps; mirrored, the key light stands on the other side."""

from __future__ import annotations

from dataclasses import replace

from facerelight.geometry.sources import Lamp

__all__ = ["STUDIO", "studio_lamps"]

STUDIO: dict[str, tuple[Lamp, ...]] = {
    "rembrandt": (Lamp(48, 42, size=6, power=1.2), Lamp(-60, 10, size=25, power=0.08)),
    "butterfly": (Lamp(0, 50, size=8, power=1.15), Lamp(0, -35, size=25, power=0.12)),
    "loop": (Lamp(32, 32, size=8, power=1.1), Lamp(-40, 5, size=25, power=0.2)),
    "split": (Lamp(78, 8, size=8, power=1.6),),
    "clamshell": (Lamp(0, 42, size=18, power=0.8), Lamp(0, -38, size=25, power=0.4)),
    "rim": (Lamp(140, 25, size=8, power=1.6), Lamp(-140, 25, size=8, power=1.6), Lamp(0, 10, size=25, power=0.25)),
}
"""Lamps by the name of the set-up: a triangle of light on the far cheek, a shadow under the nose, a loop of it beside
the nose, a half in shade, light from above and below, and from behind."""


def studio_lamps(name: str, mirrored: bool = False) -> tuple[Lamp, ...]:
    """The lamps of a set-up, the key light at image-left or, ``mirrored``, at image-right.

    Raises:
        ValueError: an unknown name; says which there are.

    Example:
        >>> [lamp.azimuth for lamp in studio_lamps("loop", mirrored=True)]
        [-32, 40]
    """
    if name not in STUDIO:
        raise ValueError(f"studio: expected one of {', '.join(STUDIO)}, got {name!r}")
    lamps = STUDIO[name]
    return tuple(replace(lamp, azimuth=-lamp.azimuth) for lamp in lamps) if mirrored else lamps
