"""Colour of a relit photograph: the camera's curve undone and redone, highlights parted from the skin's own colour, shade kept warm.

A photograph is not radiance: cameras lift shade and roll highlights off. Ratios of light belong to radiance, so the curve is undone first
and redone last; black, white and a ratio of 1 stay where they are.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window
from facerelight.sources import LUMINANCE

__all__ = ["LUMA", "SkinColour", "relit_radiance", "skin_colour", "to_display", "to_scene"]

LUMA = np.array(LUMINANCE, np.float32)
ONES = np.ones(3, np.float32)
SHOULDER = 0.5  # a: how much the camera rolls highlights off
TOE = 1.25  # g: how much it darkens shade
WARM = 0.03  # shade of skin is redder: light bleeds through it, red most of all
RESTORED = 0.6  # of the luminance that a dimmed highlight leaves goes back as the skin's own colour
SATURATED = 14.0  # how much more saturated neighbours count in the skin's own colour: highlights wash it out
SPREAD = 0.35  # units over which skin's colour is averaged
LIFTED, MOST_TYPICAL = (0.3, 1.2), 0.8  # log ratios from which, and by which, the skin's typical colour takes over
DARK_PIGMENT = 0.4  # of the skin's luminance around: darker parts of a face are hair
KNEE, WHITEST = 0.75, 0.985  # linear: above the first what becomes brighter is rolled off, towards the second


def to_scene(coded: np.ndarray) -> np.ndarray:
    """sRGB-coded values in 0..1 to scene radiance ``e``, channel by channel: ``y = (1 + a) e^g / (1 + a e^g)`` with y decoded."""
    linear = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    return ((linear / (1 + SHOULDER - SHOULDER * linear)) ** (1 / TOE)).astype(np.float32)


def to_display(scene: np.ndarray, before: np.ndarray | None = None) -> np.ndarray:
    """The way back to sRGB codes in 0..1.

    Args:
        scene: ``(..., 3)`` radiance.
        before: the photograph's own radiance. What becomes brighter than it spends the room that is left below white, and so never clips;
            None: nothing is rolled off.
    """
    linear = _developed(scene)
    if before is not None:
        most, own = _most(linear)[..., None], _most(_developed(before))[..., None]
        base = np.maximum(own, KNEE)
        room = np.maximum(WHITEST - base, 1e-3)
        rolled = np.minimum(base + room * (1 - np.exp(-np.maximum(most - base, 0) / room)), np.maximum(WHITEST, own))
        linear = np.where(most > base, linear * rolled / np.maximum(most, 1e-6), linear)
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055).astype(np.float32)


def _developed(scene: np.ndarray) -> np.ndarray:
    """Linear display values of scene radiance: the camera's curve."""
    raised = np.power(np.maximum(scene, 0), TOE)
    return (1 + SHOULDER) * raised / (1 + SHOULDER * raised)


class SkinColour(NamedTuple):
    """Skin on a window's copy.

    ``skin (h, w)`` 0 to 1, where skin is; ``diffuse (h, w, 3)``, its own colour of luminance 1, without highlights; ``typical (3,)``, the
    lit skin's; ``lit (h, w)`` 0 to 1, what takes that colour when it is lifted from shade, though it may not look like skin there;
    ``pigment (h, w)`` 0 to 1, beard, brows and fringe on the face.
    """

    skin: np.ndarray
    diffuse: np.ndarray
    typical: np.ndarray
    lit: np.ndarray
    pigment: np.ndarray


def skin_colour(
    scene: np.ndarray, face: np.ndarray, oval: np.ndarray, features: np.ndarray, matte: np.ndarray, window: Window
) -> SkinColour:
    """Where the skin is, on the face and off it, and what colour it has without highlights.

    Args:
        scene: ``(h, w, 3)`` radiance of the window's copy.
        face: ``(h, w)``, where the face's skin is sure.
        oval: ``(h, w)``, distance from the face's middle in units of its outline.
        features: ``(h, w)``, eyes and lips.
        matte: ``(h, w)``.
        window: the window.
    """
    sure = (face * (1 - features)).clip(0, 1)
    small = min(1.0, 60 / window.unit)
    e = cv2.resize(scene, None, fx=small, fy=small, interpolation=cv2.INTER_AREA)
    weight = cv2.resize(sure, e.shape[1::-1], interpolation=cv2.INTER_AREA)
    saturation = 1 - _least(e) / np.maximum(_most(e), 1e-4)
    weight_of_colour = weight * np.exp(np.clip(SATURATED * saturation, 0, 12))
    sigma = SPREAD * window.unit * small
    colour = e / np.maximum(e @ LUMA, 1e-4)[..., None]
    near = _blur(weight_of_colour, sigma)
    diffuse = (
        np.stack([_blur(colour[..., c] * weight_of_colour, sigma) for c in range(3)], -1)
        / np.maximum(near, 1e-6)[..., None]
    )
    total = float((weight_of_colour * weight).sum())
    typical = (
        (diffuse * (weight_of_colour * weight)[..., None]).sum((0, 1)) / max(total, 1e-6)
        if total > 0
        else np.ones(3, np.float32)
    )
    known = np.clip(_blur(weight, sigma) * 8, 0, 1)[..., None]
    diffuse = known * diffuse + (1 - known) * typical  # the face's own colour serves neck and ears
    diffuse = cv2.resize(diffuse.astype(np.float32), window.size[::-1], interpolation=cv2.INTER_LINEAR)
    diffuse /= np.maximum(diffuse @ LUMA, 1e-4)[..., None]
    lit = weight * np.clip(1.6 - 2 * (e @ LUMA), 0, 1)
    average = (e * lit[..., None]).sum((0, 1))
    level = float(average @ LUMA)
    average = average / level if level > 1e-6 else np.ones(3)
    skin = np.maximum(sure, _skin_elsewhere(scene, diffuse, matte, window) * (1 - features)).astype(np.float32)
    near = _blur(sure, SPREAD * window.unit)
    of_skin = _blur((scene @ LUMA) * sure, SPREAD * window.unit) / np.maximum(near, 1e-3)
    relative = (scene @ LUMA) / np.maximum(of_skin, 1e-4)
    inside = np.clip((1.1 - oval) / 0.15, 0, 1)
    lit = np.maximum(skin, inside * (1 - features) * np.clip((relative - 0.15) / 0.2, 0, 1))
    on_face = np.clip((1.25 - oval) / 0.5, 0, 1)
    pigment = (
        on_face * on_face * (3 - 2 * on_face) * np.clip((DARK_PIGMENT - relative) / 0.2, 0, 1) * np.clip(4 * near, 0, 1)
    )
    return SkinColour(skin, diffuse, average.astype(np.float32), lit.astype(np.float32), pigment.astype(np.float32))


