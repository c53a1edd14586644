"""The shape of a bust, as far as light needs it: a mean bust turned and warped to the face, a neck, shoulders, and hair
inflated from the matte.

Nothing of a person's shape outside the face is known from one photograph, but much can be guessed well enough for
shading: where the matte ends the surface turns away, the mean bust knows ears and jaw, necks are round. Normals between
what is known are interpolated harmonically (Johnston, "Lumo", 2002); heights, which cast the shadows, are the highest
of head, neck, torso and inflated hair.
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files
from typing import NamedTuple

import cv2
import numpy as np

from facerelight.photo.bust.frame import BUST, FINE, between
from facerelight.photo.bust.mesh import draw_mesh, harmonic, unit_vectors
from facerelight.photo.faces.head_pose import fit_rigid_face

__all__ = ["Bust", "MeanBust", "fit_bust", "head_rotation", "make_bust", "mean_bust"]

BELOW = -6.0  # height of what is not the person
WARP_REACH = 0.6  # units over which the face's own proportions move the mean bust
POINT_STEP = 3  # the points are so dense that every third will do
NEAR_FACE = (-1.5, 1.5, -2.7, 1.4)  # x from, x to, y from, y to, in units: what is drawn finely
WARP_DOUBT = 0.5  # of a point's weight: far from all points the head stays where its pose puts it
THROAT = np.array((0.0, -1.6, -0.9))  # about which a head turns on its body
NECK = (-1.5, -2.8)  # between these heights the head goes over into the body
BODY_FROM, BODY_EDGE = (
    -1.75,
    0.25,
)  # below the first height, and so far inside the outline, the mean body's normals are taken
OVAL = 0.92  # of the face's outline: inside it the mean head's normals are taken
BODY_BLUR, FACE_BLUR = 0.12, 0.05  # of normals, in units: clothes and hair follow a body only roughly
HAIR_ENDS, HAIR_SINKS = (
    (-0.6, -2.4),
    -1.2,
)  # below the first height hair lies closer to the body, below the second on it
CLOTHES_BLUR = 0.15  # of heights, in units: no hard shadow falls where only the matte tells of a surface
SHOULDERS = 2.0  # units to each side, as far as the mean body serves
FEATURE_BLUR = 0.018  # of normals at eyes and lips, in units: they open and close
FEATURES = (((-0.5, 0.0, 0.0), (0.36, 0.22)), ((0.5, 0.0, 0.0), (0.36, 0.22)), ((0.0, -1.17, 0.4), (0.5, 0.24)))
"""Places on the mean bust, and how far eyes and lips reach across and up, in units."""


class MeanBust(NamedTuple):
    """``vertices (V, 3)``, ``triangles (T, 3)``; ``points (468, 3)`` of the face mesh on its surface. Bust coordinates
    with z towards the viewer."""

    vertices: np.ndarray
    triangles: np.ndarray
    points: np.ndarray


class Bust(NamedTuple):
    """Surface of a person on :data:`BUST`: ``normal (H, W, 3)`` unit, ``height (H, W)``, ``inside (H, W)`` 0 to 1; on
    :data:`FINE`: ``fine (h, w)`` heights and ``fine_normal (h, w, 3)``, of face and neck the mean bust's own."""

    normal: np.ndarray
    height: np.ndarray
    inside: np.ndarray
    fine: np.ndarray
    fine_normal: np.ndarray


@lru_cache(maxsize=1)
def mean_bust() -> MeanBust:
    """The mean of rendered heads (CC0), packed by ``scripts/data/pack_mean_bust.py``; read once a process."""
    with (
        files("facerelight.photo.bust").joinpath("mean_bust.npz").open("rb") as file,
        np.load(file, allow_pickle=False) as data,
    ):
        vertices, points = (data[name].astype(np.float64) for name in ("vertices", "points"))
        return MeanBust(vertices, data["triangles"].astype(np.int64), points)


