"""What a new light does to one frame, kept so that the frames around it can take it over: on the bust, where a face
holds still whatever it does in the picture, and moved with the face's own points."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.geometry.sources import LightMixture
from facerelight.photo.bust.frame import FINE, Window, invert
from facerelight.photo.colour import SkinColour
from facerelight.photo.film.frame import FilmFrame

__all__ = ["Key", "between_keys", "make_key"]

STEP = 8  # pixels of the copy for one of the field by which places move
POINTS = 4  # every so many of the dense points move it
NEAR, DOUBT = 0.25, 0.5  # units around a point that move with it; weight of what does not move
SMALL = 4  # pixels of the copy for one of the maps of colours, which are averages over wider places


class Key(NamedTuple):
    """``log_ratio (H, W, C)`` on :data:`FINE`, ``skin`` on the frame's copy, ``exposure`` and ``change`` of the new
    light; the face's ``points (468, 2)`` in bust coordinates; the frame's ``window``."""

    log_ratio: np.ndarray
    skin: SkinColour
    exposure: float
    change: float
    points: np.ndarray
    window: Window


class Between(NamedTuple):
    """Like :class:`Key`, for a frame between two: ``log_ratio`` and ``skin`` are on its copy."""

    log_ratio: np.ndarray
    skin: SkinColour
    exposure: float
    change: float


@torch.inference_mode()
def make_key(frame: FilmFrame, light: LightMixture) -> Key:
    """What ``light`` does to a ``frame``."""
    ratio = frame._ratio(light).astype(np.float32)
    shown = frame.window.back(ratio, FINE).reshape(*frame.window.size, -1)
    exposure, change = frame.person.expose(shown)
    return Key(ratio, frame.person.skin, exposure, change, frame.bust_points, frame.window)


def between_keys(frame: FilmFrame, one: Key, two: Key, share: float) -> Between:
    """What the light does to a ``frame`` between ``one`` key (``share`` 0) and ``two`` (1)."""
    if share <= 0 or two is one:
        return _moved(frame, one)
    if share >= 1:
        return _moved(frame, two)
    a, b = _moved(frame, one), _moved(frame, two)

    def mixed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return x + np.float32(share) * (y - x)

    skin = SkinColour(*(mixed(x, y) for x, y in zip(a.skin, b.skin, strict=True)))
    exposure, change = ((1 - share) * x + share * y for x, y in zip(a[2:], b[2:], strict=True))
    return Between(mixed(a.log_ratio, b.log_ratio), skin, exposure, change)


def _moved(frame: FilmFrame, key: Key) -> Between:
    places = _places(frame, key.points)
    ratio = _seen(key.log_ratio, places, FINE.matrix()).reshape(*frame.window.size, -1)
    copy = invert(key.window.to_bust)
    small = places[::SMALL, ::SMALL]
    skin = key.skin
    where = cv2.merge([np.ascontiguousarray(part, np.float32) for part in (skin.skin, skin.lit, skin.pigment)])
    shown, lit, pigment = cv2.split(_seen(where, places, copy))
    diffuse, cast = (_seen(part.astype(np.float32), small, copy) for part in (skin.diffuse, skin.cast))
    colour = SkinColour(shown, diffuse, skin.typical, cast, lit, pigment)
    return Between(ratio, colour, key.exposure, key.change)


def _places(frame: FilmFrame, points: np.ndarray) -> np.ndarray:
    """Where on a key's bust the places of a frame's copy are, ``(h, w, 2)`` float32: in the face they move with its
    points, whose places on the key are ``points (468, 2)``."""
    height, width = frame.window.size
    matrix = frame.window.to_bust.astype(np.float32)
    x, y = frame.window.places()
    here = frame.bust_points[::POINTS].astype(np.float32)
    moves = points[::POINTS].astype(np.float32) - here
    size = max(2, round(width / STEP)), max(2, round(height / STEP))
    column = (np.arange(size[0], dtype=np.float32) + 0.5) * (width / size[0]) - 0.5
    row = (np.arange(size[1], dtype=np.float32) + 0.5) * (height / size[1]) - 0.5
    column, row = np.meshgrid(column, row)
    nodes = np.stack((column.ravel(), row.ravel()), 1) @ matrix[:, :2].T + matrix[:, 2]
    squared = np.square(nodes).sum(1)[:, None] + np.square(here).sum(1) - 2 * nodes @ here.T
    weight = np.exp(-squared / np.float32(2 * NEAR**2))
    field = (weight @ moves / (weight.sum(1, keepdims=True) + np.float32(DOUBT))).reshape(*size[::-1], 2)
    return np.dstack((x, y)).astype(np.float32) + cv2.resize(field, (width, height), interpolation=cv2.INTER_LINEAR)


def _seen(image: np.ndarray, places: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """``image`` at ``places (h, w, 2)`` in bust coordinates, which ``matrix (2, 3)`` takes to its pixels."""
    places = cv2.transform(places, matrix.astype(np.float32))
    return cv2.remap(image, places, np.empty(0, np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
