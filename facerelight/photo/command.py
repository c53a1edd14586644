"""``facerelight relight``: its options, and what it prints."""

from __future__ import annotations

import json
import math
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from facerelight.inference.methods import RELIGHTING_METHODS
from facerelight.photo.batch import DEFAULT_FOLDER, Job, Load, Request, find_jobs, is_batch, relight_photo
from facerelight.photo.film.names import is_film
from facerelight.photo.folder.share import Share, join_processes
from facerelight.photo.scenes import (
    ENVIRONMENT,
    LAMP,
    QUALITIES,
    Scene,
    parse_angles,
    parse_environment,
    parse_landmarks,
    parse_scenes,
)

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

__all__ = ["relight_parser", "run_relight"]

INTERRUPTED = 130  # exit code, as shells have it
COVARIANCES = ("face", "pixel")
SETUPS = ("rembrandt", "butterfly", "loop", "split", "clamshell", "rim")
EPILOG = """The relit photo keeps size, depth, colour profile, EXIF and alpha. JPEG is written at quality 95 without
chroma subsampling; a photo with alpha is laid over white there. Exit codes: 0 done, 1 nothing found, or a part of
several photos failed, 2 bad input, 3 the program or the machine failed."""


def relight_parser() -> ArgumentParser:
    """The options of ``facerelight relight``."""
    parser = ArgumentParser(
        prog="facerelight relight",
        description="Relight the faces in photos, or a face in a film.",
        epilog=EPILOG,
        allow_abbrev=False,
    )
    formats = "JPEG, PNG, TIFF, PPM, BMP, WebP or AVIF, a folder of them and of folders, or a film"
    parser.add_argument("photo", nargs="+", help=f"{formats}; several are relit each on its own")
    option = parser.add_argument_group("the new light").add_argument
    moves = "a film's lamp with at=SECONDS moves from each such place to the next, lamp=NAME tells several apart"
    lamp = f"a lamp, {LAMP}; repeat it for more; {moves}"
    option("--light", action="append", default=[], metavar="AZ,EL,...", help=lamp)
    option("--azimuth", type=float, nargs="+", help="degrees, positive: light at image-left; several: several pictures")
    option("--elevation", type=float, nargs="+", help="degrees, positive: light above (default of both: 0)")
    option("--size", type=float, default=5.0, help="angular radius of lamps, degrees: 1 bulb, 15 soft box (default: 5)")
    option("--studio", choices=SETUPS, help="lamps that portrait photographers know by this name")
    panorama = "a panorama as the sitter sees it, the camera in its middle: .hdr, .exr or a picture"
    option("--environment", metavar=ENVIRONMENT, help=f"light of {panorama}")
    option("--light-of", metavar="PHOTO", help="the light of another photo")
    option("--even", action="store_true", help="the same light from everywhere: no shading")
    option("--add", action="store_true", help="add the new light to the photo's own")
    option("--fill", type=float, help="share of light from all around, 0 to 1 (default: 0.1, without lamps 0)")
    option("--strength", type=float, default=1.0, help="0 leaves the photo as it is, 1 relights it (default: 1)")
    option = parser.add_argument_group("the photo").add_argument
    which = "which of several faces: the largest whole one, all, or the N-th, whole ones first, then by size"
    option("--face", type=_face, default="largest", metavar="largest|all|N", help=which)
    option("--landmarks", metavar="X,Y,X,Y,X,Y", help="of the upright photo: eye at image-left, other eye, mouth")
    option("--same-person", action="store_true", help="the further photos are evidence of the first one's person")
    option("--source-light", metavar="AZ,EL", help="where the photo's own light stands, if it is known")
    option = parser.add_argument_group("the results").add_argument
    places = "file (default: relit.png), several lights add _AZ_EL; for several photos a folder (default: relit)"
    option("-o", "--output", metavar="PLACE", help=places)
    option("--force", action="store_true", help="overwrite files that exist")
    option("--workers", type=int, default=1, help="processes that relight a batch (default: 1)")
    option("--resume", action="store_true", help="go on with a batch: leave out what manifest.csv says is done")
    option("--variance", metavar="FILE", help="also write a map of the standard deviation, first light")
    option("--explain", action="store_true", help="say which stages ran, why, and how long they took")
    option("--json", action="store_true", help="print what was done as JSON, of a batch a line for each photo")
    option = parser.add_argument_group("the model").add_argument
    methods = "the mean image, the most probable one, or n without a prior, from three photos or more"
    option("--method", default="expected", choices=RELIGHTING_METHODS, help=f"{methods} (default: expected)")
    option("--covariance", default="face", choices=COVARIANCES, help="whole-face or per-pixel model (default: face)")
    option("--quality", default="standard", choices=QUALITIES, help="of the statistics (default: standard)")
    option("--statistics", metavar="FOLDER", help="trained statistics (default: those of the quality)")
    return parser


