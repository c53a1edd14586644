"""A photograph in memory, with what gives the same kind back: depth, grey or colour, profile, EXIF, alpha."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from PIL import Image

from facerelight.photo.files.exif import exif_of, turn_upright
from facerelight.photo.files.profiles import (
    LUMINANCE,
    SRGB,
    SRGB_GREY,
    PlainCmyk,
    Profile,
    decode_codes,
    eight_bits,
    read_profile,
    to_image,
)

__all__ = ["PhotoFile", "from_pillow", "to_pillow"]

LARGEST_SCALE = 8.0  # of what sRGB could not hold, when a pixel becomes lighter


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A photograph, upright.

    Args:
        stored: its own code values without alpha, ``(H, W)`` grey, ``(H, W, 3)`` RGB or ``(H, W, 4)`` CMYK; uint8,
            uint16, or float32 for grey in floating point.
        stored_alpha: ``(H, W)`` of the same depth, or None.
        icc: the embedded profile; None where there is none or where it cannot be used.
        exif: with the orientation set to upright; None where there is none.
        dpi: horizontal and vertical, or None.

    Example:
        >>> photo = PhotoFile(np.full((8, 8), 200, np.uint8))
        >>> photo.mode, photo.bits, photo.pixels.shape, photo.relit(photo.pixels).shape
        ('L', 8, (8, 8, 3), (8, 8))
    """

    stored: np.ndarray
    stored_alpha: np.ndarray | None = None
    icc: bytes | None = None
    exif: bytes | None = None
    dpi: tuple[float, float] | None = None

    @property
    def mode(self) -> str:
        """ "L", "RGB" or "CMYK", with an "A" behind it where there is alpha."""
        return {1: "L", 3: "RGB", 4: "CMYK"}[self.channels] + "A" * (self.stored_alpha is not None)

    @property
    def bits(self) -> int:
        """8 or 16 a channel; 32 for floating point."""
        return 8 * self.stored.dtype.itemsize

    @property
    def channels(self) -> int:
        """1 grey, 3 RGB or 4 CMYK."""
        return 1 if self.stored.ndim == 2 else self.stored.shape[2]

    @cached_property
    def embedded(self) -> Profile | None:
        """The embedded profile; None where there is none or where it cannot be used."""
        return read_profile(self.icc, self.channels) if self.icc else None

    @cached_property
    def profile(self) -> Profile:
        """The colour space of ``stored``: the embedded one, else sRGB, or CMYK as Pillow takes it."""
        plain: dict[int, Profile] = {1: SRGB_GREY, 3: SRGB, 4: PlainCmyk()}
        return self.embedded or plain[self.channels]

    @cached_property
    def pixels(self) -> np.ndarray:
        """``(H, W, 3)`` sRGB-coded, uint8 for 8 bits, else uint16; may be ``stored`` itself: do not write into it."""
        stored = self.stored
        if stored.dtype == np.float32:
            stored = np.rint(stored / self._full * 65535).clip(0, 65535).astype(np.uint16)
        if self.profile is SRGB:
            return stored
        if self.profile is SRGB_GREY:
            return np.repeat(stored[..., None], 3, axis=2)
        return self.profile.to_srgb(stored)

    @property
    def rgb(self) -> np.ndarray:
        """``(H, W, 3)`` float32, sRGB-coded in 0..1."""
        return self.pixels.astype(np.float32) / np.float32(np.iinfo(self.pixels.dtype).max)

    @property
    def alpha(self) -> np.ndarray | None:
        """``(H, W)`` float32 in 0..1, or None."""
        if self.stored_alpha is None:
            return None
        return self.stored_alpha.astype(np.float32) / np.float32(np.iinfo(self.stored_alpha.dtype).max)

    def relit(self, pixels: np.ndarray) -> np.ndarray:
        """``pixels (H, W, 3)``, of the depth of :attr:`pixels`, in the photo's own code values, like :attr:`stored`.

        Where ``pixels`` is what :attr:`pixels` was, the stored values are given back to the bit. Elsewhere the new
        colour goes into the photo's own space, and with it what sRGB could not hold of the old one, scaled as the
        pixel's luminance was. A grey photo takes the luminance.

        Raises:
            ValueError: another shape or type than :attr:`pixels`.
        """
        if pixels.shape != self.pixels.shape or pixels.dtype != self.pixels.dtype:
            expected = f"{self.pixels.shape} {self.pixels.dtype}"
            raise ValueError(f"pixels: expected {expected} as in the photo, got {pixels.shape} {pixels.dtype}")
        if self.profile is SRGB:
            return pixels
        changed = (pixels != self.pixels).any(axis=2)
        before, after = (decode_codes(part[changed]) for part in (self.pixels, pixels))  # (N, 3) linear
        own = self.profile.decode((self.stored[changed] / self._full).reshape(-1, self.channels))
        scale = ((after @ LUMINANCE) / np.maximum(before @ LUMINANCE, 1e-4)).clip(0, LARGEST_SCALE)
        values = self.profile.encode(after + (own - before) * scale[:, None]) * self._full
        out = self.stored.copy()
        out[changed] = (values if out.dtype == np.float32 else np.rint(values)).reshape(out[changed].shape)
        return out

    @property
    def _full(self) -> float:
        """The stored value of white."""
        if self.stored.dtype != np.float32:
            return float(np.iinfo(self.stored.dtype).max)
        return 1.0 if self.stored.max() <= 1.5 else 65535.0


