"""A session's photo and maps as one HTML page that opens from disk."""

from __future__ import annotations

import base64
import io
import json
from html import escape
from importlib.resources import files
from string import Template

import numpy as np
from PIL import Image

from facerelight.photo.faces.copies import shrink
from facerelight.photo.files.pixels import as_bytes, as_rgb
from facerelight.photo.files.profiles import eight_bits
from facerelight.photo.session import PhotoRelighter
from facerelight.photo.viewer.contents import session_contents
from facerelight.photo.viewer.packing import pack

__all__ = ["shrunken", "viewer_page"]

SCRIPTS = (
    "unpack", "raster", "light", "dome", "shade", "ratio", "colour", "gl", "model", "presets", "ball", "page",
)  # fmt: skip
LARGEST_PHOTO = 1_150_000  # bytes: a larger one is not kept without loss
QUALITIES = (97, 94, 90, 85, 75)  # of JPEG, the first that is small enough


def viewer_page(session: PhotoRelighter, name: str = "portrait.jpg") -> str:
    """The page, in which the photo can be put under up to three lamps.

    Args:
        session: of a photo as large as it is to be shown; 16 bits and floats are shown as 8 bits.
        name: of the photo's file, as the page says it.

    Example:
        >>> page = viewer_page(PhotoRelighter(photo))  # doctest: +SKIP
        >>> Path("portrait.html").write_text(page)  # doctest: +SKIP
    """
    web = files("facerelight.photo.viewer").joinpath("web")
    read = {file: web.joinpath(file).read_text("utf-8") for file in ("page.html", "style.css")}
    script = "\n".join(web.joinpath(f"{part}.js").read_text("utf-8") for part in SCRIPTS)
    stem = name.rsplit(".", 1)[0]
    about = {"name": stem, "file": name, "text": "The picture never leaves this page."}
    return Template(read["page.html"]).substitute(
        title=escape(f"{stem}: light"),
        style=read["style.css"],
        script=script,
        photo=_photo(as_bytes(as_rgb(session.photo))),
        data=pack(*session_contents(session)),
        facts=json.dumps(about).replace("<", "\\u003c"),
    )


def shrunken(pixels: np.ndarray, side: int) -> np.ndarray:
    """``pixels (H, W, 3)`` as uint8, averaged down to ``side`` pixels on their longer side where they are larger."""
    return shrink(eight_bits(pixels), side)


def _photo(pixels: np.ndarray) -> str:
    """``pixels (H, W, 3)`` uint8 as a data URL: without loss where that is small enough, else as a JPEG."""
    image, kind, coded = Image.fromarray(pixels), "webp", io.BytesIO()
    image.save(coded, "WEBP", lossless=True, quality=80, method=4)
    for quality in QUALITIES:
        if coded.tell() <= LARGEST_PHOTO:
            break
        kind, coded = "jpeg", io.BytesIO()
        image.save(coded, "JPEG", quality=quality, subsampling=0, optimize=True)
    return f"data:image/{kind};base64,{base64.b64encode(coded.getvalue()).decode()}"
