"""Faces at ease: scanned people hold still with their eyes wide open; here lids come down and mouths get a mood."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from facerelight.bootstrap.heads.head import Head

__all__ = ["Ease", "at_rest", "close_lips", "move_lids", "move_mouth"]

# On the average head, where an eye's opening is an arc of height 1 at 0.5 that ends 0.2 to either side.
HALF_WIDTH, UPPER, LOWER = 0.2, 0.083, -0.066
BROW, CHEEK = 0.27, -0.26  # where the lids' movement ends
MARKED = 1.2  # the opening's height in its middle, by that at the landmarks, a third of its width from the corners
TOUCH = 0.002  # lips whose edges are no farther apart meet
SOCKET = 0.03  # skin that deep inside an eyeball lines its socket
NEAREST = 6  # vertices of an eyeball that say how far it reaches somewhere
CLEARANCE = 0.004  # between an eyeball and the skin that slides over it


class Ease(NamedTuple):
    """How one person's face rests: ``upper``, ``lower`` lids ``(2,)`` (image-left, image-right), by which share of
    the opening they close it; the corners of the mouth ``out`` and ``up`` and the ``cheeks`` up, in eye distances."""

    upper: np.ndarray
    lower: np.ndarray
    out: float
    up: float
    cheeks: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> Ease:
        """Draw a person's: lids alike but for a little, a closed smile for one in three."""
        uneven = rng.normal(0, 0.02, 2)
        upper = (rng.uniform(0.05, 0.35) + uneven).clip(0, 0.4)
        lower = (rng.uniform(0, 0.1) + uneven / 2).clip(0, 0.15)
        smile = rng.uniform(0.5, 1.2) if rng.random() < 1 / 3 else 0.0
        return cls(upper, lower, 0.05 * smile, 0.05 * smile + rng.normal(0, 0.012), 0.03 * smile)


def at_rest(head: Head, marks: np.ndarray, rng: np.random.Generator) -> Head:
    """A head with its lids and mouth at ease.

    Args:
        head: wide awake.
        marks: ``(68,)``, vertices of the iBUG landmarks.
        rng: of this person's ease.
    """
    ease = Ease.random(rng)
    head = close_lips(move_lids(head, marks, ease.upper, ease.lower), marks)
    return move_mouth(head, marks, ease.out, ease.up, ease.cheeks)


def move_lids(head: Head, marks: np.ndarray, upper: np.ndarray, lower: np.ndarray) -> Head:
    """Bring the lids over the eyes: the skin between brow and cheek slides over the eyeball, as far above it as it was
    and never inside. Landmarks stay, and where no eyeball is, everything.

    Args:
        head: with open eyes.
        marks: ``(68,)``, vertices of the iBUG landmarks: 36 to 41 and 42 to 47 are the lids.
        upper, lower: ``(2,)``, image-left and image-right: the share of the opening by which that lid closes it.
    """
    vertices = np.array(head.vertices, np.float64)
    for side, first, down, up in zip((-1, 1), (36, 42), upper, lower, strict=True):
        mark = head.vertices[marks[first : first + 6], 1]  # corner, two above, corner, two below
        opening = MARKED * (mark[1:3].mean() - mark[4:6].mean())
        share = _closing(head.reference * (side, 1, 1), down, up) * (head.is_eye < 0.5)
        moved = np.flatnonzero(np.abs(share * opening) > 1e-5)
        ball = head.vertices[(head.is_eye > 0.5) & (side * head.reference[:, 0] > 0)]
        if len(moved) == 0 or len(ball) < NEAREST:
            continue
        centre, radius = _sphere(ball)
        ball = ball - centre
        before = head.vertices[moved] - centre
        reach_before, ground_before = np.linalg.norm(before, axis=1), _ground(ball, before)
        height = reach_before - ground_before
        skin = _rise(height / SOCKET + 1)  # what lines the socket stays in it
        angle = skin * share[moved] * opening / radius  # about the axis from ear to ear
        cosine, sine = np.cos(angle), np.sin(angle)
        after = np.stack(
            (before[:, 0], cosine * before[:, 1] + sine * before[:, 2], cosine * before[:, 2] - sine * before[:, 1]), 1
        )
        ground = _ground(ball, after)
        fade = np.exp(-((reach_before / ground_before - 1).clip(0) / 0.4))  # far skin feels the eyeball's bulge less
        reach = reach_before + fade * (ground - ground_before)
        firm = (np.abs(angle) / 0.02).clip(0, 1)  # where nothing moves nothing is mended
        reach += firm * (ground + CLEARANCE - reach).clip(0)
        after *= (reach / np.linalg.norm(after, axis=1))[:, None]
        vertices[moved] = centre + after
    return head._replace(vertices=vertices)