def from_pillow(image: Image.Image) -> PhotoFile:
    """Take a Pillow picture of any mode: turned as its EXIF says, with its profile, alpha and resolution.

    Raises:
        ValueError: NaN or infinity among its pixels, or a mode that Pillow cannot convert.

    Example:
        >>> from_pillow(Image.new("LA", (4, 2), (100, 255))).mode
        'LA'
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow warns of odd EXIF and palettes
        image.load()
        stored, alpha = _channels(image)
        return finished(image, stored, alpha)


def finished(image: Image.Image, stored: np.ndarray, alpha: np.ndarray | None, turned: bool = False) -> PhotoFile:
    """The photo of ``image``, its channels decoded as ``stored`` and ``alpha``, upright already where ``turned``."""
    exif, orientation = exif_of(image)
    if not turned:
        stored, alpha = turn_upright(stored, orientation), None if alpha is None else turn_upright(alpha, orientation)
    icc = image.info.get("icc_profile")
    photo = PhotoFile(stored, alpha, icc if isinstance(icc, bytes) else None, exif, _resolution(image.info.get("dpi")))
    return replace(photo, icc=None) if photo.icc and photo.embedded is None else photo


def to_pillow(photo: PhotoFile, pixels: np.ndarray) -> Image.Image:
    """``photo`` relit as ``pixels (H, W, 3)``: a Pillow picture of its mode, with its profile, EXIF and resolution.

    Sixteen bits in more than one channel, which Pillow has no mode for, become eight.

    Raises:
        ValueError: ``pixels`` of another shape or depth than ``photo.pixels``.
    """
    values, alpha = photo.relit(pixels), photo.stored_alpha
    if values.ndim == 2 and alpha is None and values.dtype != np.uint8:
        image = Image.fromarray(values)  # I;16 or F
    else:
        image = to_image(eight_bits(values))
        if alpha is not None:
            image.putalpha(Image.fromarray(eight_bits(alpha)))
    held = {"icc_profile": photo.icc, "exif": photo.exif, "dpi": photo.dpi}
    image.info.update({name: value for name, value in held.items() if value})
    return image


def _channels(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """Code values and alpha, as stored or in the nearest of grey, RGB and CMYK."""
    if image.mode == "F":
        values = np.array(image, dtype=np.float32)
        if not np.isfinite(values).all():
            raise ValueError("NaN or infinity in its pixels")
        return values, None
    if image.mode == "I" or image.mode.startswith("I;16"):
        return np.array(image).astype(np.int64).clip(0, 65535).astype(np.uint16), None
    grey = image.mode in ("1", "L", "LA", "La")
    alpha = image.mode != "LAB" and not {"A", "a"}.isdisjoint(image.getbands())  # LAB's A is a colour
    if alpha or "transparency" in image.info:
        mode = "LA" if grey else "RGBA"
        whole = np.array(image.convert(mode))
        return np.ascontiguousarray(whole[..., 0] if grey else whole[..., :3]), np.ascontiguousarray(whole[..., -1])
    mode = "L" if grey else "CMYK" if image.mode == "CMYK" else "RGB"
    return np.array(image if image.mode == mode else image.convert(mode)), None


def _resolution(dpi: object) -> tuple[float, float] | None:
    try:
        across, down = (float(v) for v in dpi)  # type: ignore[attr-defined]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return (across, down) if 1 <= across < 65536 and 1 <= down < 65536 else None
