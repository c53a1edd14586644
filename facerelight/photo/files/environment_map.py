"""Environment maps from disk: Radiance .hdr, OpenEXR .exr, and pictures of 8 or 16 bits, through OpenCV."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

__all__ = ["MAP_SUFFIXES", "read_environment"]

MAP_SUFFIXES = (".hdr", ".exr", ".png", ".jpg", ".jpeg", ".tif", ".tiff")
LARGEST = 512  # rows that are read on with; light needs no more


def read_environment(path: str | Path) -> Tensor:
    """Linear radiance ``(H, W, 3)`` of an equirectangular map; pictures of integers are taken for sRGB.

    Raises:
        ValueError: no such file, another kind of file, a broken one, or one that is not twice as wide as high.
    """
    path = Path(path)
    if path.suffix.lower() not in MAP_SUFFIXES:
        raise ValueError(f"{path}: expected an environment map ({', '.join(MAP_SUFFIXES)})")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # read when the first picture is
    import cv2

    try:
        values = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(f"{path}: expected a readable map, OpenCV says {str(error).strip()}") from error
    if values is None:
        raise ValueError(f"{path}: expected a readable map; the file is broken or of another kind than it says")
    height, width = values.shape[:2]
    if not 1.9 <= width / height <= 2.1:
        raise ValueError(f"{path}: expected an equirectangular map, twice as wide as high, got {width} x {height}")
    colour = np.repeat(values[..., None], 3, 2) if values.ndim == 2 else values[..., 2::-1]
    radiance = np.ascontiguousarray(_decoded(colour) if colour.dtype.kind in "ui" else colour, np.float32)
    if not np.isfinite(radiance).all() or (radiance < 0).any():
        raise ValueError(f"{path}: expected finite radiance of 0 or more, got NaN, infinite or negative values")
    if height > LARGEST:
        return torch.from_numpy(cv2.resize(radiance, (2 * LARGEST, LARGEST), interpolation=cv2.INTER_AREA))
    return torch.from_numpy(radiance)


def _decoded(coded: np.ndarray) -> np.ndarray:
    """Linear light of sRGB in integers."""
    share = coded / (255 if coded.dtype == np.uint8 else 65535)
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
