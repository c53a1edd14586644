"""A photo that somebody gives to the app: what is refused before it is decoded, and the viewer's page that comes of
it."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from facerelight.photo.files.disk import read_photo

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

__all__ = ["MOST_BYTES", "MOST_PIXELS", "check_upload", "photo_page"]

MOST_BYTES, MOST_PIXELS = 50_000_000, 40_000_000


def check_upload(path: Path) -> None:
    """Refuse a file that is too large, going by its size and its header; nothing is decoded.

    Raises:
        ValueError: more than :data:`MOST_BYTES`, or :data:`MOST_PIXELS`.
    """
    size = path.stat().st_size
    if size > MOST_BYTES:
        raise ValueError(f"{path.name}: expected at most {MOST_BYTES // 1_000_000} MB, got {size / 1e6:.1f}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                width, height = image.size
    except Image.DecompressionBombError as error:
        raise ValueError(f"{path.name}: expected at most {MOST_PIXELS // 1_000_000} megapixels, got more") from error
    except (OSError, ValueError, SyntaxError):
        return  # no picture at all, as reading it says
    if width * height > MOST_PIXELS:
        most = f"{MOST_PIXELS // 1_000_000} megapixels"
        raise ValueError(f"{path.name}: expected at most {most}, got {width} x {height}")


def photo_page(path: Path, side: int, load: Callable[[], StatisticalRelighter]) -> str:
    """The viewer for a photo, as HTML to put into a page: a frame of its own.

    Raises:
        ValueError: a file that is too large, or no photo.
        LandmarksNotFoundError: no face.
    """
    check_upload(path)
    try:
        photo = read_photo(path)
    except ValueError as error:
        raise ValueError(str(error).replace(str(path), path.name)) from None  # where it lies for now says nothing
    from facerelight.photo.session import PhotoRelighter
    from facerelight.photo.viewer.page import shrunken, viewer_page

    session = PhotoRelighter(shrunken(photo.pixels, side), relighter=load())
    page = viewer_page(session, path.name)
    frame = 'style="width: 100%; height: 86vh; border: 0" sandbox="allow-scripts allow-downloads" title="The light"'
    said = "".join(f"<p>{escape(line)}</p>" for line in session.warnings)
    return f'{said}<iframe {frame} srcdoc="{escape(page)}"></iframe>'
