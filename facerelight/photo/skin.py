"""Where the skin of a photograph is, and what colour: without highlights, and without what walls and leaves cast on
it."""

from __future__ import annotations

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window, blur, smooth_step
from facerelight.photo.colour import LUMA, SkinColour, least_channel, most_channel, part_highlight

__all__ = ["skin_colour"]

SMALL = 60.0  # pixels a unit of the copy on which colours are averaged
SATURATED = 14.0  # how much more saturated neighbours count in the skin's own colour: highlights wash it out
SPREAD = 0.35  # units over which the skin's own colour is averaged
CAST_SPREAD = 0.25  # units over which a colour cast is
LARGEST_CAST = 1.5  # what differs by more in a channel is pigment, not light
DARK_PIGMENT = 0.4  # of the skin's luminance around: darker parts of a face are hair
NOSE = (0.55, -0.45, 0.5)  # half axis, place and half axis, in units: where a nose casts its shadow, dark is shade
LIT_FROM = 0.15  # of the same: darker parts are not lit as skin


def skin_colour(
    scene: np.ndarray, face: np.ndarray, oval: np.ndarray, features: np.ndarray, matte: np.ndarray, window: Window
) -> SkinColour:
    """Where the skin is, on the face and off it, and what colour it has.

    Args:
        scene: ``(h, w, 3)`` radiance of the window's copy.
        face: ``(h, w)``, where the face's skin is sure.
        oval: ``(h, w)``, distance from the face's middle in units of its outline.
        features: ``(h, w)``, eyes and lips.
        matte: ``(h, w)``.
        window: the window.
    """
    sure, luminance = (face * (1 - features)).clip(0, 1), scene @ LUMA
    scale = min(1.0, SMALL / window.unit)
    small = cv2.resize(scene, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    weight = cv2.resize(sure, small.shape[1::-1], interpolation=cv2.INTER_AREA)
    diffuse = _enlarged(_own_colour(small, weight, SPREAD * window.unit * scale), window)
    diffuse /= np.maximum(diffuse @ LUMA, 1e-4)[..., None]
    elsewhere = _skin_elsewhere(scene, diffuse, matte, window) * (1 - features)
    skin = np.maximum(sure, elsewhere).astype(np.float32)
    near = blur(sure, SPREAD * window.unit)
    relative = luminance / np.maximum(blur(luminance * sure, SPREAD * window.unit) / np.maximum(near, 1e-3), 1e-4)
    inside = np.clip((1.1 - oval) / 0.15, 0, 1) * (1 - features) * np.clip((relative - LIT_FROM) / 0.2, 0, 1)
    on_face = np.clip((1.25 - oval) / 0.5, 0, 1)
    dark = np.clip((DARK_PIGMENT - relative) / 0.2, 0, 1) * np.clip(4 * near, 0, 1)
    x, y = window.places()
    beside_nose = np.clip((1 - np.hypot(x / NOSE[0], (y - NOSE[1]) / NOSE[2])) / 0.3, 0, 1)
    pigment = smooth_step(on_face) * dark * (1 - beside_nose)
    typical = _mean_colour(small, weight * np.clip(1.6 - 2 * (small @ LUMA), 0, 1))
    lit_small = cv2.resize(
        np.maximum(sure, inside).astype(np.float32), small.shape[1::-1], interpolation=cv2.INTER_AREA
    )
    cast = _enlarged(_cast(small, lit_small, CAST_SPREAD * window.unit * scale), window)
    lit = np.maximum(skin, inside).astype(np.float32)
    return SkinColour(skin, diffuse, typical, cast, lit, pigment.astype(np.float32))


def _own_colour(scene: np.ndarray, weight: np.ndarray, sigma: float) -> np.ndarray:
    """The skin's colour without highlights, an average that saturated neighbours lead; away from the face its own."""
    saturation = 1 - least_channel(scene) / np.maximum(most_channel(scene), 1e-4)
    led = weight * np.exp(np.clip(SATURATED * saturation, 0, 12))
    colour = scene / np.maximum(scene @ LUMA, 1e-4)[..., None]
    local = blur(colour * led[..., None], sigma) / np.maximum(blur(led, sigma), 1e-6)[..., None]
    total = float((led * weight).sum())
    whole = (local * (led * weight)[..., None]).sum((0, 1)) / max(total, 1e-6) if total > 0 else np.ones(3, np.float32)
    known = np.clip(blur(weight, sigma) * 8, 0, 1)[..., None]
    return known * local + (1 - known) * whole


def _cast(scene: np.ndarray, lit: np.ndarray, sigma: float) -> np.ndarray:
    """How the colour of the light on a place differs from that on all of the face, ``(h, w, 3)``, 1 where it does
    not."""
    local = blur(scene * lit[..., None], sigma)
    local = local / np.maximum(local @ LUMA, 1e-5)[..., None]
    known = np.clip(blur(lit, sigma) * 8, 0, 1)[..., None]
    cast = np.clip(local / np.maximum(_mean_colour(scene, lit), 1e-3), 1 / LARGEST_CAST, LARGEST_CAST)
    return known * cast + (1 - known)


def _mean_colour(scene: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The mean colour ``(3,)`` of luminance 1; white where there is none."""
    total = (scene * weight[..., None]).sum((0, 1))
    level = float(total @ LUMA)
    return (total / level if level > 1e-6 else np.ones(3)).astype(np.float32)


def _skin_elsewhere(scene: np.ndarray, diffuse: np.ndarray, matte: np.ndarray, window: Window) -> np.ndarray:
    """Neck, ears, chest: what the skin's own colour and a white highlight explain, in the matte and near the face."""
    amount, highlight = part_highlight(scene, diffuse)
    luminance = scene @ LUMA
    left = np.sqrt(np.square(scene - amount[..., None] * diffuse - highlight[..., None]).sum(-1))
    left = left / np.maximum(np.sqrt(np.square(scene).sum(-1)), 1e-3)
    like = np.clip((0.085 - left) / 0.035, 0, 1) * np.clip((amount / np.maximum(luminance, 1e-3) - 0.12) / 0.15, 0, 1)
    like = like * np.clip((luminance - 0.02) / 0.03, 0, 1)
    x, y = window.places()
    near = np.clip(4.5 - np.hypot(x, y), 0, 1)
    return blur(like * matte * near, max(0.8, 0.025 * window.unit))


def _enlarged(image: np.ndarray, window: Window) -> np.ndarray:
    return cv2.resize(image.astype(np.float32), window.size[::-1], interpolation=cv2.INTER_LINEAR)
