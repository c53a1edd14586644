"""EXIF as bytes: kept to the letter, but for the orientation, which is applied, and the thumbnail, which is old."""

from __future__ import annotations

import struct
import warnings

import numpy as np
from PIL import Image

__all__ = ["exif_of", "turn_upright"]

PREFIX = b"Exif\0\0"
ORIENTATION = 0x0112
DESCRIBING = (0x010E, 0x010F, 0x0110, 0x0131, 0x0132, 0x013B, 0x8298)  # not how a TIFF is stored


def exif_of(image: Image.Image) -> tuple[bytes | None, int]:
    """The EXIF of an open picture, marked upright and without a thumbnail, and the orientation it had (1 to 8).

    Returns:
        ``(exif, orientation)``; exif None where there is none or where it is broken.
    """
    orientation = 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = image.getexif()
            if found.get(ORIENTATION) in range(1, 9):
                orientation = found[ORIENTATION]
            raw = _described(found) if image.format == "TIFF" else image.info.get("exif") or found.tobytes()
            raw = _upright(raw.removeprefix(PREFIX))
            check = Image.Exif()
            check.load(PREFIX + raw)
            check.get_ifd(0x8769)
            check.tobytes()
            return PREFIX + raw if len(check) else None, orientation
    except Exception:  # broken EXIF makes Pillow raise nearly anything; the picture is good without it
        return None, orientation


def turn_upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """``pixels (H, W, ...)`` as stored, turned and mirrored as the EXIF orientation says."""
    if orientation >= 5:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels)


def _described(tags: Image.Exif) -> bytes:
    kept = Image.Exif()
    for tag in DESCRIBING:
        if tag in tags:
            kept[tag] = tags[tag]
    for tag in (0x8769, 0x8825):  # the camera's settings, the place
        entries = tags.get_ifd(tag)
        if entries:
            kept.get_ifd(tag).update(entries)
            kept[tag] = dict(entries)
    return kept.tobytes()


def _upright(raw: bytes) -> bytes:
    """TIFF-framed EXIF with orientation 1 and no second directory, where the thumbnail is."""
    order = "<" if raw[:2] == b"II" else ">"
    (start,) = struct.unpack(order + "I", raw[4:8])
    (count,) = struct.unpack(order + "H", raw[start : start + 2])
    changed = bytearray(raw)
    for place in range(start + 2, start + 2 + 12 * count, 12):
        if struct.unpack(order + "H", raw[place : place + 2])[0] == ORIENTATION:
            changed[place + 2 : place + 12] = struct.pack(order + "HIHH", 3, 1, 1, 0)
    end = start + 2 + 12 * count
    changed[end : end + 4] = bytes(4)
    return bytes(changed)
