"""Layers as files: pictures of 16 bits that other programs read, and what they mean as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from facerelight.geometry.environment import paint_environment
from facerelight.photo.files.disk import write_photo
from facerelight.photo.files.photograph import PhotoFile
from facerelight.photo.files.pixels import as_bytes
from facerelight.photo.layers.decomposition import STRIP, Decomposition

__all__ = ["FILES", "layer_pictures", "needle_picture", "write_layers"]

FILES = {
    "reflectance.png": "sRGB; decode it, multiply, add, encode: reflectance x shading + highlights is the photo",
    "shading.png": "sRGB; 1 is middle grey (137 of 255), white is 4; times what of the reflectance is above white",
    "highlights.png": "sRGB; what skin mirrors, to be added",
    "normals.png": "(n + 1) / 2, linear: red to image-right, green up, blue to the camera; beyond the face a guess",
    "needles.png": "the same as needles: each points where the surface faces, and is longer the more it turns away",
    "normals_std.png": "linear; white is an error of 45 degrees (root mean square); of the face alone",
    "reflectance_std.png": "linear; white is a standard deviation as large as the reflectance; of the face alone",
    "light.png": "equirectangular, sRGB, the camera in the middle, the right half at image-left; for --environment",
    "decomposition.json": "the light in numbers, and what the files hold",
}
SHADING_WHITE, DEGREES_WHITE = 4.0, 45.0
MAP_ROWS = 256
NEEDLE_STEP, NEEDLE_LENGTH = 0.2, 0.22  # eye distances
NEEDLE = (255, 140, 0)


def layer_pictures(parts: Decomposition) -> Iterator[tuple[str, np.ndarray, np.ndarray | None]]:
    """Name, values ``(H, W, 3)`` or ``(H, W)`` uint16 (needles: uint8), and alpha ``(H, W)`` uint16 or None of every
    picture, made one after the other."""
    cover = _codes(parts.matte)
    reflectance = parts.reflectance
    yield "reflectance.png", _srgb(reflectance), cover
    above = np.maximum(reflectance, 1, out=reflectance)  # white goes no higher: the rest is put on the shading
    yield "shading.png", _srgb(above * parts.shading, SHADING_WHITE), cover
    del reflectance, above
    yield "highlights.png", _srgb(parts.highlights), None
    normals = parts.normals
    normals[~normals.any(-1)] = (0, 0, 1)
    yield "normals.png", _codes(normals, lambda part: (part + 1) / 2), cover
    del normals
    yield "needles.png", needle_picture(parts), None
    face = _codes(parts.face)
    yield "normals_std.png", _codes(parts.normals_std, lambda part: part / DEGREES_WHITE), face
    yield "reflectance_std.png", _codes(parts.reflectance_std), face
    yield "light.png", _srgb(paint_environment(parts.light.mixture, MAP_ROWS).numpy()), None


def needle_picture(parts: Decomposition) -> np.ndarray:
    """Normals as needles over the grey photograph, ``(H, W, 3)`` uint8."""
    grey = cv2.cvtColor(as_bytes(parts.pixels), cv2.COLOR_RGB2GRAY)
    picture = np.repeat((0.55 * grey)[..., None].astype(np.uint8), 3, axis=2)
    normals, unit = parts.normals, parts.unit
    step, reach, thick = max(4, round(NEEDLE_STEP * unit)), NEEDLE_LENGTH * unit, max(1, round(unit / 90))
    for y in range(step // 2, parts.size[0], step):
        for x in range(step // 2, parts.size[1], step):
            nx, ny, _ = normals[y, x]
            if normals[y, x].any():
                end = round((x + reach * float(nx)) * 16), round((y - reach * float(ny)) * 16)
                cv2.line(picture, (x * 16, y * 16), end, NEEDLE, thick, cv2.LINE_AA, 4)
                cv2.circle(picture, (x * 16, y * 16), thick * 16, NEEDLE, -1, cv2.LINE_AA, 4)
    return picture


def write_layers(parts: Decomposition, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Write all files of :data:`FILES` into ``folder``; ``about`` begins the JSON, which is returned.

    Raises:
        ValueError: a place that cannot be written to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, values, alpha in layer_pictures(parts):
        rgb = values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=2)
        write_photo(folder / name, rgb, PhotoFile(values, alpha))
    mixture = parts.light.mixture
    front = float((mixture.weights.mean(1) * mixture.directions[:, 2].clamp_min(0)).sum())
    light = parts.light.report() | {"map": "light.png", "exposure": round(math.log2(max(front, 1e-6)), 3)}
    report = about | {
        "light": light,
        "scale": "reflectance has none of its own: shading is 1 on average over the face",
        "files": FILES,
    }
    (folder / "decomposition.json").write_text(json.dumps(report, indent=2) + "\n", "utf-8")
    return report


def _srgb(linear: np.ndarray, white: float = 1.0) -> np.ndarray:
    """Linear values, 1 being ``1 / white`` of white, in sRGB codes of 16 bits."""

    def coded(part: np.ndarray) -> np.ndarray:
        share = np.clip(part / np.float32(white), 0, 1)
        return np.where(share <= 0.0031308, 12.92 * share, 1.055 * np.power(share, np.float32(1 / 2.4)) - 0.055)

    return _codes(linear, coded)


def _codes(values: np.ndarray, share: Callable[[np.ndarray], np.ndarray] = lambda part: part) -> np.ndarray:
    """``share`` of values, 0..1, in 16 bits; worked out strip by strip."""
    out = np.empty(values.shape, np.uint16)
    step = max(1, STRIP // values.shape[1])
    for top in range(0, len(values), step):
        part = share(values[top : top + step])
        out[top : top + step] = np.rint(np.clip(part, 0, 1) * 65535)
    return out
