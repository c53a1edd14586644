"""One face followed from frame to frame: found once, then looked for where it was; found anew behind a cut."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.faces.landmarks import Face, face_of_points, find_faces, follow_face
from facerelight.photo.files.pixels import as_bytes
from facerelight.photo.film.steady import PointFilter, State

__all__ = ["Choose", "Picture", "Tracked", "follow", "largest_face"]

FADE = 8  # frames over which the light goes where a face leaves, and comes where one enters
GAP = 4  # frames without the face that are bridged
AHEAD = FADE + GAP  # frames that are looked ahead
SEARCH_EVERY = 4  # frames, while there is no face
THUMB = (64, 36)
CUT = 28.0  # grey levels by which the pictures on both sides of a cut differ ...
SUDDEN = 4.0  # ... and times as much as the pictures before it
JUMP = 1.0  # eye distances that no face moves between two frames


class Picture(NamedTuple):
    """A film's frame, upright: ``pixels (H, W, 3)`` uint8 or uint16, sRGB-coded, and its ``time`` in seconds from the
    film's start."""

    pixels: np.ndarray
    time: float


class Tracked(NamedTuple):
    """A picture, its ``face`` or None, and how much of the new light it gets, 0 to 1; ``shot`` counts the cuts before
    it, ``run`` the faces that were found."""

    picture: Picture
    face: Face | None
    share: float
    shot: int
    run: int


class _Entry(NamedTuple):
    picture: Picture
    state: State
    found: Face | None


Choose = Callable[[np.ndarray, Face | None], Face | None]


def largest_face(pixels: np.ndarray, before: Face | None = None) -> Face | None:
    """The largest whole face of ``pixels (H, W, 3)`` uint8, whatever was followed ``before``."""
    faces = find_faces(pixels)
    return faces[0] if faces else None


def follow(pictures: Iterable[Picture], choose: Choose = largest_face) -> Iterator[Tracked]:
    """Every picture with its face, some frames late; memory holds those frames alone.

    Args:
        pictures: of one size.
        choose: the face that is meant, in a picture in which none was followed; it is given the pixels, and the face
            that was followed before in this shot, if there was one.
    """
    tracker = _Tracker(choose)
    for picture in pictures:
        yield from tracker.take(picture)
    yield from tracker.close(lost=False)


class _Tracker:
    def __init__(self, choose: Choose) -> None:
        self.choose = choose
        self.entries: deque[_Entry] = deque()
        self.filter: PointFilter | None = None
        self.last: Face | None = None
        self.missed = self.shot = self.run = self.given = self.without = 0
        self.entered = False  # whether this face came into a shot that was there already
        self.thumb: np.ndarray | None = None
        self.usual = 0.0

    def take(self, picture: Picture) -> Iterator[Tracked]:
        pixels = as_bytes(picture.pixels)
        if self._is_cut(pixels):
            yield from self.close(lost=False)
            self.shot, self.without, self.last = self.shot + 1, 0, None
        face = follow_face(pixels, self.last) if self.filter is not None and self.last is not None else None
        face = face if _lies_in(face, pixels) else None
        if face is None and (self.without + self.missed) % SEARCH_EVERY == 0:
            face = self._searched(pixels)
            if face is not None and self.filter is not None and self._jumped(face):
                yield from self.close(lost=True)
        if self.filter is None and face is None:
            self.without += 1
            yield Tracked(picture, None, 0.0, self.shot, self.run)
            return
        if self.filter is None:
            assert face is not None
            self.filter = PointFilter(float(np.hypot(*(face.landmarks[1] - face.landmarks[0]))))
            self.run, self.given, self.entered = self.run + 1, 0, self.without > 0
        self.missed = 0 if face else self.missed + 1
        points = None if face is None else face.points
        self.last = face or self.last
        self.entries.append(_Entry(picture, self.filter.step(points), face))
        if self.missed > GAP:
            yield from self.close(lost=True)
        elif len(self.entries) > AHEAD:
            yield self._oldest(1.0)

    def close(self, lost: bool) -> Iterator[Tracked]:
        """Give what is left of this run; ``lost``: the face left, so that the light fades."""
        gone = []
        while self.entries and self.entries[-1].found is None:
            gone.append(self.entries.pop())
        while self.entries:
            yield self._oldest(min(1.0, len(self.entries) / (FADE + 1)) if lost or gone else 1.0)
        for entry in reversed(gone):
            self.without += 1
            yield Tracked(entry.picture, None, 0.0, self.shot, self.run)
        self.filter, self.missed = None, 0
        if not lost:
            self.without = len(gone)

    def _oldest(self, share: float) -> Tracked:
        points = PointFilter.smoothed([entry.state for entry in self.entries])
        entry = self.entries.popleft()
        self.given += 1
        if self.entered:
            share = min(share, self.given / (FADE + 1))
        scores = (entry.found.score, entry.found.mesh_score) if entry.found else (1.0, 1.0)
        face = face_of_points(points, entry.picture.pixels.shape, *scores)
        if not _lies_in(face, entry.picture.pixels):
            return Tracked(entry.picture, None, 0.0, self.shot, self.run)
        return Tracked(entry.picture, face, share * share * (3 - 2 * share), self.shot, self.run)

    def _searched(self, pixels: np.ndarray) -> Face | None:
        """The face that is meant: while one is followed, near where it was, else as :attr:`choose` says; where none is,
        the other way round."""
        ways = (self._near, self._chosen) if self.filter is not None else (self._chosen, self._near)
        return ways[0](pixels) or ways[1](pixels)

    def _chosen(self, pixels: np.ndarray) -> Face | None:
        face = self.choose(pixels, self.last)
        return face if _lies_in(face, pixels) else None

    def _near(self, pixels: np.ndarray) -> Face | None:
        last = self.last
        if last is None:
            return None
        near = [face for face in find_faces(pixels) if _lies_in(face, pixels) and not self._jumped(face)]
        return min(near, key=lambda face: _distance(face, last), default=None)

    def _jumped(self, face: Face) -> bool:
        assert self.last is not None
        frames = self.missed if self.filter is not None else min(self.without, GAP)
        return _distance(face, self.last) > JUMP * (1 + frames)

    def _is_cut(self, pixels: np.ndarray) -> bool:
        thumb = cv2.resize(pixels, THUMB, interpolation=cv2.INTER_AREA).astype(np.float32)
        before, self.thumb = self.thumb, thumb
        if before is None:
            return False
        differs = float(np.abs(thumb - before).mean())
        usual, self.usual = self.usual, max(0.8 * self.usual + 0.2 * differs, 1.0)
        return differs > CUT and differs > SUDDEN * usual


def _distance(face: Face, before: Face) -> float:
    """How far a face has moved, in eye distances."""
    unit = float(np.hypot(*(before.landmarks[1] - before.landmarks[0])))
    return float(np.hypot(*(face.landmarks - before.landmarks).mean(0))) / unit


def _lies_in(face: Face | None, pixels: np.ndarray) -> bool:
    """Whether eyes and mouth of a face with dense points are in the picture."""
    if face is None or face.points is None:
        return False
    height, width = pixels.shape[:2]
    x, y = face.landmarks.T
    return bool(min(x.min(), y.min()) >= -0.5 and x.max() <= width - 0.5 and y.max() <= height - 0.5)
