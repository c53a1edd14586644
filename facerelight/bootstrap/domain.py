"""The rendered world in a few numbers: skin, light and how heads stand before the camera; and what one person's skin
makes of light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from torch import Tensor

__all__ = ["Domain", "Material", "lamp_strength"]

Value = TypeVar("Value", float, Tensor)


@dataclass(frozen=True)
class Domain:
    """The scalar settings of the rendered world, the same for all heads; ``scripts/data/search_domain.py`` finds them.

    Args:
        tone_low, tone_high: range of the skin's albedo over people, uniform in its logarithm.
        texture: strength of pigment and fine texture (standard deviation of log albedo).
        specular: mean reflectance of the skin's surface at normal incidence.
        roughness: root mean square slope of that surface (Beckmann); skin has 0.2 to 0.4.
        fill: light from all around, as a fraction of the lamp.
        side_light: a lamp at the side is brighter by this fraction than one at the camera.
        top_light: a lamp above is brighter by this fraction, times the sine of its elevation, and one below darker.
        pitch: degrees by which heads look up, on average.
        turn: standard deviation of how heads are turned, to the sides and up, in degrees.
        misalign: standard deviation of a marked landmark, in distances between the eyes.
    """

    tone_low: float = 0.3
    tone_high: float = 0.8
    texture: float = 0.05
    specular: float = 0.055
    roughness: float = 0.35
    fill: float = 0.0
    side_light: float = 0.0
    top_light: float = 0.0
    pitch: float = 0.0
    turn: float = 6.0
    misalign: float = 0.07

    def __post_init__(self) -> None:
        if not (0 < self.tone_low <= self.tone_high <= 1.5):
            raise ValueError(
                f"domain: expected 0 < tone_low <= tone_high <= 1.5, got {self.tone_low} and {self.tone_high}"
            )
        if not (min(self.texture, self.specular, self.fill, self.side_light) >= 0 and 0.05 <= self.roughness <= 1):
            raise ValueError(
                f"domain: expected texture, specular, fill, side_light >= 0 and roughness in 0.05 to 1, got {self}"
            )
        if not abs(self.top_light) <= 0.9:
            raise ValueError(f"domain: expected top_light within 0.9, got {self.top_light}")
        if not (abs(self.pitch) <= 30 and 0 <= self.turn <= 15 and 0 <= self.misalign <= 0.2):
            raise ValueError(
                f"domain: expected pitch within 30, turn in 0 to 15 degrees and misalign in 0 to 0.2, got {self}"
            )


@dataclass(frozen=True)
class Material:
    """How a person's picture is lit: ``specular`` reflectance and ``roughness`` of the skin, ``fill`` light, and the
    lamps' ``side_light`` and ``top_light``."""

    specular: float
    roughness: float
    fill: float
    side_light: float = 0.0
    top_light: float = 0.0


def lamp_strength(y: Value, z: Value, side_light: float, top_light: float = 0.0) -> Value:
    """How bright lamps are whose directions have components ``y`` (up) and ``z`` (to the camera): see
    :class:`Domain`."""
    return (1 + side_light * (1 - z)) * (1 + top_light * y)
