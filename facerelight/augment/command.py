"""``facerelight augment``: its options, and what it writes."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path

from facerelight.photo.scenes import QUALITIES

__all__ = ["augment_parser", "run_augment"]

RANGES = {
    "azimuth": ((-75.0, 75.0), "degrees, positive at image-left"),
    "elevation": ((-30.0, 60.0), "degrees, positive above"),
    "size": ((2.0, 20.0), "of the lamp, its angular radius in degrees"),
    "fill": ((0.05, 0.3), "share of light from all around"),
    "mix": ((0.0, 0.2), "share of its own light that a picture keeps"),
}


def augment_parser() -> ArgumentParser:
    """The options of ``facerelight augment``."""
    parser = ArgumentParser(
        prog="facerelight augment",
        description="Write a training set of faces again, with copies of every picture under random lamps.",
        allow_abbrev=False,
    )
    option = parser.add_argument
    option("folder", metavar="FOLDER", help="crops of faces, in folders of one person each or not")
    option("-o", "--output", metavar="OUT", required=True, help="where the pictures and manifest.csv go")
    option("--copies", type=int, default=10, help="relit ones of every picture (default: 10)")
    option(
        "--frame",
        default="found",
        help="found: look for the face of every picture (default); arcface112 or yale: where those crops have it;"
        " or X,Y,X,Y,X,Y in pixels: eye at image-left, other eye, mouth",
    )
    for name, (limits, what) in RANGES.items():
        shown = " ".join(f"{limit:g}" for limit in limits)
        option(
            f"--{name}", type=float, nargs=2, default=limits, metavar=("LOW", "HIGH"), help=f"{what} (default: {shown})"
        )
    option("--source", default="estimate", choices=("estimate", "front"), help="where the pictures' own light is")
    option("--seed", type=int, default=0, help="other lamps (default: 0)")
    option("--force", action="store_true", help="overwrite files that exist")
    option("--quality", default="standard", choices=QUALITIES, help="of the statistics (default: standard)")
    option("--statistics", metavar="STATISTICS", help="trained statistics (default: those of the quality)")
    option("--json", action="store_true", help="print what was done as JSON")
    return parser


def run_augment(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Write the training set that the command line asks for; returns the exit code, 1 where pictures were left out.

    Raises:
        ValueError: options or pictures that cannot be used.
    """
    if arguments.copies < 1:
        raise ValueError(f"copies: expected at least 1, got {arguments.copies}")
    if arguments.seed < 0:
        raise ValueError(f"seed: expected 0 or more, got {arguments.seed}")
    folder, output = Path(arguments.folder), Path(arguments.output)
    if not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder of pictures, found none")
    from facerelight.photo.scenes import parse_landmarks

    named = arguments.frame in ("found", "arcface112", "yale")
    frame = arguments.frame if named else tuple(parse_landmarks(arguments.frame))

    from facerelight.augment.folder import counts, plan_training_set, write_training_set
    from facerelight.augment.lamps import LampGenerator
    from facerelight.augment.quick import QuickRelighter
    from facerelight.augment.random_face_relight import RandomFaceRelight
    from facerelight.inference.relighter import StatisticalRelighter

    plan_training_set(folder, output, arguments.copies, arguments.force)
    LampGenerator(*(tuple(getattr(arguments, name)) for name in RANGES))  # says what is wrong with them
    statistics = statistics_folder(arguments.statistics, arguments.quality)
    relight = RandomFaceRelight(
        "arcface112" if frame == "found" else frame,
        azimuth=tuple(arguments.azimuth),
        elevation=tuple(arguments.elevation),
        size=tuple(arguments.size),
        fill=tuple(arguments.fill),
        mix=tuple(arguments.mix),
        source=arguments.source,
        relighter=QuickRelighter(StatisticalRelighter.from_pretrained(statistics)),
        p=1.0,
    )
    rows = []
    for made in write_training_set(
        folder, output, arguments.copies, relight, frame == "found", arguments.seed, arguments.force
    ):
        rows.append(made)
        if made.error:
            print(f"facerelight: {made.picture}: {made.error}", file=sys.stderr)
    done = counts(rows)
    report = {"output": str(output), **{name.replace(" ", "_"): count for name, count in done.items()}}
    print(json.dumps(report) if arguments.json else f"{output}: {done['original']} pictures, {done['relit']} relit")
    return 1 if done["left out"] else 0