def fit_bust(points: np.ndarray | None, down: tuple[float, float] = (0.0, -1.0)) -> np.ndarray:
    """Vertices ``(V, 3)`` of the mean bust, its head turned and warped to a face's dense ``points``, its body upright.

    Scale and place are least squares in the picture; what is left moves the surface nearby, each point with a Gaussian
    weight.

    Args:
        points: ``(468, 3)`` in bust coordinates; None: the head looks straight ahead.
        down: which way the body hangs, a unit vector of the bust's x and y.
    """
    bust = mean_bust()
    upright = np.array(((-down[1], down[0], 0), (-down[0], -down[1], 0), (0, 0, 1.0)))
    if points is None:
        return bust.vertices
    rotation = head_rotation(points)
    turned = bust.points @ rotation.T
    a, b = turned[:, :2] - turned[:, :2].mean(0), points[:, :2] - points[:, :2].mean(0)
    scale = float((a * b).sum() / np.square(a).sum())
    shift = np.append(points[:, :2].mean(0) - scale * turned[:, :2].mean(0), 0.0)
    head = scale * bust.vertices @ rotation.T + shift
    throat = scale * rotation @ THROAT + shift
    body = scale * (bust.vertices - THROAT) @ upright.T + throat
    of_body = np.clip((NECK[0] - bust.vertices[:, 1:2]) / (NECK[0] - NECK[1]), 0, 1)
    vertices = (1 - of_body) * head + of_body * body
    marked = scale * turned + shift
    near = bust.vertices[:, 1] > NECK[1]
    few, moves = marked[::POINT_STEP].astype(np.float32), (points - marked)[::POINT_STEP, :2]
    here = vertices[near].astype(np.float32)
    squared = np.square(here).sum(1)[:, None] + np.square(few).sum(1) - 2 * here @ few.T  # (V', P)
    weight = np.exp(-squared / np.float32(2 * WARP_REACH**2))
    vertices[near, :2] += weight @ moves / (weight.sum(1, keepdims=True) + WARP_DOUBT / POINT_STEP)
    return vertices


def head_rotation(points: np.ndarray) -> np.ndarray:
    """How a head is turned, as a rotation ``(3, 3)`` of bust coordinates, from a face's dense ``points (468, 3)`` in
    them."""
    return fit_rigid_face(points[:, :2] * (1, -1)).rotation


def make_bust(
    matte: np.ndarray, in_picture: np.ndarray, vertices: np.ndarray, down: tuple[float, float] = (0.0, -1.0)
) -> Bust:
    """The surface of a person.

    Args:
        matte: ``(H, W)`` on :data:`BUST`, 0 to 1.
        in_picture: ``(H, W)`` bool, where the photograph has pixels.
        vertices: ``(V, 3)`` of :func:`fit_bust`.
        down: the direction in which the neck leaves the head, a unit vector of the bust's x and y.
    """
    x, y = BUST.places()
    low = -1.0 - (x * down[0] + (y + 1.0) * down[1])  # along the neck, which leaves the head below the eyes; upright: y
    aside = (y + 1.0) * down[0] - x * down[1]  # across it; upright: x
    z, normal, seen = draw_mesh(vertices, mean_bust().triangles, BUST)
    seen &= (low > -1.5) | (np.abs(aside) < SHOULDERS)  # the mean body stretches its arms out
    person = matte > 0.5
    oval = np.hypot(x, (y + 0.42) / 1.42)
    rim, outward = _silhouette(matte, person, in_picture)
    from_edge = cv2.distanceTransform(person.astype(np.uint8), cv2.DIST_L2, 5) / BUST.density
    face = seen & (oval < OVAL) & (normal[..., 2] > 0.2)
    body = seen & person & (low < BODY_FROM) & (from_edge > BODY_EDGE) & (normal[..., 2] > 0.2) & ~face
    known = np.zeros_like(normal)
    known[rim] = outward[rim]
    known[face | body] = normal[face | body]
    field = harmonic(known, rim | face | body, person | face)
    field[..., 2] = np.maximum(field[..., 2], 0.02)
    field = unit_vectors(field).astype(np.float32)
    sharp, smooth = (
        cv2.GaussianBlur(field, (0, 0), sigma) for sigma in (FACE_BLUR * BUST.density, BODY_BLUR * BUST.density)
    )
    share = cv2.GaussianBlur(face.astype(np.float32), (0, 0), 2.0)[..., None]
    smooth = unit_vectors(share * sharp + (1 - share) * smooth)
    inflated = np.sqrt(np.clip(1.2**2 - (1.2 - np.minimum(from_edge, 1.2)) ** 2, 0, None))
    hair = -1.2 + inflated + HAIR_SINKS * np.clip((HAIR_ENDS[0] - low) / (HAIR_ENDS[0] - HAIR_ENDS[1]), 0, 1)
    torso = -1.6 + np.sqrt(np.minimum(from_edge, 0.8)) * np.clip(-0.5 * low - 0.6, 0, 1)
    rough = np.maximum(np.where(seen, z, BELOW), np.maximum(hair, np.where(low < -2.0, torso, BELOW)))
    share = cv2.GaussianBlur((face | (seen & (np.abs(x) < 1.3) & (low > -2.4))).astype(np.float32), (0, 0), 3.0)
    level = _blur_inside(rough.astype(np.float32), person, CLOTHES_BLUR * BUST.density)
    height = np.where(person | face, share * rough + (1 - share) * level, BELOW).astype(np.float32)
    return Bust(
        smooth,
        height,
        person.astype(np.float32),
        *_fine_surface(vertices, height, person, smooth, face),
    )