def close_lips(head: Head, marks: np.ndarray) -> Head:
    """Bring lips together that are apart, each half of the way; landmarks stay.

    Args:
        head: with a mouth that may be open by a chink.
        marks: ``(68,)``, vertices of the iBUG landmarks: 60 to 67 are the edges where the lips meet.
    """
    upper, lower = marks[60:65], marks[[60, 67, 66, 65, 64]]  # from corner to corner
    between = (head.reference[upper] + head.reference[lower]).astype(np.float64) / 2
    wide = float(np.ptp(between[:, 0])) / 2
    if wide == 0:
        return head
    gap = (head.vertices[upper] - head.vertices[lower])[:, 1]
    x, y, z = head.reference.astype(np.float64).T
    order = np.argsort(between[:, 0])
    line, apart = (np.interp(x, between[order, 0], values[order]) for values in (between[:, 1], gap))
    near = _hill(((y - line) / 0.07) ** 2) * _rise((wide - np.abs(x)) / (0.2 * wide)) * _rise((z + 0.3) / 0.3)
    vertices = np.array(head.vertices, np.float64)
    vertices[:, 1] -= np.maximum(apart - TOUCH, 0) / 2 * near * np.tanh((y - line) / 0.003)
    return head._replace(vertices=vertices)


def move_mouth(head: Head, marks: np.ndarray, out: float, up: float, cheeks: float) -> Head:
    """Move the corners of a closed mouth, which stays closed, and the cheeks; the mouth's landmark follows.

    Args:
        head: with a neutral mouth.
        marks: ``(68,)``, vertices of the iBUG landmarks: 48 and 54 are the corners, 60 to 67 where the lips meet.
        out, up: how far the corners go, in eye distances.
        cheeks: how far the cheeks rise.
    """
    corners = head.reference[marks[[48, 54]]]
    wide = float(np.ptp(corners[:, 0])) / 2
    if wide == 0:
        return head
    x, y, z = head.reference.astype(np.float64).T
    side, level = np.abs(x), float(corners[:, 1].mean())
    skin = (head.is_eye < 0.5) * _rise((z + 0.6) / 0.4)
    corner = _hill(((side - wide) / 0.16) ** 2 + ((y - level) / 0.17) ** 2) * skin
    cheek = _hill(((side - 0.62) / 0.2) ** 2 + ((y + 0.58) / 0.2) ** 2) * skin
    aside = np.tanh(x / 0.1)
    move = corner[:, None] * np.stack((out * aside, np.full_like(x, up), np.full_like(x, -0.4 * out)), 1)
    move += cheek[:, None] * np.stack((0.3 * cheeks * aside, np.full_like(x, cheeks), np.full_like(x, cheeks)), 1)
    landmarks = head.landmarks.copy()
    landmarks[2] += move[marks[60:68]].mean(0)
    return head._replace(vertices=head.vertices + move, landmarks=landmarks)


def _closing(reference: np.ndarray, down: float, up: float) -> np.ndarray:
    """By which share of the opening each vertex of an eye at (0.5, 0) moves up, ``(V,)``."""
    x, y, z = reference.astype(np.float64).T
    arc = (1 - ((x - 0.5) / HALF_WIDTH) ** 2).clip(0)
    above, below = UPPER * arc, LOWER * arc
    middle = (above + below) / 2
    lid = np.where(y > middle, (y - middle) / (above - middle + 1e-9), (middle - y) / (middle - below + 1e-9))
    fall = np.where(y > middle, (BROW - y) / (BROW - above), (y - CHEEK) / (below - CHEEK))
    front = _rise((z + 0.25) / 0.15)  # what is behind the eyeball stays
    weight = np.minimum(_rise(lid), _rise(fall)) * arc**1.5 * front
    return np.where(y > middle, -down, up) * weight


def _sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere through points ``(N, 3)``, least squares."""
    rows = np.concatenate((2 * points, np.ones((len(points), 1))), 1)
    *centre, rest = np.linalg.lstsq(rows, (points**2).sum(1), rcond=None)[0]
    return np.array(centre), float(np.sqrt(rest + np.square(centre).sum()))


def _ground(ball: np.ndarray, points: np.ndarray) -> np.ndarray:
    """How far the eyeball reaches towards points ``(N, 3)``; both as seen from its centre."""
    reach = np.linalg.norm(ball, axis=1)
    distance, near = cKDTree(ball / reach[:, None]).query(points / np.linalg.norm(points, axis=1)[:, None], NEAREST)
    weight = np.exp(-0.5 * (distance / (distance[:, :3].mean(1, keepdims=True) + 1e-9)) ** 2)
    return (weight * reach[near]).sum(1) / weight.sum(1)


def _hill(x: np.ndarray) -> np.ndarray:
    """A bell over its squared distance: within a hundredth of a Gaussian's, and 0 from three deviations on."""
    return (1 - x / 9).clip(0) ** 4.5


def _rise(x: np.ndarray) -> np.ndarray:
    """From 0 at 0 to 1 at 1, level at both ends."""
    x = x.clip(0, 1)
    return x * x * (3 - 2 * x)
