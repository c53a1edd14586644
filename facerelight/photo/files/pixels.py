"""Arrays of pixels: whatever dtype and channels a caller has, seen as RGB, and given back as they came."""

from __future__ import annotations

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window

__all__ = ["as_bytes", "as_rgb", "like", "small_copy"]

LEAST_SIDE = 8  # pixels of a photograph
BYTES_SIDE = 1600  # detectors need no more


def as_rgb(photo: np.ndarray) -> np.ndarray:
    """``photo`` as ``(H, W, 3)`` of its own dtype (no copy where it is that already); floats as float32.

    Args:
        photo: ``(H, W)``, ``(H, W, 1)``, ``(H, W, 3)`` or ``(H, W, 4)`` of uint8, uint16 or float in 0..1.

    Raises:
        ValueError: another shape, dtype or range.
    """
    if (
        not isinstance(photo, np.ndarray)
        or photo.ndim not in (2, 3)
        or (photo.ndim == 3 and photo.shape[2] not in (1, 3, 4))
    ):
        shape = getattr(photo, "shape", type(photo).__name__)
        raise ValueError(
            f"photo: expected an array (H, W), (H, W, 3) or (H, W, 4), got {shape}; "
            "relight() takes what PIL.Image.open gives as well"
        )
    if min(photo.shape[:2]) < LEAST_SIDE:
        raise ValueError(f"photo: expected (H, W, 3) of at least {LEAST_SIDE} x {LEAST_SIDE} pixels, got {photo.shape}")
    colour = (
        photo[..., :3]
        if photo.ndim == 3 and photo.shape[2] > 1
        else np.repeat(photo.reshape(*photo.shape[:2], 1), 3, axis=2)
    )
    if colour.dtype in (np.uint8, np.uint16):
        return colour
    if (
        not np.issubdtype(colour.dtype, np.floating)
        or not np.isfinite(colour).all()
        or colour.min() < 0
        or colour.max() > 1
    ):
        raise ValueError(
            f"photo: expected uint8, uint16 or float in 0..1, got {photo.dtype} with values up to {colour.max():g}"
        )
    return colour.astype(np.float32)


def like(photo: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """``rgb (H, W, 3)`` with the channels and the dtype of ``photo``; alpha is the photo's, grey the luminance-weighted
    mean of the codes."""
    if photo.ndim == 3 and photo.shape[2] in (3, 4):
        return (
            np.concatenate((rgb, photo[..., 3:]), axis=2).astype(photo.dtype, copy=False)
            if photo.shape[2] == 4
            else rgb.astype(photo.dtype, copy=False)
        )
    grey = rgb[..., 1]  # all channels are alike but for rounding
    return grey.reshape(photo.shape).astype(photo.dtype, copy=False)


def scale_of(pixels: np.ndarray) -> float:
    """The code value of white."""
    return 255.0 if pixels.dtype == np.uint8 else 65535.0 if pixels.dtype == np.uint16 else 1.0


def as_bytes(pixels: np.ndarray) -> np.ndarray:
    """``(H, W, 3)`` as uint8."""
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype == np.uint16:
        return np.ascontiguousarray(pixels >> 8).astype(np.uint8)
    return (pixels * 255).round().astype(np.uint8)


def small_copy(pixels: np.ndarray, window: Window) -> np.ndarray:
    """The window's copy, sRGB-coded ``(h, w, 3)`` float32 in 0..1, averaged down so that nothing aliases."""
    part = np.ascontiguousarray(pixels[window.rows, window.columns])
    small = part if part.shape[:2] == window.size else cv2.resize(part, window.size[::-1], interpolation=cv2.INTER_AREA)
    return small.astype(np.float32) / np.float32(scale_of(pixels))
