"""Light from all around: an environment map as a sum of directions, and even light.

A map is equirectangular, a panorama as the sitter sees it: its middle is where the camera stands, its upper edge is
straight up, and its right half is at the sitter's right, which a photograph shows at image-left (azimuth above 0). Its
outer quarters lie behind the head; they light the rim alone.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from facerelight.geometry.lights import light_from_angles
from facerelight.geometry.sources import LightMixture

__all__ = ["environment_light", "even_light", "map_directions", "paint_environment"]

BANDS = (4, 8, 12, 16, 16, 12, 8, 4)  # cells in bands of equal elevation: multiples of 4, so that quarter turns fit
CELL = 20.0  # degrees, about the angular radius of a cell


def environment_light(radiance: Tensor, turn: float = 0.0, exposure: float = 0.0) -> LightMixture:
    """The light of an equirectangular map, gathered in 80 cells of the sphere, each at the middle of its own light.

    However bright the map, a face that looks at the camera is lit as by a lamp of power 1 there.

    Args:
        radiance: ``(H, W, 3)`` or ``(H, W)``, linear, 0 or more, of any unit; at least 8 x 16.
        turn: degrees by which the surroundings are turned about the vertical, what was in front towards image-left.
        exposure: in stops: 1 doubles the light.

    Raises:
        ValueError: another shape, NaN, infinite or negative values, a map without any light, or one that lights the
            back of the head alone; a turn or exposure that is not finite.

    Example:
        >>> environment_light(torch.ones(16, 32)).directions.shape
        torch.Size([80, 3])
    """
    if not (math.isfinite(turn) and math.isfinite(exposure)):
        raise ValueError(f"environment: expected a finite turn and exposure, got {turn} and {exposure}")
    values = _checked(radiance)
    height, width = values.shape[:2]
    directions = map_directions(height, width, turn).double()  # (H, W, 3)
    cell = _cells(height, width)  # (H, W)
    colour = values * _solid_angles(height)[:, None, None]  # (H, W, 3)
    count = sum(BANDS)
    weights = torch.zeros(count, 3, dtype=torch.float64).index_add(0, cell.flatten(), colour.flatten(0, 1))
    bright = colour.mean(-1, keepdim=True) + 1e-9 * colour.mean() + 1e-30  # an empty cell has a middle as well
    middle = torch.zeros(count, 3, dtype=torch.float64).index_add(
        0, cell.flatten(), (bright * directions).flatten(0, 1)
    )
    middle = torch.nn.functional.normalize(middle, dim=1)
    front = float((weights.mean(1) * middle[:, 2].clamp_min(0)).sum())
    if front <= 1e-6 * float(weights.mean(1).sum()):
        raise ValueError("environment: expected some light in front of the face, got none; turn= turns the map")
    weights = weights / front * 2.0**exposure
    return LightMixture(
        middle.float(), weights.float(), torch.full((count,), CELL), torch.zeros(count, dtype=torch.long)
    )


def even_light() -> LightMixture:
    """The same light from everywhere: a face without shading."""
    return environment_light(torch.ones(32, 64))


def paint_environment(light: LightMixture, height: int = 128) -> Tensor:
    """The map of a light, ``(height, 2 * height, 3)`` float32, linear: what :func:`environment_light` reads as that
    light again, but for its strength.

    Every point becomes a round glow whose standard deviation is half of its size, at least a pixel and a half; the
    brightest pixel has 1. Lights whose points stand about as far apart as they are large run into one.

    Args:
        light: some light at least.
        height: rows, 8 or more.

    Raises:
        ValueError: too few rows, or no light.

    Example:
        >>> paint_environment(even_light(), 16).shape
        torch.Size([16, 32, 3])
    """
    if height < 8:
        raise ValueError(f"environment: expected a map of at least 8 rows, got {height}")
    if not light.weights.any():
        raise ValueError("environment: expected some light, got none")
    places = map_directions(height, 2 * height).flatten(0, 1)  # (P, 3)
    solid = _solid_angles(height).repeat_interleave(2 * height)  # (P,)
    width = torch.deg2rad((light.size.double() / 2).clamp_min(1.5 * 180 / height))  # (n,)
    sharpness = 1 / width.square()
    painted = torch.zeros(len(places), 3, dtype=torch.float64)
    for direction, weight, sharp in zip(light.directions.double(), light.weights.double(), sharpness, strict=True):
        glow = torch.exp(sharp * (places @ direction - 1))  # von Mises and Fisher's
        painted += (glow / (glow @ solid))[:, None] * weight
    return (painted / painted.max()).view(height, 2 * height, 3).float()


def map_directions(height: int, width: int, turn: float = 0.0) -> Tensor:
    """Where the pixels of an equirectangular map lie, unit vectors ``(height, width, 3)``."""
    elevation = 90 - 180 * (torch.arange(height, dtype=torch.float64) + 0.5) / height
    azimuth = 360 * ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5) + turn
    return light_from_angles(azimuth[None], elevation[:, None])


def _checked(radiance: Tensor) -> Tensor:
    """``(H, W, 3)`` float64."""
    if (
        not isinstance(radiance, Tensor)
        or radiance.dim() not in (2, 3)
        or (radiance.dim() == 3 and radiance.shape[2] != 3)
    ):
        got = tuple(radiance.shape) if isinstance(radiance, Tensor) else type(radiance).__name__
        raise ValueError(f"environment: expected linear radiance (H, W, 3) or (H, W), got {got}")
    if radiance.shape[0] < 8 or radiance.shape[1] < 16:
        raise ValueError(f"environment: expected at least 8 x 16 pixels, got {radiance.shape[0]} x {radiance.shape[1]}")
    if not (torch.isfinite(radiance) & (radiance >= 0)).all():
        raise ValueError("environment: expected finite radiance of 0 or more, got NaN, infinite or negative values")
    if not radiance.any():
        raise ValueError("environment: expected a map with some light, got a black one")
    values = radiance.double()
    return values if values.dim() == 3 else values[..., None].expand(-1, -1, 3)


def _solid_angles(height: int) -> Tensor:
    """Of a pixel of each row, up to a factor, ``(H,)``."""
    edge = math.pi * torch.arange(height + 1, dtype=torch.float64) / height
    return edge[:-1].cos() - edge[1:].cos()


def _cells(height: int, width: int) -> Tensor:
    """Which cell each pixel of a map lies in, ``(H, W)``."""
    band = (2 * torch.arange(height) + 1) * len(BANDS) // (2 * height)
    size, first = torch.tensor(BANDS), torch.tensor([0, *BANDS]).cumsum(0)[:-1]
    return first[band][:, None] + (2 * torch.arange(width)[None] + 1) * size[band][:, None] // (2 * width)
