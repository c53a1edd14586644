"""Random lamps: a generator of parameters, and the points of many lamps at once."""

from __future__ import annotations

import math

import torch
from kornia.augmentation.random_generator import RandomGeneratorBase
from kornia.augmentation.utils import _adapted_rsampling
from torch import Tensor
from torch.distributions import Uniform

from facerelight.geometry.lights import light_from_angles
from facerelight.geometry.sources import disc_points, fill_light
from facerelight.geometry.sums import LightSum

__all__ = ["LampGenerator", "Range", "camera_lamps", "fill_lamps", "lamp_points"]

POINTS = 7
Range = tuple[float, float]


class LampGenerator(RandomGeneratorBase):
    """Lamps uniform on a patch of the sphere: every solid angle between the ``azimuth`` and the ``elevation`` limits is
    as likely as another.

    Args:
        azimuth, elevation: limits in degrees.
        size: limits of the lamp's angular radius in degrees.
        fill: limits of the share of light from all around.
        mix: limits of the share of its own light that a crop keeps.
    """

    def __init__(self, azimuth: Range, elevation: Range, size: Range, fill: Range, mix: Range) -> None:
        super().__init__()
        limits = {"azimuth": (-180, 180), "elevation": (-90, 90), "size": (0, 90), "fill": (0, 1), "mix": (0, 1)}
        self.ranges = {"azimuth": azimuth, "elevation": elevation, "size": size, "fill": fill, "mix": mix}
        for name, given in self.ranges.items():
            low, high = limits[name]
            if len(given) != 2 or not low <= given[0] <= given[1] <= high:
                raise ValueError(f"{name}: expected two numbers from {low} to {high}, the lesser first, got {given}")

    def __repr__(self) -> str:
        return ", ".join(f"{name}={given}" for name, given in self.ranges.items())

    def make_samplers(self, device: torch.device, dtype: torch.dtype) -> None:
        """See the base class."""
        ends = {
            name: tuple(map(_height, given)) if name == "elevation" else given for name, given in self.ranges.items()
        }
        self.samplers = {}
        for name, pair in ends.items():
            low, high = (torch.tensor(float(end), device=device, dtype=dtype) for end in pair)
            self.samplers[name] = Uniform(low, high, validate_args=False)

    def forward(self, batch_shape: tuple[int, ...], same_on_batch: bool = False) -> dict[str, Tensor]:
        """A lamp for each of a batch: ``azimuth``, ``elevation``, ``size`` in degrees, ``fill`` and ``mix``, ``(B,)``
        each."""
        drawn = {
            name: _adapted_rsampling((batch_shape[0],), sampler, same_on_batch)
            for name, sampler in self.samplers.items()
        }
        drawn["elevation"] = torch.rad2deg(torch.asin(drawn["elevation"].clamp(-1, 1)))
        return drawn


def _height(elevation: float) -> float:
    return math.sin(math.radians(elevation))


def lamp_points(azimuth: Tensor, elevation: Tensor, size: Tensor) -> LightSum:
    """Lamps as ``POINTS`` points each on their discs, amounts ``(B, 7)`` of sum 1.

    Args:
        azimuth, elevation, size: ``(B,)`` degrees.
    """
    towards = light_from_angles(azimuth.double(), elevation.double().clamp(-90, 90))
    points = disc_points(towards, size, POINTS)
    return LightSum(points, torch.full_like(points[..., 0], 1 / POINTS))


def camera_lamps(count: int) -> LightSum:
    """A lamp at the camera for each of ``count`` crops."""
    return LightSum(torch.tensor([0.0, 0.0, 1.0]).expand(count, 1, 3), torch.ones(count, 1))


def fill_lamps(count: int) -> LightSum:
    """A fill of strength 1 for each of ``count`` crops."""
    light = fill_light(1.0)
    return LightSum(light.directions.expand(count, -1, -1), light.weights[:, 0].expand(count, -1))
