"""What the surface of skin mirrors, parted from the skin itself.

Relighting asks how highlights move, and takes much of pale skin for one; a reflectance that is tanned by as much would
be nobody's. Here a highlight is the white that a place holds beyond what this skin usually holds, and beyond the
brightness of the skin around it. Where a camera has lost the skin's colour in it, the skin below takes its usual one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from facerelight.photo.bust.frame import blur
from facerelight.photo.colour import LUMA, part_highlight

__all__ = ["OwnSkin", "own_skin", "without_highlights"]

USUAL = 0.6  # quantile of how much white is in skin that counts as its own
AROUND = 0.3  # units over which skin is compared
CLEAR, HIDDEN = 0.08, 0.3  # of a place's luminance: highlights from which, and at which, the skin's colour is lost


class OwnSkin(NamedTuple):
    """``where (h, w)`` in 0..1; ``diffuse (h, w, 3)``, the most saturated colour around, of luminance 1; ``pale``, how
    much white goes with it on most of the face; ``level (h, w)``, the luminance of the skin around without
    highlights."""

    where: np.ndarray
    diffuse: np.ndarray
    pale: float
    level: np.ndarray


def own_skin(scene: np.ndarray, where: np.ndarray, diffuse: np.ndarray, unit: float) -> OwnSkin:
    """The skin of ``scene (h, w, 3)``, radiance, ``where (h, w)`` it is, 0 to 1; ``diffuse (h, w, 3)`` as in
    :class:`facerelight.photo.colour.SkinColour`; ``unit``: pixels between the eyes."""
    amount, white = part_highlight(scene, diffuse)
    sure = where > 0.6
    pale = float(np.quantile((white / np.maximum(amount, 1e-4))[sure], USUAL)) if sure.any() else 0.0
    luminance = scene @ LUMA
    plain = where * np.clip(1 - np.maximum(white - pale * amount, 0) / (CLEAR * np.maximum(luminance, 1e-4)), 0, 1)
    weight = plain + 1e-3 * where
    around = np.maximum(blur(weight, AROUND * unit), 1e-6)
    return OwnSkin(where, diffuse, pale, (blur(luminance * weight, AROUND * unit) / around).astype(np.float32))


def without_highlights(scene: np.ndarray, skin: OwnSkin) -> np.ndarray:
    """``scene (h, w, 3)`` less what is mirrored; nowhere more than it was, channel by channel."""
    amount, white = part_highlight(scene, skin.diffuse)
    luminance = scene @ LUMA
    highlight = np.clip(white - skin.pale * amount, 0, np.maximum(luminance - skin.level, 0)) * skin.where
    body = scene - highlight[..., None]
    usual = skin.diffuse + np.float32(skin.pale)
    usual = usual * ((luminance - highlight) / np.maximum(usual @ LUMA, 1e-4))[..., None]
    share = highlight / np.maximum(luminance, 1e-4)
    hidden = np.clip((share - CLEAR) / (HIDDEN - CLEAR), 0, 1)[..., None]
    return np.minimum(body + hidden * (usual - body), scene)
