"""How a head stands before the camera: turned about its middle, and placed in the crop."""

from __future__ import annotations

import numpy as np

from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.heads import Head
from facerelight.geometry.alignment import CropFrame

__all__ = ["PIVOT", "place_in_frame", "rotate", "stand"]

PIVOT = np.array((0.0, -0.3, -0.8))  # the middle of a head: turned about it, the face stays in the crop
EYE_RADIUS = 0.24  # an eyeball's
FOLLOW = np.array((1.0, 0.3))  # how far eyes turn back, past their lids, aside and up: lids go up and down with them


def rotate(head: Head, azimuth: float, elevation: float) -> Head:
    """Turn a head about its middle as if the camera moved (degrees): positive azimuth shows what lies at image-left."""
    if not (abs(azimuth) <= 90 and abs(elevation) <= 60):
        raise ValueError(
            f"pose: expected azimuth within 90 and elevation within 60 degrees, got {azimuth} and {elevation}"
        )
    turn = _turn(azimuth, elevation)
    return head._replace(
        vertices=(head.vertices - PIVOT) @ turn.T + PIVOT, landmarks=(head.landmarks - PIVOT) @ turn.T + PIVOT
    )


def _turn(azimuth: float, elevation: float) -> np.ndarray:
    a, e = np.deg2rad((azimuth, elevation))
    about_y = np.array(((np.cos(a), 0, np.sin(a)), (0, 1, 0), (-np.sin(a), 0, np.cos(a))))
    about_x = np.array(((1, 0, 0), (0, np.cos(e), np.sin(e)), (0, -np.sin(e), np.cos(e)))).T
    return about_x @ about_y


def stand(head: Head, rng: np.random.Generator, domain: Domain) -> Head:
    """How a person happens to stand before the camera: the head up and turned a little, the eyes on the camera, the
    landmarks marked a little off."""
    aside, up = domain.turn * rng.standard_normal(2).clip(-2, 2)
    marked = domain.misalign * rng.standard_normal((3, 3)) * (1, 1, 0)
    turned = rotate(head, aside, up - domain.pitch)
    camera = EYE_RADIUS * FOLLOW * _turn(aside, up - domain.pitch)[2, :2]  # as the head sees it
    reference = np.array(head.reference)
    reference[head.is_eye > 0.5, :2] -= camera  # an eye that turns carries its paint along
    return turned._replace(reference=reference, landmarks=turned.landmarks + marked)


def place_in_frame(head: Head, frame: CropFrame, landmarks: np.ndarray | None = None) -> Head:
    """Scale and shift a head so that its landmarks fall, least squares, on the crop's; one unit is then one pixel,
    origin the crop's centre.

    Args:
        head: as a source gives it, or turned.
        frame: the crop.
        landmarks: place these ``(3, 3)`` instead of the head's own (a turned head is placed by its upright landmarks).
    """
    target = (frame.landmarks.numpy() - ((frame.width - 1) / 2, (frame.height - 1) / 2)) * (1, -1)
    points = (head.landmarks if landmarks is None else landmarks)[:, :2]
    a, b = points - points.mean(0), target - target.mean(0)
    scale = float((a * b).sum() / (a**2).sum())  # upright by construction: no turn in the plane
    shift = np.append(target.mean(0) - scale * points.mean(0), 0.0)
    return head._replace(vertices=scale * head.vertices + shift, landmarks=scale * head.landmarks + shift)
