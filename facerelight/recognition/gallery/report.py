"""What a run of ``facerelight recognize`` found: enrolled, identified and skipped, as lines, JSON and CSV."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from facerelight.photo.faces.landmarks import LandmarksNotFoundError
from facerelight.photo.files.disk import find_photos
from facerelight.recognition.gallery.gallery import Gallery, Identification, open_faces

__all__ = ["Answers"]

COLUMNS = ("photo", "face", "x0", "y0", "x1", "y1", "name", "rank", "person", "probability", "score")


class Answers:
    """Gathers answers, and goes on where a photo cannot be used.

    Args:
        unknown: what strangers are called.
        say: takes each photo that is skipped, and why.
    """

    def __init__(self, unknown: str, say: Callable[[str], None]) -> None:
        self.unknown, self._say = unknown, say
        self.found: dict[str, list[Identification]] = {}
        self.skipped: dict[str, str] = {}
        self._opened_photos = self._unreadable = 0

    def enroll(self, gallery: Gallery, name: str, photo: Path) -> None:
        """Enroll the largest face of a photo as ``name``."""
        with_faces = self._opened(photo)
        if with_faces is None:
            return
        pixels, faces = with_faces
        gallery.add(name, pixels, faces[0])
        if len(faces) > 1:
            self._say(f"{photo}: {len(faces)} faces; enrolled the largest as {name}")

    def enroll_all(self, gallery: Gallery, photo: Path, names: Sequence[str] | None) -> None:
        """Enroll every face of a photo, from left to right, as ``names`` or as PHOTO-1 and so on.

        Raises:
            ValueError: a photo that cannot be read, or another number of names than of faces.
            LandmarksNotFoundError: no face in it.
        """
        pixels, faces = open_faces(photo)
        faces = sorted(faces, key=lambda face: face.landmarks[:, 0].mean())
        called = names or ([photo.stem] if len(faces) == 1 else [f"{photo.stem}-{i + 1}" for i in range(len(faces))])
        if len(called) != len(faces):
            raise ValueError(f"names: expected one for each of {len(faces)} faces in {photo}, got {len(called)}")
        for name, face in zip(called, faces, strict=True):
            gallery.add(name, pixels, face)

    def identify(self, gallery: Gallery, place: Path, far: float, top: int) -> None:
        """Identify every face of a photo, or of all photos in a folder."""
        photos = find_photos(place) if place.is_dir() else [place]
        if not photos:
            self._skip(place, "expected photos in the folder, got none")
        for photo in photos:
            with_faces = self._opened(photo)
            if with_faces is not None:
                pixels, faces = with_faces
                self.found[str(photo)] = [gallery.compare(pixels, face, far, top) for face in faces]

    def _opened(self, photo: Path) -> Any:
        try:
            opened = open_faces(photo)
            self._opened_photos += 1
            return opened
        except (ValueError, LandmarksNotFoundError) as error:
            self._unreadable += isinstance(error, ValueError)
            self._skip(photo, str(error).removeprefix(f"{photo}: "))
            return None

    def _skip(self, photo: Path, reason: str) -> None:
        self.skipped[str(photo)] = reason
        self._say(f"{photo}: skipped: {reason}")

    @property
    def exit_code(self) -> int:
        """0; 1 where photos were skipped, or faces were identified and all are strangers; 2 where no photo at all could
        be read."""
        if self._unreadable and self._opened_photos == 0 and len(self.skipped) == self._unreadable:
            return 2
        names = [found.name for faces in self.found.values() for found in faces]
        return 1 if self.skipped or (names and not any(names)) else 0

    def print_lines(self, gallery: Gallery, listed: bool) -> None:
        """A line a face, and one a person where they are ``listed``."""
        for name, photos in gallery.people.items() if listed else ():
            print(f"{name}: {photos} photo{'s' if photos > 1 else ''}")
        for photo, faces in self.found.items():
            for number, found in enumerate(faces, 1):
                place = photo if len(faces) == 1 else f"{photo}, face {number}"
                likeliest = ", ".join(f"{match.name} {match.probability:.3f}" for match in found.matches)
                print(f"{place}: {found.name or self.unknown} ({likeliest})")

    def print_json(self, gallery: Gallery, listed: bool) -> None:
        """Everything, on one line; who is enrolled is there in any case."""
        answers = {photo: [self._told(found) for found in faces] for photo, faces in self.found.items()}
        print(json.dumps({"enrolled": gallery.people, "answers": answers, "skipped": self.skipped}))

    def _told(self, found: Identification) -> dict[str, object]:
        matches = [
            {"name": match.name, "probability": round(match.probability, 6), "score": round(match.score, 4)}
            for match in found.matches
        ]
        box = [round(edge, 1) for edge in found.face.box]
        return {"name": found.name or self.unknown, "known": found.name is not None, "box": box, "matches": matches}

    def write_csv(self, path: Path) -> None:
        """A row for each face and person named for it; ``name`` is the answer, ``person`` one of the likeliest."""
        with path.open("w", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            for photo, faces in self.found.items():
                for number, found in enumerate(faces, 1):
                    box = [round(edge, 1) for edge in found.face.box]
                    for rank, match in enumerate(found.matches, 1):
                        likely = match.name, round(match.probability, 6), round(match.score, 4)
                        writer.writerow([photo, number, *box, found.name or self.unknown, rank, *likely])
