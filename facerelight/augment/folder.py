"""A relit training set on disk: every picture of a folder, and copies of it under random lamps, in the same layout."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.augment.random_face_relight import RandomFaceRelight
from facerelight.photo.faces.landmarks import LandmarksNotFoundError, find_landmarks
from facerelight.photo.files.disk import SUFFIXES, read_photo, write_photo
from facerelight.photo.files.photograph import PhotoFile
from facerelight.photo.files.profiles import eight_bits

__all__ = ["MANIFEST", "Copy", "counts", "plan_training_set", "relit_copies", "training_pictures", "write_training_set"]

MANIFEST = "manifest.csv"
LAMP = ("azimuth", "elevation", "size", "fill", "mix")
PIXELS_AT_ONCE = 2**21  # of all copies that are relit together: about 0.25 GB
LEAST_EYES = 0.12  # of a crop's shorter side, between the eyes: less is a photograph of more than a face
COLUMNS = ("picture", "status", "output", *LAMP, "error")


class Copy(NamedTuple):
    """One row of the manifest: a ``picture`` and the ``status`` of an ``output``: "original", "relit", or "left out"
    with an ``error``; ``lamp``, its drawn parameters by name."""

    picture: Path
    status: str
    output: Path | None
    lamp: dict[str, float]
    error: str = ""


def training_pictures(folder: Path) -> list[Path]:
    """All pictures in ``folder`` and in those below it, in a fixed order.

    Raises:
        ValueError: none.
    """
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    if not found:
        raise ValueError(f"{folder}: expected a folder of pictures ({', '.join(SUFFIXES)}), found none")
    return found


def plan_training_set(folder: Path, output: Path, copies: int, force: bool) -> list[tuple[Path, Path]]:
    """Pictures of ``folder``, and where they go under ``output``.

    Raises:
        ValueError: no pictures, an output inside the folder or one that holds a picture, a copy or a manifest already,
            or a picture named like a copy of another one.
    """
    pictures = training_pictures(folder)
    if output.resolve().is_relative_to(folder.resolve()):
        raise ValueError(f"output: expected a place outside {folder}, got {output}")
    places = [output / path.relative_to(folder) for path in pictures]
    copied = [copy for place in places for copy in _copies(place, copies)]
    made_twice = set(copied) & set(places)
    if made_twice:
        raise ValueError(f"{min(made_twice)}: is a picture and a copy of another one; rename it in {folder}")
    taken = next((place for place in (*places, *copied, output / MANIFEST) if place.exists()), None)
    if taken is not None and not force:
        raise ValueError(f"{taken}: exists already; --force overwrites it, --output says another place")
    return list(zip(pictures, places, strict=True))


def write_training_set(
    folder: Path, output: Path, copies: int, relight: RandomFaceRelight, find_faces: bool, seed: int, force: bool
) -> Iterator[Copy]:
    """Write every picture of ``folder`` and its relit copies under ``output``, and ``manifest.csv``; a row when it is
    done.

    ``person/one.jpg`` becomes ``person/one.jpg``, as it is, and ``person/one_00.jpg`` and so on. A picture without a
    face that can be relit is written without copies.

    Args:
        folder: pictures, or folders of them, a class each.
        output: elsewhere; made where there is none.
        copies: of each picture.
        relight: its probability is not asked: every copy is relit.
        find_faces: look for the face of every picture, instead of taking it to lie where ``relight.frame`` says.
        seed: of the lamps, which depend on nothing else but a picture's place in the order.
        force: overwrite files that exist.

    Raises:
        ValueError: see :func:`plan_training_set`.
    """
    plan = plan_training_set(folder, output, copies, force)
    output.mkdir(parents=True, exist_ok=True)
    with (output / MANIFEST).open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
        table.writeheader()
        for number, (path, place) in enumerate(plan):
            place.parent.mkdir(parents=True, exist_ok=True)
            for made in _made(path, place, copies, relight, find_faces, (seed, number)):
                table.writerow(_row(made, folder, output))
                file.flush()
                yield made


def _made(
    path: Path, place: Path, copies: int, relight: RandomFaceRelight, find_faces: bool, seed: tuple[int, int]
) -> Iterator[Copy]:
    try:
        photo = read_photo(path)
    except ValueError as error:
        yield Copy(path, "left out", None, {}, str(error))
        return
    place.write_bytes(path.read_bytes())
    yield Copy(path, "original", place, {})
    pixels = eight_bits(photo.pixels)
    try:
        marks = _landmarks(pixels) if find_faces else None
        made = relit_copies(pixels, copies, relight, marks, seed)
    except (LandmarksNotFoundError, ValueError) as error:
        yield Copy(path, "left out", None, {}, str(error))
        return
    for target, (relit, lamp) in zip(_copies(place, copies), made, strict=True):
        write_photo(target, relit, _plain(photo))
        yield Copy(path, "relit", target, lamp)


def _copies(place: Path, copies: int) -> list[Path]:
    digits = max(2, len(str(copies - 1)))
    return [place.with_name(f"{place.stem}_{index:0{digits}d}{place.suffix}") for index in range(copies)]


def _plain(photo: PhotoFile) -> PhotoFile | None:
    """What a copy keeps of the picture: all, where it has 8 bits a channel; else it is written as sRGB."""
    return photo if photo.pixels.dtype == np.uint8 else None


def relit_copies(
    pixels: np.ndarray, copies: int, relight: RandomFaceRelight, landmarks: Tensor | None, seed: tuple[int, int]
) -> list[tuple[np.ndarray, dict[str, float]]]:
    """Relit copies of a crop, and the lamps they were given.

    Args:
        pixels: ``(H, W, 3)`` uint8 sRGB.
        copies: how many.
        relight: what relights; its probability is not asked.
        landmarks: ``(3, 2)`` pixels; None: where ``relight.frame`` says.
        seed: two numbers that say which lamps.

    Raises:
        ValueError: a black crop, or one of a contrast that no light makes on the average face.
    """
    crop = torch.from_numpy(pixels).permute(2, 0, 1).float()[None] / 255
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
        params = relight.forward_parameters(torch.Size((copies, *crop.shape[1:])))
    images: list[np.ndarray] = []
    for some in torch.arange(copies).split(max(1, PIXELS_AT_ONCE // crop[0, 0].numel())):
        images += _relit(crop, relight, landmarks, {name: params[name][some] for name in LAMP})
    return [
        (image, {name: round(float(params[name][index]), 3) for name in LAMP}) for index, image in enumerate(images)
    ]


def _relit(
    crop: Tensor, relight: RandomFaceRelight, landmarks: Tensor | None, lamps: dict[str, Tensor]
) -> list[np.ndarray]:
    """A crop ``(1, 3, H, W)`` under each of the ``lamps``."""
    count = len(lamps["azimuth"])
    marks = None if landmarks is None else landmarks.expand(count, -1, -1)
    params = {**lamps, "batch_prob": torch.ones(count)}
    with torch.no_grad():
        relit = relight(crop.expand(count, -1, -1, -1), params=params, landmarks=marks)
    if not bool(relight._params["relit"].all()):
        raise ValueError(
            "expected a lit face, got a black crop, or one of a contrast that no light makes on the average face"
        )
    return list((relit.clamp(0, 1) * 255).round().to(torch.uint8).permute(0, 2, 3, 1).numpy())


def _landmarks(pixels: np.ndarray) -> Tensor:
    marks = find_landmarks(pixels)
    apart = float((marks[1] - marks[0]).norm())
    least = LEAST_EYES * min(pixels.shape[:2])
    if apart < least:
        raise ValueError(
            f"expected a crop of a face, with eyes {least:.0f} pixels apart or more, got {apart:.0f};"
            " `facerelight relight` is for photographs of more"
        )
    return marks


def _row(made: Copy, folder: Path, output: Path) -> dict[str, object]:
    place = "" if made.output is None else made.output.relative_to(output).as_posix()
    picture = made.picture.relative_to(folder).as_posix()
    return {"picture": picture, "status": made.status, "output": place, **made.lamp, "error": made.error}


def counts(rows: Sequence[Copy]) -> dict[str, int]:
    """How many rows have each status."""
    return {status: sum(row.status == status for row in rows) for status in ("original", "relit", "left out")}