def run_relight(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Relight what the command line says; returns the exit code.

    Args:
        arguments: parsed by :func:`relight_parser`.
        statistics_folder: of the folder given and the quality; trains where there is none.

    Raises:
        ValueError: options that cannot be used; with one photo also the photo.
        LandmarksNotFoundError: one photo, without a face.
    """
    if len(arguments.photo) == 1 and is_film(arguments.photo[0], arguments.output):
        from facerelight.photo.film.command import run_film
        from facerelight.photo.film.lamps import take_moving

        moving, arguments.light = take_moving(arguments.light, arguments.size)
        return run_film(arguments, moving, _request(arguments), _loader(arguments, statistics_folder))
    if arguments.workers < 1:
        raise ValueError(f"workers: expected at least 1 process, got {arguments.workers}")
    batch = is_batch(arguments.photo, arguments.same_person)
    with join_processes() if batch else nullcontext(Share()) as share:
        return _relight_photos(arguments, statistics_folder, batch, share)


def _relight_photos(
    arguments: Namespace, statistics_folder: Callable[[str | None, str], Path], batch: bool, share: Share
) -> int:
    request = _request(arguments)
    places = arguments.output, arguments.variance
    if arguments.resume and not batch:
        raise ValueError("resume: expected several photos, or a folder of them, got what makes one result")
    over = arguments.force or arguments.resume
    jobs = find_jobs(arguments.photo, request.scenes, *places, arguments.same_person, over)
    share.wait()  # until all have seen that nothing is overwritten
    if len(jobs) > 1 and request.landmarks:
        raise ValueError(f"landmarks: expected one photo with them, got {len(jobs)}")

    load = _loader(arguments, statistics_folder)
    if batch:
        load()  # what is wrong with the statistics is wrong with every photo
        return _run_batch(jobs, request, load, arguments, statistics_folder, share)
    report = relight_photo(jobs[0], request, load, _say)
    _explain(report, arguments)
    print(json.dumps(report) if arguments.json else "\n".join(report["output"]))
    return 0


def _loader(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> Load:
    """Gives the relighter, read when it is first asked for."""

    @cache
    def load() -> StatisticalRelighter:
        from facerelight.inference.relighter import StatisticalRelighter

        folder = statistics_folder(arguments.statistics, arguments.quality)
        return StatisticalRelighter.from_pretrained(folder, arguments.covariance)

    return load


def _run_batch(
    jobs: list[Job],
    request: Request,
    load: Load,
    arguments: Namespace,
    statistics_folder: Callable[[str | None, str], Path],
    share: Share,
) -> int:
    """Relight this process's share of the photos, print a line for each that ended, and add it to the manifest."""
    from facerelight.photo.folder.manifest import Manifest
    from facerelight.photo.folder.progress import Progress
    from facerelight.photo.folder.work import Model, relight_jobs

    manifest = Manifest(Path(arguments.output or DEFAULT_FOLDER), request, share.rank)
    jobs = share.of(jobs)
    wanted = manifest.left(jobs) if arguments.resume else jobs
    if len(wanted) < len(jobs):
        _say(f"{len(jobs) - len(wanted)} of {len(jobs)} photos were done before")
    progress, codes = Progress(len(wanted), sys.stderr), []
    model = Model(statistics_folder(arguments.statistics, arguments.quality), arguments.covariance)
    try:
        for outcome in relight_jobs(wanted, request, load, model, arguments.workers):
            for line in outcome.said:
                _say(line)
            manifest.add(outcome)
            codes.append(outcome.code)
            if arguments.json:
                print(json.dumps(outcome.report), flush=True)
            elif not outcome.code:
                print("\n".join(outcome.report["output"]), flush=True)
            if not outcome.code:
                _explain(outcome.report, arguments)
            progress.step(outcome.code > 0)
    except KeyboardInterrupt:
        _say("interrupted; the same command with --resume goes on")
        return INTERRUPTED
    share.wait()
    if share.rank == 0:
        manifest.merge()
    share.wait()  # torchrun ends all where one says that a photo failed
    failed = sum(code > 0 for code in codes)
    if failed:
        _say(f"{failed} of {len(wanted)} photos could not be relit; {manifest.path} says which and why")
    return 0 if not failed else 2 if set(codes) == {2} else 1


def _request(arguments: Namespace) -> Request:
    scenes, lamps = _scenes(arguments)
    fill = (0.1 if lamps and not arguments.add else 0.0) if arguments.fill is None else arguments.fill
    for name, value in (("fill", fill), ("strength", arguments.strength)):
        if not (math.isfinite(value) and 0 <= value <= 1):
            raise ValueError(f"{name}: expected a share from 0 to 1, got {value}")
    landmarks = None if arguments.landmarks is None else parse_landmarks(arguments.landmarks)
    if landmarks and arguments.face != "largest":
        raise ValueError("face: expected --face or --landmarks, got both")
    source = None if arguments.source_light is None else parse_angles(arguments.source_light, "source-light")
    light_of = None if arguments.light_of is None else Path(arguments.light_of)
    strength, face = arguments.strength, arguments.face
    return Request(scenes, fill, strength, face, landmarks, source, arguments.method, light_of, arguments.add)


def _scenes(arguments: Namespace) -> tuple[list[Scene], bool]:
    """The scenes asked for, and whether lamps light them."""
    others = ("studio", "environment", "light_of", "even")
    given = [name for name in others if getattr(arguments, name)]
    lamps = bool(arguments.light) or arguments.azimuth is not None or arguments.elevation is not None
    if len(given) + lamps > 1:
        shown = ", ".join([*given, *(["lamps"] if lamps else [])]).replace("_", "-")
        raise ValueError(f"lights: expected lamps or one of {', '.join(others).replace('_', '-')}, got {shown}")
    if not given:
        return parse_scenes(arguments.light, arguments.azimuth, arguments.elevation, arguments.size), True
    if arguments.studio:
        from facerelight.geometry.studio import studio_lamps

        key = studio_lamps(arguments.studio)
        return [Scene(key, key[0].azimuth, key[0].elevation)], True
    if arguments.environment:
        return [Scene((parse_environment(arguments.environment),), 0.0, 0.0)], False
    if arguments.light_of:
        return [Scene((), 0.0, 0.0)], False
    from facerelight.geometry.environment import even_light

    return [Scene((even_light(),), 0.0, 0.0)], False


def _face(text: str) -> str:
    if text not in ("largest", "all") and not (text.isascii() and text.isdigit() and int(text) > 0):
        raise ArgumentTypeError(f"expected largest, all or a number from 1, got {text!r}")
    return text


def _explain(report: dict[str, Any], arguments: Namespace) -> None:
    if not arguments.explain:
        return
    for stage in report["stages"]:
        cost = f"{stage['seconds']:6.2f} s" if stage["ran"] else " not run"
        _say(f"{report['photo']}: {stage['name']:<16} {cost}  {stage['reason']}")
    _say(f"{report['photo']}: {'all':<16} {report['seconds']:6.2f} s")


def _say(line: str) -> None:
    print(f"facerelight: {line}", file=sys.stderr, flush=True)
