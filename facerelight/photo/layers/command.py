"""``facerelight decompose``: its options, and what it writes."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from facerelight.photo.scenes import QUALITIES

__all__ = ["decompose_parser", "run_decompose"]


def decompose_parser() -> ArgumentParser:
    """The options of ``facerelight decompose``."""
    parser = ArgumentParser(
        prog="facerelight decompose",
        description="Take a portrait apart: reflectance, shading, highlights, normals, the photo's own light as an"
        " environment map and in numbers, and how sure all of it is.",
        allow_abbrev=False,
    )
    option = parser.add_argument
    option("photo", help="a photo of a person")
    option("-o", "--output", metavar="FOLDER", help="for the layers (default: the photo's name with _layers)")
    option("--landmarks", metavar="X,Y,X,Y,X,Y", help="of the upright photo: eye at image-left, other eye, mouth")
    option("--force", action="store_true", help="overwrite files that exist")
    option("--quality", default="standard", choices=QUALITIES, help="of the statistics (default: standard)")
    option("--statistics", metavar="FOLDER", help="trained statistics (default: those of the quality)")
    option("--json", action="store_true", help="print what was found as JSON")
    return parser


def run_decompose(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Write the layers that the command line asks for; returns the exit code.

    Raises:
        ValueError: options or a photo that cannot be used, or files that exist.
        LandmarksNotFoundError: no face.
    """
    from facerelight.photo.layers.pictures import FILES, write_layers
    from facerelight.photo.scenes import parse_landmarks

    folder = Path(arguments.output or f"{Path(arguments.photo).stem}_layers")
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder, or none yet, got a file; --output says another place")
    there = [name for name in FILES if (folder / name).exists()]
    if there and not arguments.force:
        raise ValueError(f"{folder / there[0]}: exists already; --force overwrites it, --output says another place")
    marks = None if arguments.landmarks is None else parse_landmarks(arguments.landmarks)

    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.photo.files.disk import read_photo
    from facerelight.photo.session import PhotoRelighter

    pixels = read_photo(arguments.photo).pixels
    statistics = statistics_folder(arguments.statistics, arguments.quality)
    session = PhotoRelighter(pixels, marks, StatisticalRelighter.from_pretrained(statistics))
    for line in session.warnings:
        print(f"facerelight: {arguments.photo}: {line}", file=sys.stderr)
    pose = session.pose
    about = {
        "photo": str(arguments.photo),
        "size": list(pixels.shape[1::-1]),
        "landmarks": [[round(float(v), 2) for v in point] for point in session.landmarks],
        "pose": None if pose is None else {name: round(float(v), 1) for name, v in pose._asdict().items()},
        "warnings": session.warnings,
    }
    report = write_layers(session.decompose(), folder, about)
    paths = [str(folder / name) for name in FILES]
    print(json.dumps(report | {"output": paths}) if arguments.json else "\n".join(paths))
    return 0
