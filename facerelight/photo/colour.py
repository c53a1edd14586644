"""Colour of a relit photograph: the camera's curve undone and redone, highlights parted from the skin's own colour,
shade kept warm.

A photograph is not radiance: cameras lift shade and roll highlights off. Ratios of light belong to radiance, so the
curve is undone first and redone last; black, white and a ratio of 1 stay where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facerelight.numerics.luminance import LUMINANCE

__all__ = ["LUMA", "TOE", "SkinColour", "developed", "part_highlight", "relit_radiance", "to_display", "to_scene"]

LUMA = np.array(LUMINANCE, np.float32)
ONES = np.ones(3, np.float32)
SHOULDER = 0.5  # a: how much the camera rolls highlights off
TOE = 1.25  # g: how much it darkens shade
WARM = 0.03  # shade of skin is redder: light bleeds through it, red most of all
RESTORED = 0.6  # of the luminance that a dimmed highlight leaves goes back as the skin's own colour
LIFTED, MOST_TYPICAL = (0.3, 1.2), 0.8  # log ratios from which, and by which, the skin's typical colour takes over
CAST = 0.7  # of a colour cast goes with the old light
BLOWN = (0.75, 0.95)  # radiance from which, and at which, a camera has lost the colour that shade brings back
KNEE, WHITEST = 0.75, 0.985  # linear: above the first what becomes brighter is rolled off, towards the second


def to_scene(coded: np.ndarray) -> np.ndarray:
    """sRGB-coded values in 0..1 to scene radiance ``e``, channel by channel: ``y = (1 + a) e^g / (1 + a e^g)`` with y
    decoded."""
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    return ((linear / (1 + SHOULDER - SHOULDER * linear)) ** (1 / TOE)).astype(np.float32)


def to_display(scene: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """The way back to sRGB codes in 0..1.

    Args:
        scene: ``(..., 3)`` radiance.
        before: the photograph's own radiance. What becomes brighter than it spends the room that is left below white,
            and so never clips;
            None: nothing is rolled off.
    """
    linear = developed(scene)
    if before is not None:
        most, own = most_channel(linear)[..., None], most_channel(developed(before))[..., None]
        base = np.maximum(own, KNEE)
        room = np.maximum(WHITEST - base, 1e-3)
        rolled = np.minimum(base + room * (1 - np.exp(-np.maximum(most - base, 0) / room)), np.maximum(WHITEST, own))
        linear = np.where(most > base, linear * rolled / np.maximum(most, 1e-6), linear)
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055).astype(np.float32)


def developed(scene: np.ndarray) -> np.ndarray:
    """Linear display values of scene radiance: the camera's curve."""
    raised = np.power(np.maximum(scene, 0), TOE)
    return (1 + SHOULDER) * raised / (1 + SHOULDER * raised)


class SkinColour(NamedTuple):
    """Skin on a window's copy, or a part of it, ``(h, w)`` and ``(h, w, 3)``.

    ``skin`` 0 to 1, where skin is; ``diffuse``, its own colour of luminance 1, without highlights; ``typical (3,)``,
    the lit skin's; ``cast``, by how much the light that falls on a place differs from that on the rest of the face, 1
    where it does not; ``lit`` 0 to 1, what is lit as skin though it may not look like it in coloured shade; ``pigment``
    0 to 1, beard, brows and fringe on the face.
    """

    skin: np.ndarray
    diffuse: np.ndarray
    typical: np.ndarray
    cast: np.ndarray
    lit: np.ndarray
    pigment: np.ndarray


def part_highlight(scene: np.ndarray, diffuse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dichromatic parts of radiance: ``e = d diffuse + s (1, 1, 1)`` in least squares, s within the least channel;
    ``(h, w)`` each."""
    a11, a12 = np.square(diffuse) @ ONES, diffuse @ ONES
    b1, b2 = (scene * diffuse) @ ONES, scene @ ONES
    determinant = np.maximum(3 * a11 - a12**2, 1e-3)
    highlight = np.clip((a11 * b2 - a12 * b1) / determinant, 0, 0.9 * least_channel(scene))
    return np.maximum((3 * b1 - a12 * b2) / determinant, 0), highlight


def relit_radiance(scene: np.ndarray, log_ratio: np.ndarray, colour: SkinColour, change: float) -> np.ndarray:
    """Scene radiance under another light, ``(h, w, 3)``.

    Args:
        scene: ``(h, w, 3)``.
        log_ratio: ``(h, w, 1)`` or ``(h, w, 3)``, of the new light over the old, a channel each.
        colour: the skin's, on the same pixels.
        change: how surely the light is another, 0 to 1.
    """
    highlight = (part_highlight(scene, colour.diffuse)[1] * colour.skin)[..., None]
    ratio, darker = np.exp(log_ratio), log_ratio < 0
    tint = 1 + np.where(darker, WARM * colour.skin[..., None] * np.array([-1.0, 0.25, 1.0], np.float32), 0)
    # highlights die faster in shade and grow slower in light
    of_highlight = np.where(darker, np.exp(1.6 * log_ratio), 1 + 0.35 * (ratio - 1))
    body = _whitened(scene - highlight, colour.cast, CAST * change * colour.lit)
    blown = np.clip((most_channel(scene) - BLOWN[0]) / (BLOWN[1] - BLOWN[0]), 0, 1) * colour.lit * change
    body = body + blown[..., None] * np.clip(-2 * log_ratio, 0, 1) * ((body @ LUMA)[..., None] * colour.typical - body)
    lifted = np.clip((log_ratio - LIFTED[0]) / (LIFTED[1] - LIFTED[0]), 0, MOST_TYPICAL) * colour.lit[..., None]
    added = np.maximum(ratio - 1, 0) * lifted * ((body @ LUMA)[..., None] * colour.typical - body)
    relit = np.exp(log_ratio * tint) * body + added + of_highlight * highlight
    missing = ((ratio * scene) @ LUMA - relit @ LUMA)[..., None]
    return relit + RESTORED * np.maximum(missing, 0) * colour.diffuse * colour.skin[..., None]


def _whitened(body: np.ndarray, cast: np.ndarray, share: np.ndarray) -> np.ndarray:
    """``body (h, w, 3)`` less a ``share (h, w)`` of the colour ``cast (h, w, 3)`` on it, its luminance kept."""
    white = body * np.exp(-share[..., None] * np.log(cast))
    return white * ((body @ LUMA) / np.maximum(white @ LUMA, 1e-6))[..., None]


def most_channel(colour: np.ndarray) -> np.ndarray:
    """The largest channel."""
    return np.maximum(np.maximum(colour[..., 0], colour[..., 1]), colour[..., 2])


def least_channel(colour: np.ndarray) -> np.ndarray:
    """The smallest channel."""
    return np.minimum(np.minimum(colour[..., 0], colour[..., 1]), colour[..., 2])