def _skin_elsewhere(scene: np.ndarray, diffuse: np.ndarray, matte: np.ndarray, window: Window) -> np.ndarray:
    """Neck, ears, chest: what the skin's own colour and a white highlight explain, within the matte and near the face."""
    amount, highlight = part_highlight(scene, diffuse)
    luminance = scene @ LUMA
    left = np.linalg.norm(scene - amount[..., None] * diffuse - highlight[..., None], axis=-1) / np.maximum(
        np.linalg.norm(scene, axis=-1), 1e-3
    )
    like = np.clip((0.085 - left) / 0.035, 0, 1) * np.clip((amount / np.maximum(luminance, 1e-3) - 0.12) / 0.15, 0, 1)
    like = like * np.clip((luminance - 0.02) / 0.03, 0, 1)
    x, y = window.places()
    near = np.clip(4.5 - np.hypot(x, y), 0, 1)
    return _blur((like * matte * near).astype(np.float32), max(0.8, 0.025 * window.unit))


def part_highlight(scene: np.ndarray, diffuse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Dichromatic parts of radiance: ``e = d diffuse + s (1, 1, 1)`` in least squares, s within the least channel; ``(h, w)`` each."""
    a11, a12 = np.square(diffuse) @ ONES, diffuse @ ONES
    b1, b2 = (scene * diffuse) @ ONES, scene @ ONES
    determinant = np.maximum(3 * a11 - a12**2, 1e-3)
    highlight = np.clip((a11 * b2 - a12 * b1) / determinant, 0, 0.9 * _least(scene))
    return np.maximum((3 * b1 - a12 * b2) / determinant, 0), highlight


def relit_radiance(
    scene: np.ndarray,
    log_ratio: np.ndarray,
    skin: np.ndarray,
    lit: np.ndarray,
    diffuse: np.ndarray,
    typical: np.ndarray,
) -> np.ndarray:
    """Scene radiance under another light, ``(h, w, 3)``.

    Args:
        scene: ``(h, w, 3)``.
        log_ratio: ``(h, w, 1)`` or ``(h, w, 3)``, of the new light over the old, a channel each.
        skin, lit, diffuse, typical: as in :class:`SkinColour`.
    """
    highlight = part_highlight(scene, diffuse)[1] * skin
    ratio = np.exp(log_ratio)
    tint = 1 + np.where(log_ratio < 0, WARM * skin[..., None] * np.array([-1.0, 0.25, 1.0], np.float32), 0)
    of_diffuse = np.exp(log_ratio * tint)
    of_highlight = np.where(
        log_ratio < 0, np.exp(1.6 * log_ratio), 1 + 0.35 * (ratio - 1)
    )  # they die faster in shade, grow slower in light
    relit = of_diffuse * (scene - highlight[..., None]) + of_highlight * highlight[..., None]
    relit = relit + _clean_light(scene - highlight[..., None], log_ratio, diffuse, typical) * lit[..., None]
    missing = ((ratio * scene) @ LUMA - relit @ LUMA)[..., None]
    return relit + RESTORED * np.maximum(missing, 0) * diffuse * skin[..., None]


def _clean_light(body: np.ndarray, log_ratio: np.ndarray, diffuse: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """What to add where shade is lifted, so that the new light is white: shade has the colour of walls and leaves, not of the lamp.

    ``body (h, w, 3)`` is radiance without highlights. The added light, ``R - 1`` of it, goes over from the place's own colour to the skin's
    typical one the more it is lifted.
    """
    added = np.maximum(np.exp(log_ratio) - 1, 0)
    luminance = (body @ LUMA)[..., None]
    own = np.clip(typical / np.maximum(diffuse, 1e-3), 0.6, 1.6) * body
    own = own * luminance / np.maximum((own @ LUMA)[..., None], 1e-4)
    lifted = np.clip((log_ratio - LIFTED[0]) / (LIFTED[1] - LIFTED[0]), 0, MOST_TYPICAL)
    return added * ((1 - lifted) * own + lifted * luminance * typical - body)


def _most(colour: np.ndarray) -> np.ndarray:
    """The largest channel."""
    return np.maximum(np.maximum(colour[..., 0], colour[..., 1]), colour[..., 2])


def _least(colour: np.ndarray) -> np.ndarray:
    """The smallest channel."""
    return np.minimum(np.minimum(colour[..., 0], colour[..., 1]), colour[..., 2])


def _blur(image: np.ndarray, sigma: float) -> np.ndarray:
    return cv2.GaussianBlur(np.asarray(image, np.float32), (0, 0), max(sigma, 0.3))
