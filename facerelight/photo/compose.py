"""The photograph's own pixels under a new light: maps made on a small copy of the window, put on at full resolution,
strip by strip.

Nothing outside the person's cover is touched, and no more memory is taken than a strip of the window needs.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
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
        source = np.ascontiguousarray(pixels[strip])
        cover = _part(changes.cover, top, len(source), (height, width))
        covered = np.flatnonzero(cover)
        if not len(covered):
            return

        def of_person(image: np.ndarray) -> np.ndarray:
            """``image (h', w', ...)`` at the covered pixels, ``(1, N, ...)``."""
            return _taken(_part(image, top, len(source), (height, width)), covered)

        colour = changes.skin._replace(**{name: of_person(image) for name, image in per_pixel.items()})
        log_ratio = of_person(changes.log_ratio.reshape(*changes.log_ratio.shape[:2], -1))
        log_ratio = log_ratio.reshape(1, log_ratio.shape[1], -1)
        scene = _scene(_taken(source, covered))
        person = _of_person(scene, _taken(cover, covered)[..., None], of_person(changes.ground))
        relit = relit_radiance(person, log_ratio, colour, changes.change)
        shown = to_display(scene + np.float32(changes.strength) * (relit - person), scene)
        changed = source.copy().reshape(-1, 3)
        changed[covered] = _coded(shown, pixels)[0]
        out[strip] = changed.reshape(source.shape)

    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(change, range(0, height, rows)))
    return out


def _taken(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """``image (h, w, ...)`` at ``places (N,)``, numbers of pixels, ``(1, N, ...)``."""
    return np.take(image.reshape(-1, *image.shape[2:]), places, axis=0)[None]


def _scene(pixels: np.ndarray) -> np.ndarray:
    """Radiance of ``pixels (..., 3)`` of any dtype."""
    if pixels.dtype == np.uint8:
        return _byte_scene()[pixels]
    return to_scene(pixels.astype(np.float32) / np.float32(scale_of(pixels)))


@cache
def _byte_scene() -> np.ndarray:
    """Radiance of every code of a byte, ``(256,)``."""
    return to_scene(np.arange(256, dtype=np.float32) / np.float32(255))


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
