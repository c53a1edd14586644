"""Sixteen bits in several channels, which Pillow reduces to eight: read with OpenCV, written here as PNG and TIFF."""

from __future__ import annotations

import struct
import zlib
from typing import BinaryIO

import cv2
import numpy as np
from PIL import Image
from PIL.TiffImagePlugin import ImageFileDirectory_v2

__all__ = ["has_sixteen_bits", "read_sixteen_bits", "write_png", "write_tiff"]

STRIP_ROWS = 64
Resolution = tuple[float, float]


def has_sixteen_bits(image: Image.Image) -> bool:
    """Whether an open PNG or TIFF has several channels of sixteen bits."""
    if image.format == "PNG":
        return image.mode in ("RGB", "RGBA", "LA") and ";16" in str(image.tile)  # type: ignore[attr-defined]
    if image.format == "TIFF":
        bits = image.tag_v2.get(258, ())  # type: ignore[attr-defined]
        return image.mode in ("RGB", "RGBA") and isinstance(bits, tuple) and set(bits) == {16}
    return False


def read_sixteen_bits(content: bytes, grey: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Colour ``(H, W, 3)`` or, where ``grey``, ``(H, W)``, and alpha ``(H, W)`` or None, uint16.

    OpenCV turns a TIFF upright by itself, a PNG not.

    Raises:
        ValueError: cannot be decoded.
    """
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"broken 16-bit data: {error.err}") from error
    if pixels is None or pixels.dtype != np.uint16 or pixels.ndim != 3 or pixels.shape[2] not in (3, 4):
        raise ValueError("broken or unknown 16-bit data")
    alpha = np.ascontiguousarray(pixels[..., 3]) if pixels.shape[2] == 4 else None
    return np.ascontiguousarray(pixels[..., 0] if grey else pixels[..., 2::-1]), alpha


def write_png(
    file: BinaryIO,
    values: np.ndarray,
    icc: bytes | None,
    exif: bytes | None,
    dpi: Resolution | None,
) -> None:
    """Write ``values (H, W, C)`` uint16, C = 1 grey, 2 grey and alpha, 3 RGB, 4 RGB and alpha."""
    height, width, channels = values.shape
    rows = values.astype(">u2").view(np.uint8).reshape(height, -1)
    coded = np.full((height, rows.shape[1] + 1), 2, np.uint8)  # filter 2: the difference from the row above
    coded[0, 1:] = rows[0]
    coded[1:, 1:] = rows[1:] - rows[:-1]
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, (0, 4, 2, 6)[channels - 1], 0, 0, 0))]
    if icc:
        chunks.append((b"iCCP", b"ICC Profile\0\0" + zlib.compress(icc)))
    if dpi:
        chunks.append((b"pHYs", struct.pack(">IIB", *(round(float(v) / 0.0254) for v in dpi), 1)))
    if exif:
        chunks.append((b"eXIf", exif.removeprefix(b"Exif\0\0")))
    chunks += [(b"IDAT", zlib.compress(coded.tobytes(), 6)), (b"IEND", b"")]
    file.write(b"\x89PNG\r\n\x1a\n")
    for name, data in chunks:
        file.write(struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(name))))


def write_tiff(
    file: BinaryIO,
    values: np.ndarray,
    icc: bytes | None,
    exif: bytes | None,
    dpi: Resolution | None,
) -> None:
    """Write ``values (H, W, C)`` uint16 as for :func:`write_png`, deflated with the horizontal predictor."""
    height, width, channels = values.shape
    values = values.astype("<u2")
    values[:, 1:] -= values[:, :-1].copy()
    strips = [zlib.compress(values[row : row + STRIP_ROWS].tobytes(), 6) for row in range(0, height, STRIP_ROWS)]
    ifd = ImageFileDirectory_v2(prefix=b"II")
    if exif:
        described = Image.Exif()
        described.load(exif)
        for tag, value in described.items():
            ifd[tag] = dict(described.get_ifd(tag)) if tag in (0x8769, 0x8825) else value
    starts = np.cumsum([0, *(len(strip) for strip in strips[:-1])])
    tags = {256: width, 257: height, 258: (16,) * channels, 259: 8, 262: 1 if channels < 3 else 2}
    tags |= {274: 1, 277: channels, 278: STRIP_ROWS, 284: 1, 317: 2}
    tags |= {273: tuple(int(v) for v in starts), 279: tuple(len(strip) for strip in strips)}
    for strip_tag in (273, 279):
        ifd.tagtype[strip_tag] = 4
    if channels in (2, 4):
        tags[338] = 2  # the last channel is alpha, not multiplied in
    if dpi:
        tags |= {282: float(dpi[0]), 283: float(dpi[1]), 296: 2}
    for key, tag_value in tags.items():
        ifd[key] = tag_value
    if icc:
        ifd[34675] = icc
    ifd.save(file)
    for strip in strips:
        file.write(strip)
