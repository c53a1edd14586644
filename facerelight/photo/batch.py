"""Photographs one after the other: which files come of which, checked before any work, and what is done for each."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from facerelight.photo.files.disk import SUFFIXES, check_writable, find_photos, not_held, read_photo, write_photo
from facerelight.photo.scenes import Scene, scene_paths
from facerelight.photo.stages import Stage, StageLog

if TYPE_CHECKING:
    from facerelight.geometry.sources import Lamp, LightMixture
    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.photo.faces.landmarks import Face
    from facerelight.photo.files.photograph import PhotoFile
    from facerelight.photo.session import PhotoRelighter

__all__ = [
    "DEFAULT_FOLDER",
    "Job",
    "Request",
    "choose_faces",
    "find_jobs",
    "is_batch",
    "light_of_photo",
    "relight_photo",
]

RESULT = "_relit"  # behind the name of a photo of a batch
DEFAULT_OUTPUT, DEFAULT_FOLDER = "relit.png", "relit"
REMEDY = "say where it is with --landmarks x,y,x,y,x,y: eye at image-left, eye at image-right, mouth, in pixels"
Say = Callable[[str], None]
Load = Callable[[], "StatisticalRelighter"]


class Job(NamedTuple):
    """A photo, others of the same person, a file for each scene, and one for the map of the standard deviation."""

    photo: Path
    more: tuple[Path, ...]
    outputs: tuple[Path, ...]
    variance: Path | None


class Request(NamedTuple):
    """What is asked for every photo; ``face`` is "largest", "all" or a number from 1; ``source_light`` in degrees;
    ``light_of`` another photo whose light is taken; ``add``: to the photo's own light."""

    scenes: Sequence[Scene]
    fill: float = 0.1
    strength: float = 1.0
    face: str = "largest"
    landmarks: list[tuple[float, float]] | None = None
    source_light: tuple[float, float] | None = None
    method: str = "expected"
    light_of: Path | None = None
    add: bool = False


def is_batch(photos: Sequence[str], same_person: bool) -> bool:
    """Whether ``photos`` are relit each on its own, into a folder."""
    return not same_person and (len(photos) > 1 or any(Path(photo).is_dir() for photo in photos))


def find_jobs(
    photos: Sequence[str],
    scenes: Sequence[Scene],
    output: str | None = None,
    variance: str | None = None,
    same_person: bool = False,
    force: bool = False,
) -> list[Job]:
    """What is to be written for ``photos``, files or folders of files and folders.

    One photo, or several of the same person, go into the file ``output`` ("relit.png"); a batch into the folder
    ``output`` ("relit"), each photo under its own name with ``_relit`` behind it, in folders like those that it is in.

    Raises:
        ValueError: a place that cannot be written to, a file that exists already unless ``force``, two results of one
            name, or a file where a folder should be named.
        FileNotFoundError: one photo, or folder, that is not there.
    """
    batch = is_batch(photos, same_person)
    if not batch and not Path(photos[0]).exists():  # before the place of its result is judged
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), photos[0])
    into = Path(output or (DEFAULT_FOLDER if batch else DEFAULT_OUTPUT))
    found = [pair for photo in photos for pair in _expand(Path(photo), into)]
    paths = [path for path, _ in found]
    if batch and into.suffix.lower() in SUFFIXES:
        raise ValueError(
            f"output: expected a folder for {len(paths)} photos ({_some(paths)}), got the file {str(into)!r}; "
            "if they show one person, say --same-person"
        )
    if batch and variance:
        raise ValueError(f"variance: expected one photo, got {len(paths)}: {_some(paths)}")
    groups = [(*pair, ()) for pair in found] if batch else [(*found[0], tuple(paths[1:]))]
    jobs = []
    for photo, within, more in groups:
        suffix = photo.suffix if photo.suffix.lower() in SUFFIXES else ".png"
        name = into / within / f"{photo.stem}{RESULT}{suffix}" if batch or into.is_dir() else into
        jobs.append(Job(photo, more, tuple(scene_paths(name, scenes)), Path(variance) if variance else None))
    _check_outputs(jobs, paths, force)
    return jobs


