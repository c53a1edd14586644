"""What gives the light: lamps of any size, power and colour, a fill from all around, and weighted sums of directions.

Light adds up, so every source is a sum of distant points, and a scene's light is the sum of its sources'. A lamp on a
face is described the way photographers do: where it stands, how large it looks from the face, how strong it is and its
colour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.geometry.lights import even_hemisphere, light_from_angles
from facerelight.numerics.luminance import LUMINANCE

__all__ = ["Lamp", "LightMixture", "disc_points", "fill_light", "lights_behind", "scene_light"]

FILL_POINTS = 24
# A dome of this strength lights a face from the front as brightly as a lamp of power 1 at the camera
FILL_STRENGTH = 1.9
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


class LightMixture(NamedTuple):
    """Distant light as a weighted sum of points.

    ``directions (P, 3)`` unit vectors; ``weights (P, 3)`` non-negative linear RGB, in units of a lamp of power 1;
    ``size (P,)`` degrees, the angular radius of the source that a point stands for, which says how soft its shadows
    are; ``source (P,)`` int64, points of one number make one source.
    """

    directions: Tensor
    weights: Tensor
    size: Tensor
    source: Tensor

    @property
    def white(self) -> bool:
        """Whether all points have the same colour, white."""
        return bool((self.weights == self.weights[:, :1]).all())


@dataclass(frozen=True)
class Lamp:
    """A lamp far away.

    Args:
        azimuth: degrees; positive at image-left, beyond +-90 behind the face.
        elevation: degrees in [-90, 90]; positive above.
        size: angular radius in degrees as seen from the face, 0 to 90: 1 a bare bulb, 5 a small reflector, 15 a soft
            box, 40 a window.
        power: 1 lights the face from the camera as brightly as the photograph shows it.
        colour: linear RGB; its luminance is brought to 1, so that power alone says how strong the lamp is.

    Raises:
        ValueError: a number out of range or not finite.

    Example:
        >>> Lamp(45, 30, size=15).light().directions.shape
        torch.Size([13, 3])
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    size: float = 5.0
    power: float = 1.0
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if not math.isfinite(self.azimuth) or not abs(self.azimuth) <= 180:
            raise ValueError(f"azimuth: expected degrees in [-180, 180], got {self.azimuth}")
        if not math.isfinite(self.elevation) or not abs(self.elevation) <= 90:
            raise ValueError(f"elevation: expected degrees in [-90, 90], got {self.elevation}")
        if not 0 <= self.size <= 90:
            raise ValueError(f"size: expected an angular radius of 0 to 90 degrees, got {self.size}")
        if not (math.isfinite(self.power) and self.power >= 0):
            raise ValueError(f"power: expected a finite number of at least 0, got {self.power}")
        if len(self.colour) != 3 or not all(math.isfinite(c) and c >= 0 for c in self.colour) or not any(self.colour):
            raise ValueError(f"colour: expected three non-negative linear values, not all zero, got {self.colour}")

    def light(self) -> LightMixture:
        """The lamp as points on its disc (Vogel's spiral), more of them the larger it is."""
        count = 1 if self.size < 2 else 7 if self.size < 8 else 13 if self.size < 25 else 24
        towards = light_from_angles(float(self.azimuth), float(self.elevation)).double()
        size = self.size if count > 1 else 0.0  # a bulb is its middle
        points = disc_points(towards[None], towards.new_tensor([size]), count)[0]
        colour = torch.tensor(self.colour, dtype=torch.float64)
        colour = colour / (colour @ torch.tensor(LUMINANCE, dtype=torch.float64))
        weights = (self.power / count * colour).expand(count, 3)
        return LightMixture(
            points.float(),
            weights.float(),
            torch.full((count,), float(self.size)),
            torch.zeros(count, dtype=torch.long),
        )


def disc_points(towards: Tensor, size: Tensor, count: int) -> Tensor:
    """``count`` points spread evenly over each of B discs (Vogel's spiral), unit vectors ``(B, count, 3)`` float64.

    Args:
        towards: ``(B, 3)`` unit vectors float64 to the middles.
        size: ``(B,)`` angular radii in degrees.
    """
    steep = towards[:, 1:2].abs() >= 0.95
    up = torch.where(steep, towards.new_tensor((1.0, 0.0, 0.0)), towards.new_tensor((0.0, 1.0, 0.0)))
    across = torch.nn.functional.normalize(torch.linalg.cross(up, towards), dim=1)
    along = torch.linalg.cross(towards, across)
    index = torch.arange(count, dtype=torch.float64, device=towards.device)
    angle = torch.deg2rad(size.double())[:, None] * torch.sqrt((index + 0.5) / count)  # (B, count), from the middle
    turn = index * GOLDEN_ANGLE
    ring = torch.cos(turn)[:, None] * across[:, None] + torch.sin(turn)[:, None] * along[:, None]  # (B, count, 3)
    return torch.cos(angle)[..., None] * towards[:, None] + torch.sin(angle)[..., None] * ring


def fill_light(strength: float) -> LightMixture:
    """Light from all around the front, brighter above: what walls and sky give; ``strength`` in units of a lamp at the
    camera."""
    directions = even_hemisphere(FILL_POINTS)
    share = 0.6 + 0.4 * directions[:, 1]
    weights = (strength * FILL_STRENGTH * share / share.sum())[:, None].expand(-1, 3)
    return LightMixture(
        directions, weights, torch.full((FILL_POINTS,), 20.0), torch.zeros(FILL_POINTS, dtype=torch.long)
    )


def scene_light(sources: Sequence[Lamp | LightMixture], fill: float = 0.0) -> LightMixture:
    """The sum of ``sources``, at ``1 - fill`` of their power, and of a fill of ``fill``.

    Raises:
        ValueError: no sources, or a fill outside [0, 1].
    """
    if not 0 <= fill <= 1:
        raise ValueError(f"fill: expected a share from 0 to 1, got {fill}")
    if not sources:
        raise ValueError("lights: expected at least one Lamp, got none; strength=0 leaves the photo as it is")
    parts = [source.light() if isinstance(source, Lamp) else source for source in sources]
    parts = [part._replace(weights=(1 - fill) * part.weights) for part in parts]
    if fill > 0:
        parts.append(fill_light(fill))
    directions, weights, size, _ = (torch.cat(part) for part in zip(*parts, strict=True))
    first = 0
    numbers = []
    for part in parts:
        numbers.append(part.source + first)
        first = int(numbers[-1].max()) + 1
    return LightMixture(directions, weights, size, torch.cat(numbers))


def lights_behind(sources: Sequence[Lamp | LightMixture]) -> list[str]:
    """What to say of lamps that stand behind the face, a line each."""
    behind = [source.azimuth for source in sources if isinstance(source, Lamp) and abs(source.azimuth) > 90]
    rim = "the lamp stands behind the face and lights its rim alone; fill says how much light comes from all around"
    return [f"azimuth {azimuth:g}: {rim}" for azimuth in behind]
