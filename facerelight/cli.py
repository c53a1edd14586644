"""``facerelight train | relight | recognize``: the package from a terminal. Exit codes: 0 done, 1 nothing found, 2 bad input."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from facerelight.bootstrap.domain import Domain
from facerelight.config import QUALITIES, TrainConfig, default_statistics_folder, quality_config
from facerelight.statistics import FitOptions

__all__ = ["main", "read_config"]

METHODS = ("expected", "map", "mle")


def _train_parser() -> ArgumentParser:
    parser = ArgumentParser(description="Render a bootstrap of heads and learn their statistics.", exit_on_error=True)
    parser.add_argument("--config", action="config", help="YAML file with any of the options below")
    parser.add_class_arguments(TrainConfig, as_group=True)
    parser.add_argument("--output", type=str | None, default=None, help="folder for the statistics (default: the user's cache)")
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


def _relight_parser() -> ArgumentParser:
    parser = ArgumentParser(description="Relight the face in a photo.", exit_on_error=True)
    parser.add_argument("photo", type=str, nargs="+", help="JPEG, PNG, TIFF, PPM, BMP or WebP; further photos of the person are evidence")
    parser.add_argument("--azimuth", type=float, nargs="+", default=[0.0], help="degrees, positive: light at image-left; several make several")
    parser.add_argument("--elevation", type=float, nargs="+", default=[0.0], help="degrees, positive: light above")
    parser.add_argument("--output", type=str, default="relit.png", help="file to write; several lights add _AZ_EL to the name")
    parser.add_argument("--landmarks", type=str | None, default=None, help="x,y,x,y,x,y: eye at image-left, eye at image-right, mouth")
    parser.add_argument("--variance", type=str | None, default=None, help="also write a map of the standard deviation, first light")
    parser.add_argument(
        "--method",
        type=str,
        default="expected",
        choices=list(METHODS),
        help="the mean image, the most probable one, or n without a prior (from three photos or more)",
    )
    parser.add_argument("--covariance", type=str, default="face", choices=["face", "pixel"], help="whole-face or per-pixel model")
    parser.add_argument("--quality", type=str, default="standard", choices=list(QUALITIES), help="of the statistics: how many heads, how fine")
    parser.add_argument("--statistics", type=str | None, default=None, help="folder of trained statistics (default: the user's cache)")
    parser.add_argument("--json", action="store_true", help="print what was done as JSON")
    return parser


def _recognize_parser() -> ArgumentParser:
    parser = ArgumentParser(description="Enroll people from photos, and identify others among them.", exit_on_error=True)
    parser.add_argument("gallery", type=str, help="gallery file (.safetensors) to write or to read")
    parser.add_argument("--enroll", type=str | None, default=None, help="folder with NAME.jpg or NAME/*.jpg: make the gallery from it")
    parser.add_argument("--photos", type=str, nargs="*", default=[], help="photos to identify")
    parser.add_argument("--reject", type=float | None, default=None, help="largest error (1 - cosine) that is not a stranger")
    parser.add_argument("--quality", type=str, default="standard", choices=list(QUALITIES), help="of the statistics: how many heads, how fine")
    parser.add_argument("--statistics", type=str | None, default=None, help="folder of trained statistics (default: the user's cache)")
    parser.add_argument("--json", action="store_true", help="print the answers as JSON")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line ``argv`` (default: the process's) and return its exit code."""
    parser = ArgumentParser(prog="facerelight", description=__doc__, version=_version())
    commands = parser.add_subcommands()
    commands.add_subcommand("train", _train_parser(), help="render heads and learn statistics")
    commands.add_subcommand("relight", _relight_parser(), help="relight a photo")
    commands.add_subcommand("recognize", _recognize_parser(), help="recognise people from one photo each")
    try:
        arguments = parser.parse_args(None if argv is None else list(argv))
        run = {"train": _train, "relight": _relight, "recognize": _recognize}[arguments.subcommand]
        return run(arguments[arguments.subcommand])
    except SystemExit as leaving:  # jsonargparse has said why
        return int(leaving.code or 0)
    except ValueError as error:
        print(f"facerelight: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"facerelight: {error.filename or 'files'}: {error.strerror or error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        print(f"facerelight: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("facerelight: interrupted; run the same command again to go on", file=sys.stderr)
        return 130


def _train(arguments: Namespace) -> int:
    from facerelight.training import train

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
    return 0


def read_config(path: str | Path) -> TrainConfig:
    """The training config of a YAML file, checked as the command line checks it."""
    return _config(_train_parser().parse_args(["--config", str(path)]))


def _config(arguments: Namespace) -> TrainConfig:
    values = {field.name: arguments[field.name] for field in fields(TrainConfig)}
    for name, kind in (("fit", FitOptions), ("domain", Domain)):
        if not isinstance(values[name], Namespace):
            raise ValueError(f"{name}: expected a mapping of options, got {values[name]!r}")
        values[name] = kind(**vars(values[name]))
    return TrainConfig(**values)


def _relight(arguments: Namespace) -> int:
    from facerelight.photo import PhotoRelighter
    from facerelight.photo.files import read_photo, write_photo
    from facerelight.relighter import StatisticalRelighter

    lights = _lights(arguments.azimuth, arguments.elevation)
    photo, *more = (read_photo(path) for path in arguments.photo)
    relighter = StatisticalRelighter.from_pretrained(_statistics_folder(arguments.statistics, arguments.quality), arguments.covariance)
    landmarks = _landmarks(arguments.landmarks)
    session = PhotoRelighter(photo.rgb, landmarks, relighter, more=[other.rgb for other in more], method=arguments.method)
    output = Path(arguments.output)
    written = []
    for azimuth, elevation in lights:
        name = output if len(lights) == 1 else output.with_name(f"{output.stem}_{azimuth:+.0f}_{elevation:+.0f}{output.suffix}")
        write_photo(name, session.render(azimuth, elevation), photo)
        written.append(str(name))
    if arguments.variance:
        _write_map(arguments.variance, session.std(*lights[0]))
        written.append(arguments.variance)
    azimuth, elevation = session.source_angles
    report = {
        "photo": arguments.photo[0],
        "method": arguments.method,
        "output": written,
        "source_light": {"azimuth": round(azimuth, 1), "elevation": round(elevation, 1)},
        "landmarks": [[round(v, 1) for v in point] for point in session.landmarks.tolist()],
    }
    print(json.dumps(report) if arguments.json else "\n".join(written))
    return 0


def _recognize(arguments: Namespace) -> int:
    from facerelight.photo.files import find_people
    from facerelight.recognition.gallery import Gallery
    from facerelight.relighter import StatisticalRelighter

    if not arguments.enroll and not arguments.photos:
        raise ValueError("recognize: expected --enroll FOLDER, --photos FILE ..., or both")
    people = find_people(arguments.enroll) if arguments.enroll else {}
    relighter = StatisticalRelighter.from_pretrained(_statistics_folder(arguments.statistics, arguments.quality))
    if arguments.enroll:
        gallery = Gallery(relighter)
        for name, photos in people.items():
            gallery.enroll(name, photos)
        gallery.save(arguments.gallery)
    else:
        gallery = Gallery.load(arguments.gallery, relighter)
    if arguments.reject is not None:
        gallery.classifier.threshold_ = 1 - arguments.reject
    answers = {photo: gallery.identify(photo) for photo in arguments.photos}
    if arguments.json:
        print(json.dumps({"enrolled": gallery.classifier.classes_, "answers": {k: v._asdict() for k, v in answers.items()}}))
    else:
        for photo, answer in answers.items():
            print(f"{photo}: {answer.name or 'stranger'} (error {min(answer.errors.values()):.4f})")
    return 1 if answers and all(answer.name is None for answer in answers.values()) else 0


def _statistics_folder(given: str | None, quality: str) -> Path:
    """The folder asked for; by default the cached statistics, which are trained where there are none yet."""
    if given:
        return Path(given)
    from facerelight.training import trained_folder

    return trained_folder(quality_config(quality))


def _lights(azimuth: list[float], elevation: list[float]) -> list[tuple[float, float]]:
    """Pair angles up; a single one goes with all of the others."""
    count = max(len(azimuth), len(elevation))
    if not {len(azimuth), len(elevation)} <= {1, count}:
        raise ValueError(f"lights: expected as many azimuths as elevations, or one of either, got {len(azimuth)} and {len(elevation)}")
    return list(zip(azimuth * (count // len(azimuth)), elevation * (count // len(elevation)), strict=True))


def _landmarks(text: str | None) -> list[tuple[float, float]] | None:
    if text is None:
        return None
    try:
        values = [float(v) for v in text.replace(" ", "").split(",")]
    except ValueError:
        values = []
    if len(values) != 6:
        raise ValueError(f"landmarks: expected six numbers x,y,x,y,x,y, got {text!r}")
    return list(zip(values[::2], values[1::2], strict=True))


def _write_map(path: str, std: object) -> None:
    """A grey picture of a map, white at its largest value."""
    import numpy as np

    from facerelight.photo.files import write_photo

    values = np.asarray(std)
    grey = (values / max(float(values.max()), 1e-12) * 255).round().astype(np.uint8)
    write_photo(path, np.repeat(grey[..., None], 3, axis=2))


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("facerelight")
    except PackageNotFoundError:
        return "0.1.0"


if __name__ == "__main__":
    sys.exit(main())
