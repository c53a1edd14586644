"""``facerelight relight`` of a film: what is checked, and what is printed."""

from __future__ import annotations

import json
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from facerelight.photo.batch import Load, Request, choose_faces
from facerelight.photo.film.lamps import MovingLamp
from facerelight.photo.film.names import WRITTEN, check_film_output
from facerelight.photo.film.track import Choose, Picture

if TYPE_CHECKING:
    from facerelight.photo.faces.landmarks import Face
    from facerelight.photo.film.relighter import FilmRelighter

__all__ = ["run_film"]

FOR_PHOTOS = ("variance", "same_person", "resume", "explain")


def run_film(arguments: Namespace, moving: list[MovingLamp], request: Request, load: Load) -> int:
    """Relight one film; returns the exit code.

    Args:
        arguments: of the command line.
        moving: lamps with keyframes.
        request: what else is asked for.
        load: gives the relighter.

    Raises:
        ValueError: options that are not for films, a file that is no film, a place that cannot be written to.
        LandmarksNotFoundError: no face in any frame; nothing is written then.
    """
    source = Path(arguments.photo[0])
    output = _output(source, arguments.output)
    _check(arguments, moving, request)
    check_film_output(output, arguments.force)
    if output.exists() and source.exists() and output.samefile(source):
        raise ValueError(f"{output}: is the film itself; --output says another place")
    from facerelight.photo.film.video import convert_film, film_facts
    from facerelight.photo.folder.progress import Progress

    facts = film_facts(source)
    film = _relighter(arguments, moving, request, load)
    progress, started = Progress(facts.frames, sys.stderr, "frames"), time.perf_counter()

    def change(pictures: Iterator[Picture]) -> Iterator[Picture]:
        for picture in film.frames(pictures):
            yield picture
            progress.step()
        if not film.lit:
            from facerelight.photo.faces.landmarks import LandmarksNotFoundError

            raise LandmarksNotFoundError(f"{source}: found no face in any of {film.seen} frames")

    try:
        lost = convert_film(source, output, change)
    finally:
        progress.end()
    report = {"film": str(source), "output": [str(output)], **_report(film, lost, time.perf_counter() - started)}
    for line in report["warnings"]:
        print(f"facerelight: {source}: {line}", file=sys.stderr)
    print(json.dumps(report) if arguments.json else output)
    return 0


def _output(source: Path, given: str | None) -> Path:
    suffix = source.suffix.lower() if source.suffix.lower() in WRITTEN else ".mp4"
    output = Path(given or f"relit{suffix}")
    return output / f"{source.stem}_relit{suffix}" if output.is_dir() else output


def _check(arguments: Namespace, moving: list[MovingLamp], request: Request) -> None:
    given = [name for name in FOR_PHOTOS if getattr(arguments, name)] + ["workers"] * (arguments.workers != 1)
    if given:
        raise ValueError(f"{given[0].replace('_', '-')}: expected photos with it, got a film")
    if request.face == "all":
        raise ValueError("face: expected one face of a film, the largest or a number, got all")
    if request.method == "mle":
        raise ValueError("method: expected 'expected' or 'map' for a film, whose light is one, got 'mle'")
    if len(request.scenes) > 1:
        raise ValueError(f"lights: expected one light for a film, got {len(request.scenes)} pairs of angles")
    others = [name for name in ("studio", "environment", "light_of", "even") if getattr(arguments, name)]
    if moving and (others or arguments.azimuth is not None or arguments.elevation is not None):
        raise ValueError("lights: expected lamps with at=SECONDS beside other --light alone")


def _relighter(arguments: Namespace, moving: list[MovingLamp], request: Request, load: Load) -> FilmRelighter:
    from facerelight.geometry.lights import light_from_angles
    from facerelight.photo.batch import light_of_photo
    from facerelight.photo.film.relighter import FilmRelighter, Lighting

    standing = request.scenes[0].lamps if arguments.light or not moving else ()
    taken = [] if request.light_of is None else [light_of_photo(request.light_of, load())]
    lighting = Lighting([*moving, *taken, *standing], request.fill, request.strength, request.add)
    light = None if request.source_light is None else light_from_angles(*request.source_light)
    known: dict[str, Any] = {"method": request.method, "source_light": light, "choose": _chooser(request)}
    return FilmRelighter(lighting, load(), **known)


def _chooser(request: Request) -> Choose:
    """The face that is meant: the landmarks are of the first picture, and no other face is taken up to the next cut;
    the number is of each picture in which it is looked for."""
    marks = request.landmarks

    def choose(pixels: np.ndarray, before: Face | None) -> Face | None:
        nonlocal marks
        from facerelight.photo.faces.landmarks import LandmarksNotFoundError, face_of_points
        from facerelight.photo.film.track import largest_face

        if request.landmarks is not None and before is not None:
            return None  # it is followed, and looked for near where it was
        if marks is not None:
            from facerelight.photo.faces.given import locate_face

            found, marks = locate_face(pixels, np.array(marks), None)[0], None
            if found.points is None:
                raise ValueError("landmarks: expected a face there, found none in the film's first picture")
            return face_of_points(found.points, pixels.shape, found.score, found.mesh_score)
        if request.face == "largest":
            return largest_face(pixels)
        try:
            return choose_faces(pixels, request.face)[0][0][1]
        except (LandmarksNotFoundError, ValueError):
            return None  # not in this picture

    return choose


def _report(film: FilmRelighter, lost: list[str], seconds: float) -> dict[str, Any]:
    azimuth, elevation = film.source_angles or (0.0, 0.0)
    without = film.seen - film.lit
    said = [f"{without} of {film.seen} frames show no face: left as they are"] if without else []
    return {
        "source_light": {"azimuth": round(azimuth, 1), "elevation": round(elevation, 1)},
        "frames": film.seen,
        "relit": film.lit,
        "shots": film.shots,
        "keys": film.keys,
        "seconds": round(seconds, 3),
        "frames_per_second": round(film.seen / max(seconds, 1e-9), 3),
        "warnings": [*lost, *said, *film.warnings.values()],
    }
