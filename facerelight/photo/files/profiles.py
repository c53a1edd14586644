"""The colour space a photograph's numbers are in: from its embedded ICC profile to sRGB for the relighting, and back.

lcms2 (through Pillow) reads every kind of profile, eight bits at a time and clipped to sRGB. Profiles made of a matrix
and tone curves, which nearly all photographs in RGB or grey carry, are also evaluated here in full depth and without
clipping: that is what gives a relit pixel back in its own space.
"""

from __future__ import annotations

import io
import struct
from typing import Protocol

import numpy as np
from PIL import Image, ImageCms

from facerelight.numerics import luminance

__all__ = ["SRGB", "SRGB_GREY", "MatrixProfile", "PlainCmyk", "Profile", "TableProfile", "eight_bits", "read_profile"]

LUMINANCE = np.array(luminance.LUMINANCE)
SRGB_TO_XYZ = np.array(  # relative to D50, as in the ICC's own sRGB profile
    ((0.4360747, 0.3850649, 0.1430804), (0.2225045, 0.7168786, 0.0606169), (0.0139322, 0.0971045, 0.7141733))
)
CODES = 65536
BAND = 1 << 20  # pixels converted at a time
INTENT = ImageCms.Intent.RELATIVE_COLORIMETRIC
BLACK_POINT = ImageCms.Flags.BLACKPOINTCOMPENSATION


class Profile(Protocol):
    """A colour space of ``C`` channels: 1 grey, 3 RGB or 4 CMYK."""

    def to_srgb(self, stored: np.ndarray) -> np.ndarray:
        """Code values ``(H, W)`` or ``(H, W, C)``, uint8 or uint16, as sRGB ``(H, W, 3)`` of that depth, clipped."""

    def decode(self, values: np.ndarray) -> np.ndarray:
        """``(N, C)`` in 0..1 as linear sRGB ``(N, 3)``; below 0 or above 1 where sRGB does not reach."""

    def encode(self, linear: np.ndarray) -> np.ndarray:
        """The inverse of :meth:`decode`, clipped to 0..1."""


class MatrixProfile:
    """Tone curves, then a matrix to the XYZ of D50; one curve and no matrix for grey.

    Args:
        curves: linear value of each of 65,536 code values, ``(C, 65536)``, rising.
        matrix: ``(3, 3)``, its columns the XYZ of the primaries; None for grey.
        icc: the profile itself, with which lcms2 converts eight bits; None converts here.
    """

    def __init__(self, curves: np.ndarray, matrix: np.ndarray | None, icc: bytes | None = None) -> None:
        self.curves = np.maximum.accumulate(curves, axis=1)
        self.to_linear = None if matrix is None else np.linalg.solve(SRGB_TO_XYZ, matrix)
        self.table = None if icc is None else TableProfile(icc)

    def to_srgb(self, stored: np.ndarray) -> np.ndarray:
        if stored.dtype == np.uint8 and self.table is not None:
            return self.table.to_srgb(stored)
        flat = stored.reshape(-1, len(self.curves))
        full = np.iinfo(stored.dtype).max
        out = np.empty((len(flat), 3), stored.dtype)
        for start in range(0, len(flat), BAND):
            part = slice(start, start + BAND)
            out[part] = np.rint(encode_srgb(self.decode(flat[part] / np.float32(full))) * full)
        return out.reshape(*stored.shape[:2], 3)

    def decode(self, values: np.ndarray) -> np.ndarray:
        codes = np.rint(values.clip(0, 1) * (CODES - 1)).astype(np.uint16)
        linear = np.stack([curve[codes[:, k]] for k, curve in enumerate(self.curves)], axis=1)
        return np.repeat(linear, 3, axis=1) if self.to_linear is None else linear @ self.to_linear.T

    def encode(self, linear: np.ndarray) -> np.ndarray:
        own = (linear @ LUMINANCE)[:, None] if self.to_linear is None else linear @ np.linalg.inv(self.to_linear).T
        codes = np.linspace(0, 1, CODES)
        return np.stack([np.interp(own[:, k], curve, codes) for k, curve in enumerate(self.curves)], axis=1)


class TableProfile:
    """Any profile that lcms2 can read, eight bits a channel; relative colorimetric, CMYK with matched black."""

    def __init__(self, icc: bytes) -> None:
        own = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        self.mode = {"GRAY": "L", "RGB": "RGB", "CMYK": "CMYK"}[own.profile.xcolor_space.strip()]
        self._flags = BLACK_POINT if self.mode == "CMYK" else ImageCms.Flags.NONE
        srgb = ImageCms.createProfile("sRGB")
        self.forward = ImageCms.buildTransform(own, srgb, self.mode, "RGB", INTENT, self._flags)
        self._pair = own, srgb
        self._back: ImageCms.ImageCmsTransform | None = None

    def to_srgb(self, stored: np.ndarray) -> np.ndarray:
        deep = stored.dtype == np.uint16
        pixels = np.array(ImageCms.applyTransform(to_image(eight_bits(stored)), self.forward))
        return pixels.astype(np.uint16) * 257 if deep else pixels

    def decode(self, values: np.ndarray) -> np.ndarray:
        codes = np.rint(values * 255).astype(np.uint8)[None]  # (1, N, C)
        return decode_srgb(self.to_srgb(codes[..., 0] if self.mode == "L" else codes)[0] / 255)

    def encode(self, linear: np.ndarray) -> np.ndarray:
        if self._back is None:
            own, srgb = self._pair
            self._back = ImageCms.buildTransform(srgb, own, "RGB", self.mode, INTENT, self._flags)
        codes = np.rint(encode_srgb(linear) * 255).astype(np.uint8)[None]
        values = np.array(ImageCms.applyTransform(to_image(codes), self._back))
        return values.reshape(len(linear), {"L": 1, "RGB": 3, "CMYK": 4}[self.mode]) / 255