def relight_photo(job: Job, request: Request, load: Load, say: Say) -> dict[str, Any]:
    """Relight a photo and write all that is asked for; returns the report.

    Args:
        load: gives the relighter; called only once the photo has been read.
        say: takes what the user should know, a line at a time.

    Raises:
        ValueError: a file, landmarks or lights that cannot be used; names the photo.
        LandmarksNotFoundError: no face; names the photo.
    """
    started, log = time.perf_counter(), StageLog()
    with _naming(job.photo), log.measure("read", "the file, to sRGB"):
        photo = read_photo(job.photo)
        more = [read_photo(path) for path in job.more]
    with log.measure("statistics", "what is known of faces; read once"):
        relighter = load()
    with _naming(job.photo), log.measure("find", "where the faces are"):
        chosen, count = _chosen(job, photo, more, request)
    if count and len(chosen) < count:
        numbers = " and ".join(str(index) for index, _ in chosen)
        others = "the picture's border cuts the others" if request.face == "all" else "--face takes all or another"
        say(f"{job.photo}: face {numbers} of {count}, whole ones first, then by size; {others}")
    with _naming(job.photo):
        report = _relight(job, request, photo, [other.pixels for other in more], chosen, relighter)
    report["stages"] = [*map(_stage, log.stages), *report["stages"]]
    lost = [f"{path.name}: {line}" for path in job.outputs[:1] for line in not_held(path, photo)]
    from facerelight.geometry.sources import lights_behind

    behind = lights_behind([lamp for scene in request.scenes for lamp in scene.lamps])
    report["warnings"] = [*lost, *behind, *report["warnings"]]
    for line in report["warnings"]:
        say(f"{job.photo}: {line}")
    number = {"index": chosen[0][0], "count": count} if count else None
    return {"photo": str(job.photo), "face": number, **report, "seconds": round(time.perf_counter() - started, 3)}


def choose_faces(photo: np.ndarray, which: str) -> tuple[list[tuple[int, Face]], int]:
    """The faces asked for of ``photo (H, W, 3)`` uint8, each with its number from 1, and how many were found.

    Args:
        which: "largest", the largest of the whole faces; "all", the whole ones, or all where none is whole; or a
            number: whole faces come first, then larger ones.

    Raises:
        LandmarksNotFoundError: no face.
        ValueError: a number beyond the number of faces.
    """
    from facerelight.photo.faces.landmarks import LandmarksNotFoundError, find_faces

    faces = list(enumerate(find_faces(photo), 1))
    if not faces:
        raise LandmarksNotFoundError(f"found no face; {REMEDY}")
    if which == "all":
        return [(k, face) for k, face in faces if face.whole] or faces, len(faces)
    number = 1 if which == "largest" else int(which)
    if number > len(faces):
        raise ValueError(f"face: expected a number up to {len(faces)}, as many as were found, got {number}")
    return [faces[number - 1]], len(faces)


def _chosen(
    job: Job,
    photo: PhotoFile,
    more: list[PhotoFile],
    request: Request,
) -> tuple[list[tuple[int, Face | None]], int]:
    """The faces to relight, and how many there are; where landmarks are given, nothing is looked for."""
    from facerelight.photo.faces.landmarks import LandmarksNotFoundError, find_faces
    from facerelight.photo.files.profiles import eight_bits

    for path, other in zip(job.more, more, strict=True):
        if not find_faces(eight_bits(other.pixels)):
            raise LandmarksNotFoundError(f"found no face in {path}; leave it out, --landmarks is of the first photo")
    if request.landmarks is not None:
        return [(1, None)], 0
    chosen, count = choose_faces(eight_bits(photo.pixels), request.face)
    return list(chosen), count


def _relight(
    job: Job,
    request: Request,
    photo: PhotoFile,
    more: list[np.ndarray],
    chosen: list[tuple[int, Face | None]],
    relighter: StatisticalRelighter,
) -> dict[str, Any]:
    """Write every scene, the faces one after the other in the same picture, and the map; report on each face."""
    from facerelight.geometry.lights import light_from_angles
    from facerelight.photo.session import PhotoRelighter

    light = None if request.source_light is None else light_from_angles(*request.source_light)

    def session(pixels: np.ndarray, face: Face | None) -> PhotoRelighter:
        known: dict[str, Any] = {"source_light": light, "more": more, "method": request.method, "face": face}
        return PhotoRelighter(pixels, request.landmarks, relighter, **known)

    taken = [] if request.light_of is None else [light_of_photo(request.light_of, relighter)]

    def lights(of: PhotoRelighter, scene: Scene) -> list[Lamp | LightMixture]:
        return [*([of.light] if request.add else []), *taken, *scene.lamps]

    first = session(photo.pixels, chosen[0][1])
    facts, said = [_facts(first)], list(first.warnings)
    for path, scene in zip(job.outputs, request.scenes, strict=True):
        pixels = first.render(lights(first, scene), fill=request.fill, strength=request.strength)
        for _, face in chosen[1:]:
            other = session(pixels, face)
            pixels = other.render(lights(other, scene), fill=request.fill, strength=request.strength)
            facts.append(_facts(other))
            said += other.warnings
        write_photo(path, pixels, photo)
        if request.strength > 0 and np.array_equal(pixels, photo.pixels):
            said.append(f"{path.name}: nothing was changed; no person was seen around the landmarks")
    written = [str(path) for path in job.outputs]
    if job.variance:
        white = _write_map(job.variance, first.std(request.scenes[0].azimuth, request.scenes[0].elevation))
        said.append(
            f"{job.variance.name}: of the face alone; white is a standard deviation of {white:.3f}, of light 0 to 1"
        )
        written.append(str(job.variance))
    facts[0] = _facts(first)  # with the stages that ran since
    report = {"method": request.method, "output": written, **facts[0], "warnings": list(dict.fromkeys(said))}
    faces = [{"index": index, **fact} for (index, _), fact in zip(chosen, facts, strict=False)]
    return report if len(faces) == 1 else {**report, "faces": faces}


