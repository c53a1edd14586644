"""Photographs for end-to-end recognition: one enrolled a person, the others as probes, as a user has them on disk."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.geometry.alignment import CANONICAL_LANDMARKS
from facerelight.photo.faces.landmarks import Face, face_at, find_faces
from facerelight.photo.files.disk import find_people, read_photo
from facerelight.photo.files.pixels import as_bytes
from facerelight.recognition.embedding import srgb_bytes

__all__ = ["ENROLLED", "PROBES", "Shot", "find_face", "folder_shots", "turn_photo", "yale_photo", "yale_shots"]

BORDER = 60  # pixels around the crop of 192 x 168
ENROLLED = ((0, 0), (-35, 15), (60, 20), (0, 45), (-25, 0))
PROBES = ((10, 0), (35, 15), (-50, 0), (-20, -40), (50, -40), (70, 0))


class Shot(NamedTuple):
    """A photograph: number of the ``person``, ``photo (H, W, 3)`` uint8 sRGB, ``enrolled`` or a probe, and the true
    ``landmarks (3, 2)`` where they are known."""

    person: int
    photo: np.ndarray
    enrolled: bool
    landmarks: np.ndarray | None


def yale_photo(radiance: torch.Tensor) -> np.ndarray:
    """Linear ``(192, 168)`` as a photograph: sRGB, ``(H', W', 3)`` uint8 with a border of repeated pixels."""
    coded = np.repeat(srgb_bytes(radiance)[..., None], 3, axis=2)
    return np.pad(coded, ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), mode="edge")


def yale_shots(path: Path, every: bool = False) -> list[Shot]:
    """Extended Yale B: everybody is enrolled from one of five mild lights; probes are six other lights, or ``every``
    other good image."""
    faces = load_yale(path, 192, 168)
    shots = []
    for person in range(len(faces.names)):
        first = _light(faces, ENROLLED[person % len(ENROLLED)])
        probes = {_light(faces, angles) for angles in PROBES}
        for image in (faces.subject == person).nonzero()[:, 0].tolist():
            light = int(faces.light[image])
            if light == first or light in probes or every:
                true = np.array(CANONICAL_LANDMARKS) + BORDER
                shots.append(Shot(person, yale_photo(faces.images[image]), light == first, true))
    return shots


def folder_shots(folder: Path) -> list[Shot]:
    """``folder/NAME/*.jpg``: the first photo by name is enrolled, the others are probes.

    Raises:
        ValueError: nobody with two photos.
    """
    people = [photos for photos in find_people(folder).values() if len(photos) > 1]
    if len(people) < 2:
        raise ValueError(f"{folder}: expected NAME/*.jpg with two photos or more of two people or more")
    return [
        Shot(person, as_bytes(read_photo(path).rgb), number == 0, None)
        for person, photos in enumerate(people)
        for number, path in enumerate(photos)
    ]


def turn_photo(shot: Shot, degrees: float, scale: float) -> Shot:
    """The same photograph, turned about its middle and enlarged, border repeated."""
    height, width = shot.photo.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, scale)
    size = round(width * scale), round(height * scale)
    matrix = np.column_stack((matrix[:, :2], matrix[:, 2] + (np.array(size) - (width, height)) / 2))
    photo = cv2.warpAffine(shot.photo, matrix, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    marked = None if shot.landmarks is None else shot.landmarks @ matrix[:, :2].T + matrix[:, 2]
    return shot._replace(photo=photo, landmarks=marked)


def find_face(shot: Shot, exact: bool = False) -> Face | None:
    """The face that a user would get: the largest whole one; with ``exact`` landmarks the true one.

    Raises:
        ValueError: exact landmarks asked for where none are known.
    """
    if exact:
        if shot.landmarks is None:
            raise ValueError("landmarks: expected data whose true landmarks are known, got photographs without")
        return face_at(shot.photo, shot.landmarks)
    faces = find_faces(shot.photo)
    return faces[0] if faces else None


def _light(faces: FaceImages, angles: tuple[int, int]) -> int:
    return int((faces.angles - torch.tensor(angles)).abs().sum(1).argmin())
