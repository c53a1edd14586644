"""Photographs on disk: read whatever a camera or an editor writes, upright and in full depth; write atomically."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

__all__ = ["PhotoFile", "find_people", "read_photo", "write_photo"]

FORMATS = ("JPEG", "PNG", "TIFF", "PPM", "BMP", "WEBP")
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".ppm", ".pgm", ".bmp", ".webp")
MAX_PIXELS = 100_000_000


class PhotoFile(NamedTuple):
    """``rgb (H, W, 3)`` float32, sRGB-coded in 0..1; ``alpha (H, W)`` or None."""

    rgb: np.ndarray
    alpha: np.ndarray | None


def read_photo(path: str | Path) -> PhotoFile:
    """Read a JPEG, PNG, TIFF, PPM/PGM, BMP or WebP: EXIF rotation applied; grey, palette, CMYK, alpha and 16-bit understood.

    Raises:
        ValueError: the file cannot be read as a photo; says which file and why.
    """
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of what is refused below
            with Image.open(path, formats=FORMATS) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise ValueError(f"{image.width} x {image.height} pixels, more than {MAX_PIXELS:,}")
                return _decode(ImageOps.exif_transpose(image))
    except UnidentifiedImageError as error:
        raise ValueError(f"{path}: expected a photo ({', '.join(FORMATS)}), got something else") from error
    except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError, MemoryError) as error:
        raise ValueError(f"{path}: expected a readable photo, got {error}") from error


def _decode(image: Image.Image) -> PhotoFile:
    if image.mode in ("I;16", "I;16B", "I;16L", "I", "F"):
        values = np.asarray(image, dtype=np.float32)
        if not np.isfinite(values).all():
            raise ValueError("NaN or infinity in its pixels")
        full = 1.0 if image.mode == "F" and values.max() <= 1.5 else 65535.0
        return PhotoFile(np.repeat((values / full).clip(0, 1)[..., None], 3, axis=2), None)
    has_alpha = "A" in image.getbands() or "transparency" in image.info
    if has_alpha:
        pixels = np.asarray(image.convert("RGBA"), dtype=np.float32) / 255
        return PhotoFile(pixels[..., :3], pixels[..., 3])
    return PhotoFile(np.asarray(image.convert("RGB"), dtype=np.float32) / 255, None)


def write_photo(path: str | Path, rgb: np.ndarray, alpha: np.ndarray | None = None) -> None:
    """Write ``rgb (H, W, 3)`` uint8, with ``alpha (H, W)`` in 0..1 where the format has it; nothing half-written is left behind."""
    path = Path(path)
    keeps_alpha = alpha is not None and path.suffix.lower() in (".png", ".tif", ".tiff", ".webp")
    pixels = np.dstack((rgb, (alpha * 255).round().astype(np.uint8))) if keeps_alpha and alpha is not None else rgb
    kind = Image.registered_extensions().get(path.suffix.lower())
    if kind is None or kind not in (*FORMATS, "GIF"):
        raise ValueError(f"{path}: expected an image file name such as .png or .jpg")
    partial = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(partial, format=kind, **({"quality": 95} if kind == "JPEG" else {}))
        partial.replace(path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise ValueError(f"{path}: could not be written: {error}") from error


def find_people(folder: str | Path) -> dict[str, list[Path]]:
    """Photos by name in either usual layout: ``people/NAME.jpg`` and ``people/NAME/*.jpg``.

    Raises:
        ValueError: no photos, or one name in both layouts.
    """
    folder = Path(folder)
    people: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*")):
        photos = sorted(p for p in path.glob("*") if p.suffix.lower() in SUFFIXES) if path.is_dir() else [path]
        if path.is_file() and path.suffix.lower() not in SUFFIXES:
            continue
        name = path.name if path.is_dir() else path.stem
        if not photos:
            continue
        if name in people:
            raise ValueError(f"{folder}: expected one person of each name, got two called {name!r}")
        people[name] = photos
    if not people:
        raise ValueError(f"{folder}: expected photos as NAME.jpg or NAME/*.jpg, found none")
    return people