def light_of_photo(path: Path, relighter: StatisticalRelighter) -> LightMixture:
    """The light of another photo, as fitted to its largest face."""
    from facerelight.photo.session import PhotoRelighter

    with _naming(path):
        return PhotoRelighter(read_photo(path).pixels, None, relighter).light


def _facts(session: PhotoRelighter) -> dict[str, Any]:
    azimuth, elevation = session.source_angles
    pose, turns = session.pose, ("yaw", "pitch", "roll")
    return {
        "source_light": {"azimuth": round(azimuth, 1), "elevation": round(elevation, 1)},
        "landmarks": [[round(float(v), 1) for v in point] for point in session.landmarks.tolist()],
        "pose": None if pose is None else {name: round(float(getattr(pose, name)), 1) for name in turns},
        "stages": [_stage(stage) for stage in session.stages],
    }


def _stage(stage: Stage) -> dict[str, Any]:
    return {**stage._asdict(), "seconds": round(stage.seconds, 4)}


def _write_map(path: Path, std: np.ndarray) -> float:
    """A grey picture of a map, white at its largest value, which is returned."""
    white = max(float(std.max()), 1e-12)
    grey = (std / white * 255).round().astype(np.uint8)
    write_photo(path, np.repeat(grey[..., None], 3, axis=2))
    return white


def _expand(path: Path, into: Path) -> list[tuple[Path, Path]]:
    """Photos, each with the folders that it is in below ``path``; of a folder all but hidden ones, and results."""
    if not path.is_dir():
        return [(path, Path())]
    apart = into.resolve() if into.is_dir() and into.resolve() != path.resolve() else None
    found = []
    for folder, folders, _ in os.walk(path):
        folders[:] = sorted(name for name in folders if name[0] != "." and Path(folder, name).resolve() != apart)
        here = [photo for photo in find_photos(folder) if not _is_result(photo)]
        found += [(photo, Path(folder).relative_to(path)) for photo in here]
    if not found:
        raise ValueError(f"{path}: expected a folder with photos ({', '.join(SUFFIXES)}), found none")
    return found


def _is_result(photo: Path) -> bool:
    """Whether a photo's name says that it was made of another one beside it, by an earlier run."""
    source, mark, _ = photo.name.rpartition(RESULT)
    return bool(mark) and any(photo.with_name(source + suffix).exists() for suffix in (*SUFFIXES, photo.suffix))


def _check_outputs(jobs: Sequence[Job], photos: Sequence[Path], force: bool) -> None:
    inputs = {path.resolve() for path in photos if "\0" not in str(path)}
    seen: dict[Path, Path] = {}
    for job in jobs:
        for path in (*job.outputs, *([job.variance] if job.variance else [])):
            check_writable(path)
            place = path.resolve()
            if place in seen:
                other = "a result as well" if seen[place] == job.photo else f"what comes of {seen[place]} as well"
                raise ValueError(f"{path}: expected a file for every result of {job.photo}, but this one is {other}")
            seen[place] = job.photo
            if place in inputs and place != job.photo.resolve():
                raise ValueError(f"{path}: is itself a photo of this batch; --output says another place")
            if path.exists() and not force:
                what = "is a photo to be relit" if place in inputs else "exists already"
                raise ValueError(f"{path}: {what}; --force overwrites it, --output says another place")


def _some(paths: Sequence[Path]) -> str:
    names = [path.name for path in paths[:3]]
    return ", ".join([*names, "..."] if len(paths) > 3 else names)


@contextmanager
def _naming(photo: Path) -> Iterator[None]:
    """Errors with the photo's name in front, and the remedy behind where they are about landmarks."""
    from facerelight.photo.faces.landmarks import LandmarksNotFoundError

    try:
        yield
    except (ValueError, LandmarksNotFoundError) as error:
        text = str(error) if str(error).startswith(str(photo)) else f"{photo}: {error}"
        about = isinstance(error, LandmarksNotFoundError) or "landmarks: " in text
        text = f"{text}; {REMEDY}" if about and "--landmarks" not in text else text
        kind = LandmarksNotFoundError if isinstance(error, LandmarksNotFoundError) else ValueError
        raise kind(text) from error
