"""Copies of a photograph for the small networks: shrunken, brightened where they are dark, or lit evenly."""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["brighten", "even_out", "shrink"]

BRIGHT = 0.4  # geometric mean of the coded luminance that a darker copy is brought to
STRONGEST = 0.4  # exponent
AROUND = 0.1  # of the longer side: the blur that stands for the light on a place
EVENED, MIDDLE = 0.7, 130  # of the light's contrast goes; the code of what is as bright as its surroundings


def shrink(photo: np.ndarray, side: int) -> np.ndarray:
    """The photo ``(H, W, 3)`` uint8, averaged down to ``side`` pixels on its longer side where it is larger."""
    height, width = photo.shape[:2]
    if max(height, width) <= side:
        return photo
    scale = side / max(height, width)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA)


def brighten(copy: np.ndarray) -> np.ndarray:
    """The copy ``(H, W, 3)`` uint8 raised to a power that brings its exposure to an ordinary one; bright ones as is.

    Example:
        >>> int(brighten(np.full((2, 2, 3), 10, np.uint8))[0, 0, 0])
        70
    """
    grey = cv2.cvtColor(copy, cv2.COLOR_RGB2GRAY)
    mean = float(np.log(np.maximum(grey, 1) / 255).mean())
    if mean >= np.log(BRIGHT):
        return copy
    exponent = max(STRONGEST, float(np.log(BRIGHT)) / mean)
    return cv2.LUT(copy, (255 * (np.arange(256) / 255) ** exponent).round().astype(np.uint8))


def even_out(copy: np.ndarray) -> np.ndarray:
    """The copy ``(H, W, 3)`` uint8 with most of its light divided out (the single-scale retinex of Jobson et al. 1997):
    faces in hard light from below or behind, which the detector was not trained on.

    Example:
        >>> even_out(np.full((4, 4, 3), 10, np.uint8))[0, 0].tolist()
        [130, 130, 130]
    """
    lifted = copy.astype(np.float32) + 2
    light = cv2.GaussianBlur(lifted.mean(2), (0, 0), AROUND * max(copy.shape[:2]))
    return np.clip(MIDDLE * (lifted / light[..., None]) ** EVENED, 0, 255).astype(np.uint8)
