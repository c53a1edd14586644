"""How a head is turned, and where the model's landmarks lie: the dense points as views of a rigid mean face."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from facerelight.photo import networks

__all__ = ["CanonicalFace", "HeadPose", "RigidFit", "canonical_face", "fit_rigid_face", "model_landmarks"]

RIGHT_EYE = (
    33,
    7,
    163,
    144,
    145,
    153,
    154,
    155,
    133,
    173,
    157,
    158,
    159,
    160,
    161,
    246,
)  # the person's right, at image-left
LEFT_EYE = (263, 249, 390, 373, 374, 380, 381, 382, 362, 398, 384, 385, 386, 387, 388, 466)
LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
INNER_LIPS = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
FEATURES = (RIGHT_EYE, LEFT_EYE, LIPS + INNER_LIPS)
YAW_SHARE = 0.5  # of the yaw, in placing the landmarks
STEPS = 6  # of Gauss-Newton; three change nothing more below 60 degrees
UP = np.array((1.0, -1.0))  # pixels count downwards


class HeadPose(NamedTuple):
    """Degrees. ``yaw`` > 0: turned towards image-left; ``pitch`` > 0: looks up; ``roll`` > 0: tilted clockwise in the
    picture. The head of zero pitch is MakeHuman's; people who face the camera have about 0 to 10."""

    yaw: float
    pitch: float
    roll: float

    @property
    def rotation(self) -> np.ndarray:
        """The rotation ``(3, 3)`` by yaw, then pitch, then roll; x to image-right, y up, z to the viewer.

        Example:
            >>> HeadPose(90.0, 0.0, 0.0).rotation.round()[:, 2].tolist()  # the nose points to image-left
            [-1.0, 0.0, 0.0]
        """
        (cy, cp, cr), (sy, sp, sr) = (f(np.deg2rad(self)) for f in (np.cos, np.sin))
        yaw = np.array(((cy, 0, -sy), (0, 1, 0), (sy, 0, cy)))
        pitch = np.array(((1, 0, 0), (0, cp, sp), (0, -sp, cp)))
        roll = np.array(((cr, sr, 0), (-sr, cr, 0), (0, 0, 1)))
        return roll @ pitch @ yaw


class CanonicalFace(NamedTuple):
    """The mean of many rendered heads: x to image-right, y up, z to the viewer, the origin midway between the eyes,
    which are one unit apart.

    ``points (468, 3)`` of the mesh; ``landmarks (3, 3)``, what the model's crops call eyes and mouth (centres of the
    eyeballs and of the lips); ``mirror (468,)``, the number of every point's mirror image.
    """

    points: np.ndarray
    landmarks: np.ndarray
    mirror: np.ndarray


class RigidFit(NamedTuple):
    """``scale`` pixels an eye distance, ``rotation (3, 3)``, ``shift (2,)`` pixels, and ``error``, the rms residual in
    eye distances."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray
    error: float

    @property
    def pose(self) -> HeadPose:
        """The angles: first turned by yaw, then by pitch, then by roll."""
        r = self.rotation
        yaw, pitch = np.arctan2(r[2, 0], r[2, 2]), np.arcsin(np.clip(-r[2, 1], -1, 1))
        return HeadPose(*(float(v) for v in np.rad2deg((yaw, pitch, np.arctan2(r[0, 1], r[1, 1])))))

    def project(self, points: np.ndarray) -> np.ndarray:
        """Canonical points ``(N, 3)`` in the photo's pixels, ``(N, 2)``."""
        return self.scale * (points @ self.rotation.T)[:, :2] * UP + self.shift


@lru_cache(maxsize=1)
def canonical_face() -> CanonicalFace:
    """The packed mean face; ``scripts/measure/landmarks.py`` measures it.

    Example:
        >>> canonical_face().points.shape
        (468, 3)
    """
    with np.load(Path(networks.__file__).parent / "canonical_face.npz", allow_pickle=False) as data:
        points, landmarks = data["points"].astype(np.float64), data["landmarks"].astype(np.float64)
        return CanonicalFace(points, landmarks, data["mirror"].astype(np.intp))


def fit_rigid_face(points: np.ndarray) -> RigidFit:
    """The least-squares scaled orthographic view of the canonical face: affine first, then Gauss-Newton.

    The network's depth is not used: its scale depends on the pose, and the mean face's does not.

    Args:
        points: ``(468, 3)`` or ``(468, 2)`` pixels.
    """
    model, seen = canonical_face().points, points[:, :2] * UP
    middle, centre = model.mean(0), seen.mean(0)
    model, seen = model - middle, seen - centre
    affine = np.linalg.lstsq(model, seen, rcond=None)[0].T
    u, d, vt = np.linalg.svd(affine, full_matrices=False)
    rows, scale = u @ vt, float(d.mean())
    rotation = np.vstack((rows, np.cross(*rows)))
    for _ in range(STEPS):
        x, y, z = scale * rotation @ model.T
        zero = np.zeros_like(x)
        by_x, by_y = np.stack((zero, z, -y, x), 1), np.stack((-z, zero, x, y), 1)
        missing = np.concatenate((seen[:, 0] - x, seen[:, 1] - y))
        step = np.linalg.lstsq(np.concatenate((by_x, by_y)), missing, rcond=None)[0]
        rotation, scale = _turn(step[:3]) @ rotation, scale * float(np.exp(np.clip(step[3], -1, 1)))
    residual = seen - scale * (model @ rotation.T)[:, :2]
    shift = (centre - scale * (rotation @ middle)[:2]) * UP
    return RigidFit(scale, rotation, shift, float(np.sqrt((residual**2).sum(1).mean())) / max(scale, 1e-9))


def model_landmarks(points: np.ndarray, fit: RigidFit) -> np.ndarray:
    """Eye at image-left, eye at image-right and mouth as the model's crops mean them, ``(3, 2)`` pixels.

    The dense points lie on the lids, the model's eyes are the centres of the eyeballs, 0.2 eye distances behind. Their
    mean distances, those in the canonical face, are turned with the head and added. Shadows make the yaw uncertain, and
    it would move the eyes but not the mouth: half of it counts.
    """
    canonical = canonical_face()
    found = np.stack([points[list(part), :2].mean(0) for part in FEATURES])
    offset = canonical.landmarks - np.stack([canonical.points[list(part)].mean(0) for part in FEATURES])
    pose = fit.pose
    rotation = pose._replace(yaw=YAW_SHARE * pose.yaw).rotation
    return found + fit.scale * (offset @ rotation.T)[:, :2] * UP


def _turn(vector: np.ndarray) -> np.ndarray:
    """The rotation by ``|vector|`` radians about ``vector`` (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array(((0, -z, y), (z, 0, -x), (-y, x, 0)))
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
