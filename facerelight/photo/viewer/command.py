"""``facerelight viewer``: its options, and what it writes."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from facerelight.photo.scenes import QUALITIES

__all__ = ["check_side", "run_viewer", "viewer_parser"]

SIDES = (64, 4000)


def viewer_parser() -> ArgumentParser:
    """The options of ``facerelight viewer``."""
    parser = ArgumentParser(
        prog="facerelight viewer",
        description="Write a page in which a portrait is lit by hand; it opens from disk and needs no network.",
        allow_abbrev=False,
    )
    option = parser.add_argument
    option("photo", help="a photo of a person")
    option("-o", "--output", metavar="FILE", help="the page (default: the photo's name with .html)")
    option("--side", type=int, default=1000, help="pixels of the photo's longer side in the page (default: 1000)")
    option("--landmarks", metavar="X,Y,X,Y,X,Y", help="of the upright photo: eye at image-left, other eye, mouth")
    option("--force", action="store_true", help="overwrite a file that exists")
    option("--quality", default="standard", choices=QUALITIES, help="of the statistics (default: standard)")
    option("--statistics", metavar="FOLDER", help="trained statistics (default: those of the quality)")
    option("--json", action="store_true", help="print what was done as JSON")
    return parser


def run_viewer(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Write the page that the command line asks for; returns the exit code.

    Raises:
        ValueError: options or a photo that cannot be used.
        LandmarksNotFoundError: no face.
    """
    output = _output(arguments)
    check_side(arguments.side)
    from facerelight.photo.scenes import parse_landmarks

    marks = None if arguments.landmarks is None else parse_landmarks(arguments.landmarks)

    from facerelight.photo.files.disk import read_photo
    from facerelight.photo.files.profiles import eight_bits

    pixels = eight_bits(read_photo(arguments.photo).pixels)

    import numpy as np

    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.photo.session import PhotoRelighter
    from facerelight.photo.viewer.page import shrunken, viewer_page

    size = np.array(pixels.shape[1::-1])
    pixels = shrunken(pixels, arguments.side)
    scale = np.array(pixels.shape[1::-1]) / size
    marks = None if marks is None else [tuple((np.array(mark) + 0.5) * scale - 0.5) for mark in marks]
    folder = statistics_folder(arguments.statistics, arguments.quality)
    session = PhotoRelighter(pixels, marks, StatisticalRelighter.from_pretrained(folder))
    page = viewer_page(session, Path(arguments.photo).name)
    for line in session.warnings:
        print(f"facerelight: {arguments.photo}: {line}", file=sys.stderr)
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(page, "utf-8")
    report = {"output": str(output), "bytes": len(page.encode()), "warnings": session.warnings}
    print(json.dumps(report) if arguments.json else output)
    return 0


def check_side(side: int) -> None:
    """Whether a photo of ``side`` pixels can be shown.

    Raises:
        ValueError: if not.
    """
    if not SIDES[0] <= side <= SIDES[1]:
        raise ValueError(f"side: expected {SIDES[0]} to {SIDES[1]} pixels, got {side}")


def _output(arguments: Namespace) -> Path:
    output = Path(arguments.output or Path(arguments.photo).with_suffix(".html").name)
    if output.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"output: expected a name that ends in .html, got {str(output)!r}")
    if output.exists() and not arguments.force:
        raise ValueError(f"{output}: exists already; --force overwrites it, --output says another place")
    return output
