"""``facerelight train | relight | viewer | app | decompose | augment | recognize``: the package from a terminal.

Exit codes: 0 done; 1 nothing found, or a part of several photos failed; 2 bad input; 3 the program or machine failed.
"""

from __future__ import annotations

import json
import os
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facerelight import __version__

if TYPE_CHECKING:  # help and errors of the command line need no torch
    import jsonargparse

    from facerelight.config import TrainConfig

__all__ = ["main", "read_config"]

TRAINING_NEEDS = ("OpenGL", "jsonargparse", "pyrender", "tqdm", "trimesh", "yaml")
VERBS = {
    "train": "render heads and learn statistics",
    "relight": "relight photos",
    "viewer": "write a page in which a portrait is lit by hand",
    "app": "serve a page that takes photos and lights them",
    "decompose": "take a portrait apart: reflectance, shading, normals, its own light",
    "augment": "write a training set of faces again, relit",
    "recognize": "recognise people from one photo each",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: the process's) and return its exit code."""
    given = list(sys.argv[1:] if argv is None else argv)
    # Read when torch is imported: beside a busy process, threads that spin while they wait take five times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        verb = _verb(given[:1])
        return RUN[verb](given[1:])
    except SystemExit as leaving:  # a parser has said why
        return int(leaving.code or 0)
    except ValueError as error:
        return _failed(2, str(error))
    except ModuleNotFoundError as error:
        if str(error.name).split(".")[0] not in TRAINING_NEEDS:
            raise
        return _failed(3, f'{error.name} is not installed, which only training needs; pip install "facerelight[train]"')
    except OSError as error:
        return _failed(2, f"{error.filename or 'files'}: {error.strerror or error}")
    except MemoryError:
        return _failed(3, "out of memory; a smaller photo needs less")
    except RuntimeError as error:
        return _failed(1 if _is_nothing_found(error) else 3, str(error))
    except KeyboardInterrupt:
        return _failed(130, "interrupted; run the same command again to go on")
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("OpenGL", "pyrender"):
            raise
        return _failed(3, f"rendering needs EGL, which failed ({str(error).strip().splitlines()[0]})")


def _verb(given: list[str]) -> str:
    verbs = "\n".join(f"  {name:<12}{what}" for name, what in VERBS.items())
    parser = ArgumentParser(
        prog="facerelight",
        usage="facerelight [-h] [--version] VERB ...",
        description=f"{__doc__}\nverbs, each with its own --help:\n{verbs}",
        formatter_class=RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=__version__)
    parser.add_argument("verb", choices=list(VERBS), metavar="VERB", help=", ".join(VERBS))
    return str(parser.parse_args(given).verb)


def _failed(code: int, text: str) -> int:
    """Say in one line what went wrong; of an error that a worker process passed on, its own words."""
    lines = [line for line in text.strip().splitlines() if line.strip()] or ["failed"]
    passed_on = "Original Traceback" in text
    print(f"facerelight: {lines[-1].removeprefix('RuntimeError: ') if passed_on else ' '.join(lines)}", file=sys.stderr)
    return code


def _is_nothing_found(error: RuntimeError) -> bool:
    from facerelight.photo.faces.landmarks import LandmarksNotFoundError

    return isinstance(error, LandmarksNotFoundError)


def _train_parser() -> jsonargparse.ArgumentParser:
    from jsonargparse import ArgumentParser as ConfigParser

    from facerelight.config import TrainConfig

    what = "Render a bootstrap of heads and learn their statistics."
    parser = ConfigParser(prog="facerelight train", description=what)
    parser.add_argument("--config", action="config", help="YAML file with any of the options below")
    parser.add_class_arguments(TrainConfig, as_group=True)
    place = "folder for the statistics (default: the user's cache)"
    parser.add_argument("--output", type=str | None, default=None, help=place)
    parser.add_argument(
        "--adapt",
        type=str | None,
        default=None,
        help="folder of a few people's photos, NAME.jpg or NAME/*.jpg: adapt the statistics to them (needs --output)",
    )
    parser.add_argument("--workers", type=int, default=2, help="processes that render")
    parser.add_argument("--keep-images", action="store_true", help="leave the rendered images in OUTPUT/images")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    return parser


def _train(argv: list[str]) -> int:
    from facerelight.config import PACKAGED, default_statistics_folder, find_statistics
    from facerelight.train.run import train

    arguments = _train_parser().parse_args(argv)
    config = _config(arguments)
    if arguments.adapt and not arguments.output:
        raise ValueError("adapt: expected --output as well, a folder for the adapted statistics")
    folder = Path(arguments.output) if arguments.output else default_statistics_folder(config)
    report = train(config, folder, arguments.workers, arguments.keep_images, arguments.adapt)
    if arguments.json:
        print(json.dumps({"folder": str(folder), **report}))
    else:
        for name, value in report.items():
            print(f"{name}: {value}")
        print(f"saved: {folder}")
    if find_statistics(config) == PACKAGED:
        print(f"facerelight: to use them instead of the packaged ones: --statistics {folder}", file=sys.stderr)
    return 0


def read_config(path: str | Path) -> TrainConfig:
    """The training config of a YAML file, checked as the command line checks it."""
    return _config(_train_parser().parse_args(["--config", str(path)]))


def _config(arguments: jsonargparse.Namespace) -> TrainConfig:
    from dataclasses import fields

    from jsonargparse import Namespace as Options

    from facerelight.bootstrap.domain import Domain
    from facerelight.config import TrainConfig
    from facerelight.model.learning import FitOptions

    values = {field.name: arguments[field.name] for field in fields(TrainConfig)}
    for name, kind in (("fit", FitOptions), ("domain", Domain)):
        if not isinstance(values[name], Options):
            raise ValueError(f"{name}: expected a mapping of options, got {values[name]!r}")
        values[name] = kind(**vars(values[name]))
    return TrainConfig(**values)


def _relight(argv: list[str]) -> int:
    from facerelight.photo.command import relight_parser, run_relight
    from facerelight.photo.scenes import join_values

    return run_relight(relight_parser().parse_args(join_values(argv)), _statistics_folder)


def _viewer(argv: list[str]) -> int:
    from facerelight.photo.scenes import join_values
    from facerelight.photo.viewer.command import run_viewer, viewer_parser

    return run_viewer(viewer_parser().parse_args(join_values(argv)), _statistics_folder)


def _decompose(argv: list[str]) -> int:
    from facerelight.photo.layers.command import decompose_parser, run_decompose
    from facerelight.photo.scenes import join_values

    return run_decompose(decompose_parser().parse_args(join_values(argv)), _statistics_folder)


def _app(argv: list[str]) -> int:
    from facerelight.photo.app.command import app_parser, run_app

    return run_app(app_parser().parse_args(argv), _statistics_folder)


def _augment(argv: list[str]) -> int:
    from facerelight.augment.command import augment_parser, run_augment

    return run_augment(augment_parser().parse_args(argv), _statistics_folder)


def _recognize(argv: list[str]) -> int:
    from facerelight.recognition.gallery.command import recognize_parser, run_recognize

    return run_recognize(recognize_parser().parse_args(argv), _statistics_folder)


def _statistics_folder(given: str | None, quality: str) -> Path:
    """The folder asked for; by default packaged or cached statistics, trained where there are none yet."""
    if given:
        return Path(given)
    from facerelight.config import find_statistics, quality_config

    config = quality_config(quality)
    found = find_statistics(config)
    if found is not None:
        return found
    from facerelight.train.run import trained_folder

    return trained_folder(config)


RUN = {
    "train": _train,
    "relight": _relight,
    "viewer": _viewer,
    "app": _app,
    "decompose": _decompose,
    "augment": _augment,
    "recognize": _recognize,
}

if __name__ == "__main__":
    sys.exit(main())
