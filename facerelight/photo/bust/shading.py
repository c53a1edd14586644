"""How light falls on a bust: wrapped Lambert shading times what the horizon leaves of each lamp.

The horizon of a point towards some azimuth is the highest angle that the surface reaches that way (horizon mapping, Max
1988). A lamp is a disc; the part of it above the horizon reaches the point, so a small lamp's shadow is sharp and a
large one's soft, at the same cost.
"""

from __future__ import annotations

import cv2
import numpy as np

from facerelight.photo.bust.frame import BUST, FINE, smooth_step
from facerelight.photo.bust.surface import BELOW, Bust

__all__ = ["BustShading", "horizon", "visible_share"]

WRAP = 0.02  # light reaches a little beyond the terminator
DEPTH = 0.88  # of a soft shadow: the rest is light from surfaces around
AZIMUTHS = 16  # horizons of the coarse grid; those between are interpolated
COARSE_BIAS, FINE_BIAS = 0.05, 0.004  # heights nearer than this, in units, shade nothing: they are the grid's own error
REACH = 3.6  # units: nothing farther off casts a shadow that matters
AT_CAMERA = 0.02  # sine of the angle from the camera below which a lamp sees what the camera sees
NO_EDGE = 2.0  # degrees: at the camera a larger lamp is partly hidden at steep places
SMALLEST = 0.25  # degrees: no lamp is a point
CLOTHES_SOFT, CLOTHES_BLUR = (
    10.0,
    0.08,
)  # degrees and units: beyond face and neck the surface is a guess, and so are its shadows
LEAST_SOFT = 4.0  # degrees, on the coarse grid


def horizon(
    height: np.ndarray, density: int, towards: tuple[float, float], first: float, growth: float, bias: float
) -> np.ndarray:
    """The angle in radians, above the picture's plane, at which the surface ends in one direction ``(H, W)``.

    Args:
        height: ``(H, W)`` in units.
        density: pixels a unit.
        towards: unit vector of the picture's plane, x to the right and y up.
        first: first step of the march, in units; each further one is ``growth`` times as long.
        growth: see ``first``.
        bias: what rises by less than this does not count.
    """
    steepest = np.full(height.shape, -8.0, np.float32)
    step = distance = first
    lifted = height + np.float32(bias)
    while distance < REACH:
        matrix = np.array(
            [[1, 0, distance * towards[0] * density], [0, 1, -distance * towards[1] * density]], np.float32
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        there = cv2.warpAffine(
            height, matrix, height.shape[::-1], flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=BELOW
        )
        np.maximum(steepest, (there - lifted) / np.float32(distance), out=steepest)
        step *= growth
        distance += step
    return np.arctan(steepest)


def visible_share(ends: np.ndarray, light: np.ndarray, size: float) -> np.ndarray:
    """The share ``(H, W)``, 0 to 1, of a lamp's disc of angular radius ``size`` (degrees) towards ``light (3,)`` that
    is above the horizon."""
    rise = np.arctan2(float(light[2]), float(np.hypot(light[0], light[1])))
    share = np.clip((rise - ends) / (2 * np.deg2rad(max(size, SMALLEST))) + 0.5, 0, 1)
    return smooth_step(share)


class BustShading:
    """Shading of one bust under any light; horizons are marched once and kept.

    Args:
        bust: the surface.
        exhaustive: march for every lamp, even where the plan says that it casts no shadow that the camera sees.
    """

    def __init__(self, bust: Bust, exhaustive: bool = False) -> None:
        self.bust, self.exhaustive = bust, exhaustive
        self.marches = 0
        x, y = FINE.places()
        known = np.clip((1.15 - np.hypot(x / 1.6, (y + 0.9) / 2.3)) / 0.3, 0, 1)
        self._known = smooth_step(known).astype(np.float32)
        self.low = cv2.resize(bust.height, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # enough for soft light
        self._coarse: dict[int, np.ndarray] = {}
        self._fine: dict[tuple[float, float], np.ndarray] = {}

    def shade(self, light: np.ndarray, size: float) -> np.ndarray:
        """Irradiance of a white bust under a soft light ``(3,)`` of angular radius ``size``, ``(H, W)`` on
        :data:`BUST`."""
        facing = np.clip((self.bust.normal @ light.astype(np.float32) + WRAP) / (1 + WRAP), 0, None)
        if self.sees_all(light):
            return facing
        seen = visible_share(self._horizon(float(np.arctan2(light[1], light[0]))), light, max(size, LEAST_SOFT))
        return facing * (1 - DEPTH * (1 - cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 1.1)))

    def fine_lambert(self, light: np.ndarray) -> np.ndarray:
        """Lambert shading without shadows, ``(H, W)`` on :data:`FINE`."""
        return np.clip((self.bust.fine_normal @ light.astype(np.float32) + WRAP) / (1 + WRAP), 0, None)

    def fine_visibility(self, light: np.ndarray, size: float) -> np.ndarray:
        """How much of a lamp reaches each place of :data:`FINE`, 0 to 1, its horizon marched exactly."""
        if size < NO_EDGE and self.sees_all(light):
            return np.ones(FINE.size, np.float32)
        side = max(float(np.hypot(light[0], light[1])), 1e-6)
        towards = round(float(light[0]) / side, 4), round(float(light[1]) / side, 4)
        if towards not in self._fine:
            self.marches += 1
            self._fine[towards] = horizon(self.bust.fine, FINE.density, towards, 0.03, 1.035, FINE_BIAS)
        sharp = cv2.GaussianBlur(visible_share(self._fine[towards], light, size).astype(np.float32), (0, 0), 0.5)
        vague = visible_share(self._fine[towards], light, size + CLOTHES_SOFT).astype(np.float32)
        smooth: np.ndarray = cv2.GaussianBlur(vague, (0, 0), CLOTHES_BLUR * FINE.density)
        return self._known * sharp + (1 - self._known) * smooth

    def sees_all(self, light: np.ndarray) -> bool:
        """Whether a lamp stands at the camera: what the camera sees, it lights."""
        return not self.exhaustive and float(np.hypot(light[0], light[1])) < AT_CAMERA and float(light[2]) > 0

    def _horizon(self, azimuth: float) -> np.ndarray:
        """The coarse horizon towards any azimuth (radians in the picture's plane), interpolated between those
        marched."""
        place = (azimuth / (2 * np.pi) % 1.0) * AZIMUTHS
        low, share = int(place) % AZIMUTHS, place - int(place)
        return (1 - share) * self._marched(low) + share * self._marched((low + 1) % AZIMUTHS)

    def _marched(self, index: int) -> np.ndarray:
        if index not in self._coarse:
            self.marches += 1
            turn = 2 * np.pi * index / AZIMUTHS
            towards = float(np.cos(turn)), float(np.sin(turn))
            ends = horizon(self.low, BUST.density // 2, towards, 0.08, 1.06, COARSE_BIAS)
            self._coarse[index] = cv2.resize(ends, BUST.size[::-1], interpolation=cv2.INTER_LINEAR)
        return self._coarse[index]
