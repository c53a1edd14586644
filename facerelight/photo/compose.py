"""The photograph's own pixels under a new light: maps made on a small copy of the window, put on at full resolution,
strip by strip.

Nothing outside the person's cover is touched, and no more memory is taken than a strip of the window needs.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.photo.bust.frame import Window
from facerelight.photo.colour import SkinColour, relit_radiance, to_display, to_scene
from facerelight.photo.files.pixels import scale_of

__all__ = ["Changes", "change_pixels"]

MOST = 2.0  # times its cover is the largest share that a person may have in a pixel
STRIP = 1 << 17  # pixels worked on at once


class Changes(NamedTuple):
    """What happens to a window, on its copy: ``log_ratio (h, w, C)`` of scene radiance, the ``skin``, the person's
    ``cover (h, w)`` in 0..1, the ``ground (h, w, 3)`` behind, ``change``, how surely the light is another, 0 to 1, and
    ``strength``, from 0 (nothing) to 1 (all of it)."""

    log_ratio: np.ndarray
    skin: SkinColour
    cover: np.ndarray
    ground: np.ndarray
    change: float
    strength: float


def change_pixels(pixels: np.ndarray, window: Window, changes: Changes) -> np.ndarray:
    """``pixels (H, W, 3)`` with the window changed; where the cover is 0 they keep their values.

    The mixture of photo and relit picture is one of radiance, and a pixel whose radiance does not change keeps its own
    code.
    """
    out = pixels.copy()
    height, width = out[window.rows, window.columns].shape[:2]
    if changes.strength == 0:
        return out
    rows = max(1, STRIP // width)
    per_pixel = {name: image for name, image in changes.skin._asdict().items() if image.ndim > 1}

    def change(top: int) -> None:
        strip = slice(window.rows.start + top, window.rows.start + min(top + rows, height)), window.columns
        source = pixels[strip]
        cover = _part(changes.cover, top, len(source), (height, width))[..., None]
        if not cover.any():
            return
        maps = {name: _part(image, top, len(source), (height, width)) for name, image in per_pixel.items()}
        colour = changes.skin._replace(**maps)
        log_ratio = _part(changes.log_ratio, top, len(source), (height, width)).reshape(*cover.shape[:2], -1)
        scene = to_scene(source.astype(np.float32) / np.float32(scale_of(pixels)))
        ground = _part(changes.ground, top, len(source), (height, width))
        person = _of_person(scene, cover, ground)
        relit = relit_radiance(person, log_ratio, colour, changes.change)
        shown = to_display(scene + np.float32(changes.strength) * (relit - person), scene)
        out[strip] = np.where(cover > 0, _coded(shown, pixels), source)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(change, range(0, height, rows)))
    return out


def _of_person(scene: np.ndarray, cover: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """The person's share of radiance ``(h, w, 3)``: what is left of a pixel without the ground that shows beside it."""
    return np.clip(scene - (1 - cover) * ground, 0, scene * np.minimum(MOST * cover, 1))


def _coded(shown: np.ndarray, like: np.ndarray) -> np.ndarray:
    """sRGB codes in 0..1 as values of the dtype of ``like``."""
    if like.dtype.kind == "f":
        return shown.clip(0, 1)
    white = scale_of(like)
    return np.floor(shown * np.float32(white) + 0.5).clip(0, white).astype(like.dtype)


def _part(image: np.ndarray, top: int, rows: int, size: tuple[int, int]) -> np.ndarray:
    """Rows ``top`` to ``top + rows`` of ``image`` enlarged to ``size`` (H, W), without making the rest."""
    sy, sx = image.shape[0] / size[0], image.shape[1] / size[1]
    matrix = np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, (top + 0.5) * sy - 0.5]])
    return cv2.warpAffine(
        image, matrix, (size[1], rows), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
