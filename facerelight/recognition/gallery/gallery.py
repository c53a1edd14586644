"""A gallery: people, the templates of their photographs, and who a face is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from facerelight.photo.faces.landmarks import Face, LandmarksNotFoundError, find_faces
from facerelight.photo.files.disk import read_photo
from facerelight.photo.files.pixels import as_bytes
from facerelight.recognition.gallery.calibration import Calibration, calibrate, stranger_scores
from facerelight.recognition.gallery.file import load_templates, save_templates
from facerelight.recognition.gallery.recognizer import Index, Recognizer, Template

__all__ = ["Gallery", "Identification", "Match"]

CALIBRATED_ON = 500  # enrolled faces at most, evenly chosen ...
COMPARED = 40  # ... or so many, where templates are more than vectors


class Match(NamedTuple):
    """A person: ``name``; ``probability`` that it is them, where one pair in two is; ``score``, in standard deviations
    above strangers'."""

    name: str
    probability: float
    score: float


class Identification(NamedTuple):
    """``name``, None for a stranger; ``matches``, the likeliest people, best first; ``face``, where it was seen."""

    name: str | None
    matches: list[Match]
    face: Face


class Gallery:
    """People by name, each with a template a photograph, all of one recogniser.

    Args:
        recognizer: see :class:`facerelight.recognition.gallery.recognizer.Recognizer`.

    Example:
        >>> from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer
        >>> from facerelight.recognition.sface import SFace
        >>> gallery = Gallery(EmbeddingRecognizer(SFace()))  # doctest: +SKIP
        >>> gallery.enroll("ann", [Path("ann.jpg")])  # doctest: +SKIP
        >>> [found.name for found in gallery.identify("door.jpg")]  # doctest: +SKIP
        ['ann', None]
    """

    def __init__(self, recognizer: Recognizer) -> None:
        self.recognizer = recognizer
        self._owners: list[str] = []
        self._templates: Template = {}

    @property
    def people(self) -> dict[str, int]:
        """How many photographs there are of each person, sorted by name."""
        return dict(sorted(Counter(self._owners).items()))

    @property
    def templates(self) -> Template:
        """What is kept of the faces enrolled."""
        return self._templates

    def add(self, name: str, photo: np.ndarray, face: Face) -> None:
        """Enroll a person's face, or one more photograph of them.

        Args:
            name: of the person.
            photo: ``(H, W, 3)`` uint8 sRGB.
            face: found in it.

        Raises:
            ValueError: no name.
        """
        self.add_templates([_checked(name)], self.recognizer.enroll(photo, face))

    def add_templates(self, names: Sequence[str], templates: Template) -> None:
        """Enroll ready-made templates, one a name.

        Raises:
            ValueError: templates of another kind than those in the gallery, or another number of them.
        """
        for name in names:
            _checked(name)
        parts = {part: tuple(values.shape[1:]) for part, values in templates.items()}
        known = {part: tuple(values.shape[1:]) for part, values in self._templates.items()}
        if any(len(values) != len(names) for values in templates.values()) or (known and parts != known):
            raise ValueError(f"templates: expected {len(names)} of {known or 'any kind'}, got {parts}")
        old = self._templates
        self._keep(
            [*self._owners, *names],
            {part: torch.cat((old[part], values)) if old else values for part, values in templates.items()},
        )

    def enroll(self, name: str, photos: Sequence[str | Path]) -> None:
        """Enroll the largest face of each photo on disk.

        Raises:
            ValueError: no photos, or one that cannot be read.
            LandmarksNotFoundError: a photo without a face.
        """
        if not photos:
            raise ValueError(f"photos: expected one or more of {name}, got none")
        for path in photos:
            pixels, faces = open_faces(path)
            self.add(name, pixels, faces[0])

    def remove(self, name: str) -> None:
        """Forget a person and all their templates.

        Raises:
            ValueError: nobody of that name.
        """
        if name not in self._owners:
            raise ValueError(f"name: expected one of the {len(self.people)} people enrolled, got {name!r}")
        kept = [row for row, owner in enumerate(self._owners) if owner != name]
        rows = torch.tensor(kept, dtype=torch.long)
        owners = [self._owners[row] for row in kept]
        self._keep(owners, {part: values[rows] for part, values in self._templates.items()} if kept else {})

    def identify(self, photo: str | Path, far: float = 0.01, top: int = 3) -> list[Identification]:
        """Everybody in a photo on disk, whole faces first, then the larger ones first.

        Raises:
            ValueError: see :meth:`compare`, or a photo that cannot be read.
            LandmarksNotFoundError: a photo without a face.
        """
        pixels, faces = open_faces(photo)
        return [self.compare(pixels, face, far, top) for face in faces]

    def compare(self, photo: np.ndarray, face: Face, far: float = 0.01, top: int = 3) -> Identification:
        """Who a face is.

        Args:
            photo: ``(H, W, 3)`` uint8 sRGB.
            face: found in it.
            far: share of strangers that may pass for somebody enrolled, above 0 and below 1.
            top: how many people to name.

        Raises:
            ValueError: an empty gallery, a rate out of range, or nobody to name.
        """
        if not self._owners:
            raise ValueError("gallery: expected people in it, got none; enroll them first")
        if top < 1:
            raise ValueError(f"top: expected at least 1 person, got {top}")
        threshold = self.calibration.threshold(far, len(self._owners))
        # where templates have levels of their own, the best score may not be the best person
        count = len(self._owners) if self.recognizer.personal else top * self._most
        found, rows = self._index.search(self.recognizer.describe(photo, face), count)
        best: dict[str, float] = {}
        for row, score in zip(rows.tolist(), self.calibration.standardised(found, rows).tolist(), strict=True):
            best[self._owners[row]] = max(score, best.get(self._owners[row], -np.inf))
        ranked = sorted(best.items(), key=lambda pair: -pair[1])[:top]
        matches = [Match(name, self.calibration.probability(score), score) for name, score in ranked]
        return Identification(matches[0].name if matches[0].score >= threshold else None, matches, face)

    @cached_property
    def calibration(self) -> Calibration:
        """What scores mean here: the people enrolled are strangers to each other."""
        owners = self._numbers
        most = CALIBRATED_ON if set(self._templates) == {"probe"} else COMPARED
        chosen = torch.linspace(0, len(owners) - 1, min(most, len(owners))).round().long()
        part = {part: values[chosen] for part, values in self._templates.items()}
        scores = stranger_scores(self.recognizer, part, owners[chosen])
        levels, personal = self.recognizer.levels, self.recognizer.personal
        learned = calibrate(scores, owners[chosen], owners[chosen], levels, personal)
        return learned._replace(mean=learned.mean.mean().repeat(len(owners)).index_copy(0, chosen, learned.mean))

    @cached_property
    def _index(self) -> Index:
        return self.recognizer.index(self._templates, self._numbers)

    @cached_property
    def _numbers(self) -> torch.Tensor:
        """Whose each template is, as a number."""
        numbers = {name: number for number, name in enumerate(dict.fromkeys(self._owners))}
        return torch.tensor([numbers[name] for name in self._owners])

    @cached_property
    def _most(self) -> int:
        """Photographs of one person, at most."""
        return max(Counter(self._owners).values())

    def _keep(self, owners: list[str], templates: Template) -> None:
        self._owners, self._templates = owners, templates
        for derived in ("calibration", "_index", "_most", "_numbers"):
            self.__dict__.pop(derived, None)

    def save(self, path: str | Path) -> None:
        """Write the gallery to one file (safetensors)."""
        header: dict[str, object] = {
            "recognizer": self.recognizer.name,
            "key": self.recognizer.key(),
            "owners": self._owners,
        }
        save_templates(Path(path), header, self._templates)

    @classmethod
    def load(cls, path: str | Path, recognizer: Recognizer) -> Gallery:
        """Read what :meth:`save` wrote.

        Raises:
            ValueError: a file that is missing or damaged, or templates of another model, crop or version.
        """
        gallery = cls(recognizer)
        header, templates = load_templates(Path(path))
        if header["key"] != recognizer.key():
            raise ValueError(
                f"{path}: expected a gallery of {recognizer.key()}, got {header['key']};"
                " enroll anew with `facerelight recognize`"
            )
        if header["owners"]:
            gallery.add_templates(header["owners"], templates)
        return gallery


def open_faces(path: str | Path) -> tuple[np.ndarray, list[Face]]:
    """A photo on disk, ``(H, W, 3)`` uint8 sRGB, and its faces, whole ones first, then the larger ones first.

    Raises:
        ValueError: the photo cannot be read.
        LandmarksNotFoundError: it shows no face.
    """
    pixels = as_bytes(read_photo(path).rgb)
    faces = find_faces(pixels)
    if not faces:
        raise LandmarksNotFoundError(f"{path}: found no face")
    return pixels, faces


def _checked(name: object) -> str:
    if not isinstance(name, str) or not name:
        raise ValueError(f"name: expected that of the person, got {name!r}")
    return name