def _blur_inside(image: np.ndarray, inside: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur that looks at ``inside`` alone."""
    weight = inside.astype(np.float32)
    return cv2.GaussianBlur(image * weight, (0, 0), sigma) / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-3)


def _fine_surface(
    vertices: np.ndarray, height: np.ndarray, person: np.ndarray, normal: np.ndarray, face: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Heights and normals on :data:`FINE`: the mesh's own where it is the highest, those of the bust elsewhere."""
    z, own, seen = draw_mesh(vertices, mean_bust().triangles, FINE, NEAR_FACE)
    x, y = FINE.places()
    inside = between(person.astype(np.float32), BUST, FINE) > 0.5
    coarse = between(np.maximum(height, -3), BUST, FINE)
    of_head = (seen & inside & (np.hypot(x / 1.3, (y + 0.6) / 1.8) < 1)).astype(np.float32)
    sharp = cv2.GaussianBlur(of_head, (0, 0), 4.0)
    surface = np.maximum(sharp * np.where(seen, z, coarse) + (1 - sharp) * coarse, coarse)
    pit = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    closed: np.ndarray = cv2.morphologyEx(surface.astype(np.float32), cv2.MORPH_CLOSE, pit)  # no pits at eyes and mouth
    heights = np.where(inside, cv2.GaussianBlur(closed, (0, 0), 0.4), BELOW).astype(np.float32)
    sure = cv2.GaussianBlur(cv2.erode(face.astype(np.float32), np.ones((5, 5))), (0, 0), 2.0)
    share = (between(sure, BUST, FINE) * seen)[..., None]
    own, features = cv2.GaussianBlur(own.astype(np.float32), (0, 0), 0.6), _features(vertices)[..., None]
    own = features * cv2.GaussianBlur(own, (0, 0), FEATURE_BLUR * FINE.density) + (1 - features) * own
    return heights, unit_vectors(share * own + (1 - share) * between(normal, BUST, FINE)).astype(np.float32)


def _features(vertices: np.ndarray) -> np.ndarray:
    """Where the mesh has eyes and lips, 0 to 1 on :data:`FINE`: they open and close, and a person's are not the
    mean's."""
    x, y = FINE.places()
    mask = np.zeros(FINE.size, np.float32)
    for place, (across, up) in FEATURES:
        near = np.square(mean_bust().vertices - place).sum(1).argsort()[:40]
        middle = vertices[near, :2].mean(0)
        mask = np.maximum(mask, np.clip(3 - 2.5 * np.hypot((x - middle[0]) / across, (y - middle[1]) / up), 0, 1))
    return mask


def _silhouette(matte: np.ndarray, person: np.ndarray, in_picture: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the person ends inside the photograph, ``(H, W)`` bool, and the normals there, which turn away ``(H, W,
    3)``."""
    smooth = cv2.GaussianBlur(matte.astype(np.float32), (0, 0), 2.0)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = np.hypot(dx, dy)
    inner = cv2.erode(in_picture.astype(np.uint8), np.ones((7, 7))) > 0
    rim = person & ~(cv2.erode(person.astype(np.uint8), np.ones((3, 3))) > 0) & inner & (slope > 1e-4)
    return rim, unit_vectors(np.stack((-dx, dy, 0.35 * slope), -1))
