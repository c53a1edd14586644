"""Photographs on disk: read whatever a camera or an editor writes, and give the same kind of picture back, atomically.

What a file holds is kept: bits a channel, grey or colour, CMYK, alpha, the colour profile, EXIF and resolution. Pixels
that were not relit keep their stored values to the bit in formats without loss. What the format asked for cannot hold
is converted, see :func:`not_held`.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from PIL import Image, UnidentifiedImageError, features

from facerelight.photo.files.photograph import PhotoFile, finished, from_pillow, to_pillow
from facerelight.photo.files.profiles import eight_bits, to_image
from facerelight.photo.files.sixteen_bits import has_sixteen_bits, read_sixteen_bits, write_png, write_tiff

__all__ = [
    "SUFFIXES",
    "PhotoFile",
    "check_writable",
    "find_people",
    "find_photos",
    "from_pillow",
    "not_held",
    "read_photo",
    "to_pillow",
    "write_photo",
]

MAX_PIXELS = 100_000_000
BROKEN = (OSError, ValueError, SyntaxError, EOFError, RuntimeError, MemoryError)  # what Pillow's decoders raise
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")


class Format(NamedTuple):
    """What a file format can hold, and how it is written."""

    suffixes: tuple[str, ...]
    grey: bool = False
    cmyk: bool = False
    alpha: bool = False
    deep: bool = False
    profile: bool = False
    options: dict[str, Any] = {}  # noqa: RUF012 - a constant


FORMATS = {
    "JPEG": Format((".jpg", ".jpeg"), grey=True, cmyk=True, profile=True, options={"quality": 95, "subsampling": 0}),
    "PNG": Format((".png",), grey=True, alpha=True, deep=True, profile=True),
    "TIFF": Format((".tif", ".tiff"), grey=True, cmyk=True, alpha=True, deep=True, profile=True),
    "PPM": Format((".ppm", ".pgm"), grey=True),
    "BMP": Format((".bmp",), grey=True),
    "WEBP": Format((".webp",), alpha=True, profile=True, options={"quality": 95}),
    "AVIF": Format((".avif",), alpha=True, profile=True, options={"quality": 95, "subsampling": "4:4:4"}),
    "HEIF": Format((".heic", ".heif"), alpha=True, profile=True, options={"quality": 95, "chroma": 444}),
}
SUFFIXES = tuple(suffix for kind in FORMATS.values() for suffix in kind.suffixes)


def read_photo(path: str | Path) -> PhotoFile:
    """Read a JPEG, PNG, TIFF, PPM/PGM, BMP, WebP, AVIF or, with the package pillow-heif, HEIC photo.

    The EXIF orientation is applied; grey, palette, CMYK, alpha, 16 bits a channel, grey floating point and embedded
    profiles are understood.

    Raises:
        ValueError: the file cannot be read as a photo; says which file and why.
    """
    path = Path(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of what is refused below
            with Image.open(path, formats=_formats()) as image:
                if image.width * image.height > MAX_PIXELS:
                    raise ValueError(f"{image.width} x {image.height} pixels, more than {MAX_PIXELS:,}")
                photo = _deep(path, image) if has_sixteen_bits(image) else from_pillow(image)
            _ = photo.pixels  # a profile that cannot be used shows here
            return photo
    except UnidentifiedImageError as error:
        raise ValueError(f"{path}: expected a photo ({', '.join(_formats())}), got {_something_else(path)}") from error
    except (*BROKEN, Image.DecompressionBombError) as error:
        raise ValueError(
            f"{path}: expected a readable photo, got {getattr(error, 'strerror', None) or error}"
        ) from error


def write_photo(path: str | Path, pixels: np.ndarray, like: PhotoFile | None = None) -> None:
    """Write a relit photo; an existing file is replaced only once the new one is whole, and nothing half-written stays.

    JPEG, WebP and AVIF are written at quality 95, the first and the last without chroma subsampling, PNG and TIFF
    without loss.

    Args:
        path: its suffix says the format.
        pixels: ``(H, W, 3)`` uint8 or uint16, sRGB-coded, of the depth of ``like.pixels``.
        like: the photo that was relit, whose mode, depth, profile, EXIF, alpha and resolution are kept; None for sRGB.

    Raises:
        ValueError: a suffix of no known format, a place that cannot be written to, or pixels unlike the photo's.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     path = Path(folder) / "grey.png"
        ...     Image.new("L", (9, 8), 100).save(path)
        ...     photo = read_photo(path)
        ...     write_photo(path, photo.pixels + np.uint8(20), photo)
        ...     (photo.pixels.shape, photo.mode, int(read_photo(path).stored[0, 0]))
        ((8, 9, 3), 'L', 120)
    """
    path = Path(path)
    kind = check_writable(path)
    photo = PhotoFile(pixels) if like is None else like
    write = _writer(kind, photo, photo.relit(pixels), pixels)
    partial = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd EXIF, which is kept as far as the format takes it
            write(partial)
        partial.replace(path)
    except (OSError, ValueError, RuntimeError) as error:  # the last two where the photo is too large for the format
        raise ValueError(f"{path}: could not be written: {error}") from error
    finally:
        partial.unlink(missing_ok=True)


def check_writable(path: str | Path) -> str:
    """The format that a file name asks for, where it and its folder can be written.

    Raises:
        ValueError: neither is the case, and why.
    """
    path = Path(path)
    _formats()
    kind = next((name for name, form in FORMATS.items() if path.suffix.lower() in form.suffixes), None)
    if kind is None or kind not in _formats():
        known = ", ".join(s for name in _formats() for s in FORMATS[name].suffixes)
        needs = "; .heic needs `pip install pillow-heif`" if kind == "HEIF" else ""
        raise ValueError(f"{path}: expected an image file name ({known}), got {path.suffix or 'no suffix'!r}{needs}")
    folder = path.parent
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: expected a file in a folder that can be written, which {folder} is not")
    return kind


def not_held(path: str | Path, photo: PhotoFile) -> list[str]:
    """What the format of ``path`` cannot hold of ``photo``, and what is done instead; one sentence each."""
    kind = check_writable(path)
    holds = FORMATS[kind]
    lost = []
    if photo.stored_alpha is not None and not holds.alpha:
        lost.append(f"{kind} holds no transparency: the photo is laid over white")
    if photo.channels == 4 and not holds.cmyk:
        lost.append(f"{kind} holds no CMYK: converted to sRGB")
    elif photo.icc and not holds.profile:
        lost.append(f"{kind} holds no colour profile: converted to sRGB")
    if photo.bits > 8 and not holds.deep:
        lost.append(f"{kind} is written with 8 bits a channel, the photo has {photo.bits}")
    if photo.exif and not holds.profile:
        lost.append(f"{kind} holds no EXIF: left out")
    return lost


def find_photos(folder: str | Path) -> list[Path]:
    """The photos in a folder, by the suffix, sorted; not those in folders inside it."""
    return sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


def find_people(folder: str | Path) -> dict[str, list[Path]]:
    """Photos by name in either usual layout: ``people/NAME.jpg`` and ``people/NAME/*.jpg``.

    Raises:
        ValueError: no photos, or one name in both layouts.
    """
    folder = Path(folder)
    people: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*")):
        photos = find_photos(path) if path.is_dir() else [path]
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


def _formats() -> list[str]:
    """Those that this Pillow and its plug-ins can read and write."""
    try:
        from pillow_heif import register_heif_opener

        register_heif_opener()
    except ImportError:
        heif = False
    else:
        heif = True
    there = {"AVIF": features.check("avif"), "WEBP": features.check("webp"), "HEIF": heif}
    return [name for name in FORMATS if there.get(name, True)]


def _something_else(path: Path) -> str:
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp" and head[8:12] in HEIC_BRANDS:
        return "HEIC, which needs a plug-in: pip install pillow-heif"
    if head[4:8] == b"ftyp" and head[8:12] in (b"avif", b"avis"):
        return "AVIF, which needs Pillow 11.3 or newer: pip install -U Pillow"
    return "something else"


def _deep(path: Path, image: Image.Image) -> PhotoFile:
    stored, alpha = read_sixteen_bits(path.read_bytes(), grey="LA;16" in str(image.tile))  # type: ignore[attr-defined]
    image.load()  # PNG may hold its EXIF behind the pixels
    return finished(image, stored, alpha, turned=image.format == "TIFF")


def _writer(kind: str, photo: PhotoFile, values: np.ndarray, pixels: np.ndarray) -> Callable[[Path], None]:
    """What writes ``values``, in the photo's own space, or where ``kind`` cannot hold that, the sRGB ``pixels``."""
    holds, icc, alpha = FORMATS[kind], photo.icc, photo.stored_alpha
    grey_held = holds.grey and not (kind == "TIFF" and alpha is not None and photo.bits == 16)  # few programs read that
    held = holds.cmyk if photo.channels == 4 else grey_held if photo.channels == 1 else True
    if not held or (icc and not holds.profile):
        values, icc = pixels, None
    if values.dtype == np.float32 and kind != "TIFF":
        values = pixels[..., 0]
    if not holds.deep and values.dtype != np.uint8:
        values, alpha = eight_bits(values), None if alpha is None else eight_bits(alpha)
    if alpha is not None and not holds.alpha:
        full = np.iinfo(alpha.dtype).max
        cover = (alpha if values.ndim == 2 else alpha[..., None]) / np.float32(full)
        values, alpha = np.rint(full - cover * (full - values.astype(np.float32))).astype(values.dtype), None
    exif = photo.exif if holds.profile else None
    layers = [values if values.ndim == 3 else values[..., None], *([] if alpha is None else [alpha[..., None]])]
    if values.dtype == np.uint16 and kind in ("PNG", "TIFF"):
        write = write_png if kind == "PNG" else write_tiff
        whole = np.concatenate(layers, axis=2)

        def write_deep(partial: Path) -> None:
            with partial.open("wb") as file:
                write(file, whole, icc, exif, photo.dpi)

        return write_deep
    image = Image.fromarray(values) if values.dtype == np.float32 else to_image(values)
    if alpha is not None:
        image.putalpha(Image.fromarray(alpha))
    given = {"icc_profile": icc, "exif": exif, "dpi": photo.dpi}
    options = {**holds.options, **{name: value for name, value in given.items() if value}}
    return lambda partial: image.save(partial, format=kind, **options)