class PlainCmyk:
    """CMYK without a profile, as Pillow takes it: red is what neither cyan nor black cover."""

    def to_srgb(self, stored: np.ndarray) -> np.ndarray:
        return np.array(to_image(stored).convert("RGB"))

    def decode(self, values: np.ndarray) -> np.ndarray:
        return decode_srgb((1 - values[:, :3]) * (1 - values[:, 3:]))

    def encode(self, linear: np.ndarray) -> np.ndarray:
        """All of the black that the colour allows, and the rest in coloured ink."""
        coded = encode_srgb(linear)
        white = coded.max(axis=1, keepdims=True)
        return np.hstack((1 - coded / np.maximum(white, 1e-6), 1 - white)).clip(0, 1)


def read_profile(icc: bytes, channels: int) -> Profile | None:
    """The space of an embedded profile, :data:`SRGB` where it is that; None where broken or not of ``channels``."""
    try:
        table = TableProfile(icc)
    except (OSError, KeyError, ValueError, TypeError, ImageCms.PyCMSError):
        return None
    if {"L": 1, "RGB": 3, "CMYK": 4}[table.mode] != channels:
        return None
    exact = None if table.mode == "CMYK" or _tag(icc, b"A2B0") else _matrix_profile(icc, channels)
    return SRGB if channels == 3 and _is_srgb(table) else exact or table


def _is_srgb(profile: Profile) -> bool:
    """Whether greys and primaries come out as they went in, to a rounding."""
    ramp = np.arange(256, dtype=np.uint8)[:, None, None]
    probe = ramp * np.array(((1, 1, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1)), np.uint8)
    return bool(np.abs(profile.to_srgb(probe).astype(int) - probe).max() <= 1)


def _matrix_profile(icc: bytes, channels: int) -> MatrixProfile | None:
    names = (b"kTRC",) if channels == 1 else (b"rTRC", b"gTRC", b"bTRC")
    try:
        curves = np.stack([_curve(_tag(icc, name)) for name in names])
        if channels == 1:
            return MatrixProfile(curves, None, icc)
        columns = [struct.unpack(">3i", _tag(icc, name)[8:20]) for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
        return MatrixProfile(curves, np.array(columns, float).T / 65536, icc)
    except (ValueError, ZeroDivisionError, struct.error, np.linalg.LinAlgError):
        return None


def _tag(icc: bytes, name: bytes) -> bytes:
    """The data of a tag; empty where there is none."""
    (count,) = struct.unpack(">I", icc[128:132])
    for start in range(132, min(132 + 12 * count, len(icc) - 11), 12):
        found, offset, size = struct.unpack(">4sII", icc[start : start + 12])
        if found == name:
            return icc[offset : offset + size]
    return b""


def _curve(tag: bytes) -> np.ndarray:
    """Linear value of each of 65,536 codes, from a curveType or a parametricCurveType."""
    x = np.linspace(0, 1, CODES)
    if tag[:4] == b"curv":
        (count,) = struct.unpack(">I", tag[8:12])
        points = np.array(struct.unpack(f">{count}H", tag[12 : 12 + 2 * count]), float)
        if count == 0:
            return x
        return x ** (points[0] / 256) if count == 1 else np.interp(x, np.linspace(0, 1, count), points / 65535)
    if tag[:4] == b"para" and tag[8:9] == b"\0" and tag[9] < 5:
        count = (1, 3, 4, 5, 7)[tag[9]]
        values = [v / 65536 for v in struct.unpack(f">{count}i", tag[12 : 12 + 4 * count])]
        if count == 1:
            return x ** values[0]
        g, a, b, *more = values
        # (a x + b)^g + e from d on, c x + f below
        c, d, e, f = {3: (0, -b / a, 0, 0), 4: (0, -b / a, *more, *more), 5: (*more, 0, 0), 7: tuple(more)}[count]
        return np.where(x >= d, np.maximum(a * x + b, 0) ** g + e, c * x + f).clip(0, 1)
    raise ValueError(f"ICC profile: expected a curve or a parametric curve, got {tag[:4]!r}")


def decode_srgb(coded: np.ndarray) -> np.ndarray:
    """Linear light of sRGB-coded values in 0..1."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def decode_codes(pixels: np.ndarray) -> np.ndarray:
    """Linear light of sRGB code values, uint8 or uint16."""
    return _SRGB_CURVE[pixels if pixels.dtype == np.uint16 else pixels.astype(np.uint16) * 257]


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """sRGB-coded values in 0..1 of linear light, clipped."""
    linear = linear.clip(0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def eight_bits(stored: np.ndarray) -> np.ndarray:
    """uint16 code values rounded to uint8; uint8 as it is."""
    return ((stored.astype(np.uint32) + 128) // 257).astype(np.uint8) if stored.dtype == np.uint16 else stored


def to_image(stored: np.ndarray) -> Image.Image:
    """A Pillow picture of ``(H, W)`` grey, ``(H, W, 3)`` RGB or ``(H, W, 4)`` CMYK, uint8."""
    if stored.ndim == 2 or stored.shape[2] == 3:
        return Image.fromarray(np.ascontiguousarray(stored))
    return Image.frombytes("CMYK", (stored.shape[1], stored.shape[0]), stored.tobytes())


_SRGB_CURVE = decode_srgb(np.linspace(0, 1, CODES))
SRGB = MatrixProfile(np.repeat(_SRGB_CURVE[None], 3, axis=0), SRGB_TO_XYZ)
SRGB_GREY = MatrixProfile(_SRGB_CURVE[None], None)
