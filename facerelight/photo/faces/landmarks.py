"""The faces of a photograph: where they are, their dense points, their pose, and the landmarks that align crops.

YuNet says where a face may be, the Face Mesh fits 468 points there, and a rigid mean face tells whether they make a
face, how it is turned and where the model's landmarks lie. More copies of the photograph are searched only where the
first ones show nothing clear.
"""

from __future__ import annotations

import warnings
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.photo.faces.copies import brighten, even_out, shrink
from facerelight.photo.faces.detector import Candidate, detect_faces, merge_candidates
from facerelight.photo.faces.face_mesh import fit_face_mesh
from facerelight.photo.faces.haar import haar_landmarks
from facerelight.photo.faces.head_pose import HeadPose, RigidFit, canonical_face, fit_rigid_face, model_landmarks

__all__ = [
    "Face",
    "HeadPose",
    "LandmarksNotFoundError",
    "face_at",
    "face_of_points",
    "find_faces",
    "find_landmarks",
    "follow_face",
]

Box = tuple[float, float, float, float]  # x0, y0, x1, y1
Detector = Literal["auto", "haar", "yunet"]
FIRST_SIDE = 448  # pixels of the copy that is searched first
MORE_SIDES = (192, 1280)  # for faces that fill the picture, and for small ones
TURNS = (45.0, -45.0, 90.0, -90.0, 180.0)  # degrees, tried last
SMALL = 25.0  # pixels of the first copy: where the faces are smaller there may be more that it does not show
TOUCH = 0.04  # of a face's size that may lie outside the picture
COVERED = 0.4  # of the smaller of two boxes: they are of one face
CASCADE_SIDE = 1024


class Limits(NamedTuple):
    """What makes a face: least scores of the detector and of the mesh, the largest residual of the rigid face, and the
    largest distance between the landmarks of detector and mesh; the last two in eye distances."""

    score: float
    mesh: float
    error: float
    apart: float


PLAUSIBLE = Limits(0.6, 0.6, 0.16, 0.9)
FAINT = Limits(0.3, 0.98, 0.16, 0.9)  # what the detector hardly sees, the mesh must be sure of
# Upright faces have mesh scores above 0.9999, the same faces upside down less; what is no face has less than 0.05.
CLEAR = Limits(0.6, 0.9999, 0.14, 0.9)
FOLLOWED = Limits(0.0, 0.9, 0.16, 0.9)  # a face that was there a moment ago


class LandmarksNotFoundError(RuntimeError):
    """No face, or not both eyes, could be found."""


class Face(NamedTuple):
    """One face of a photograph; pixels (x, y) of the photo, the centre of the top-left pixel at (0, 0).

    ``landmarks (3, 2)`` float64: eye centre at image-left, eye centre at image-right (of the upright face) and mouth
    centre, as the model's crops mean them; ``points (468, 3)`` of the face mesh, z in the same unit and away from the
    viewer, None where its network could not be used; ``box``, x0, y0, x1, y1 of the points, which may reach out of the
    picture; ``score`` of the detector, 1 for landmarks given by hand, 0 for the cascades; ``pose``, None like the
    points; ``whole``, whether the face lies inside the picture; ``mesh_score``, the mesh network's probability that a
    face is there.
    """

    landmarks: np.ndarray
    points: np.ndarray | None
    box: Box
    score: float
    pose: HeadPose | None
    whole: bool
    mesh_score: float

    @property
    def size(self) -> float:
        """The longer side of the box, in pixels."""
        return max(self.box[2] - self.box[0], self.box[3] - self.box[1])


class _Fitted(NamedTuple):
    candidate: Candidate
    face: Face
    error: float
    apart: float

    def within(self, limits: Limits) -> bool:
        scores = self.candidate.score >= limits.score and self.face.mesh_score >= limits.mesh
        return scores and self.error <= limits.error and self.apart <= limits.apart


def find_faces(photo: np.ndarray) -> list[Face]:
    """All faces that are found, whole ones first, then the larger ones first; an empty list where there is none.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB of any size; faces may be tilted or upside down.

    Raises:
        ValueError: a photo of another kind.

    Where a network of the package cannot be read, a ``RuntimeWarning`` says so and Haar cascades search upright faces
    instead.

    Example:
        >>> find_faces(np.full((64, 64, 3), 128, np.uint8))
        []
    """
    _check_photo(photo)
    try:
        found = _search(photo)
    except RuntimeError as error:
        warnings.warn(f"faces: a network cannot be used ({error}); Haar cascades instead", RuntimeWarning, stacklevel=2)
        found = _cascade_faces(photo)
    return _ordered(found)


def find_landmarks(photo: np.ndarray, detector: Detector = "auto") -> Tensor:
    """Eye centre at image-left, eye centre at image-right and mouth centre of the best face, the largest whole one.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        detector: "auto": :func:`find_faces`; "yunet": the same, and an error where a network cannot be read; "haar":
            the cascades alone.

    Returns:
        ``(3, 2)`` float64 pixels (x, y).

    Raises:
        LandmarksNotFoundError: nothing was found; give the landmarks by hand.
        ValueError: an unknown detector, or a photo of another kind.
    """
    if detector not in ("auto", "haar", "yunet"):
        raise ValueError(f"detector: expected 'auto', 'haar' or 'yunet', got {detector!r}")
    _check_photo(photo)
    if detector == "auto":
        faces = find_faces(photo)
    else:
        faces = _cascade_faces(photo) if detector == "haar" else _search(photo)
        faces = _ordered(faces)
    if not faces:
        by_hand = "eye at image-left, eye at image-right, mouth, as x,y pixels"
        raise LandmarksNotFoundError(f"landmarks: found no face; give them by hand: {by_hand}")
    return torch.from_numpy(faces[0].landmarks)


def face_at(photo: np.ndarray, landmarks: np.ndarray | Tensor) -> Face:
    """The face at landmarks that were given by hand, with dense points and pose; the landmarks stay as given.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        landmarks: ``(3, 2)`` pixels: eye at image-left of the upright face, the other eye, mouth.

    Raises:
        ValueError: landmarks of another shape, not finite, or with both eyes in one place.
    """
    _check_photo(photo)
    given = np.array(landmarks, np.float64)
    if given.shape != (3, 2) or not np.isfinite(given).all():
        raise ValueError(f"landmarks: expected three finite (x, y) pairs, got {given.tolist()}")
    if np.hypot(*(given[1] - given[0])) < 1e-3:
        raise ValueError(f"landmarks: expected two different eyes, got both at {given[0].tolist()}")
    try:
        fitted = _fit(photo, Candidate(given[[0, 1, 2, 2, 2]], 1.0))
    except RuntimeError as error:
        warnings.warn(f"face: no dense points ({error})", RuntimeWarning, stacklevel=2)
        return _bare_face(photo, given)
    return fitted.face._replace(landmarks=given)


def follow_face(photo: np.ndarray, before: Face) -> Face | None:
    """The face of a film's earlier picture in the next one, without a search; None where it is not there.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB.
        before: found in the earlier picture, which has to be of the same size.
    """
    fitted = _fit_upright(photo, Candidate(before.landmarks[[0, 1, 2, 2, 2]], before.score))
    return fitted.face if fitted.within(FOLLOWED) else None


def face_of_points(points: np.ndarray, shape: tuple[int, ...], score: float, mesh_score: float) -> Face:
    """The face of dense ``points (468, 3)`` in a photograph of ``shape (H, W, ...)``."""
    fit, box = fit_rigid_face(points), _box(points)
    return Face(model_landmarks(points, fit), points, box, score, fit.pose, _inside(box, shape), mesh_score)


def _search(photo: np.ndarray) -> list[Face]:
    """Faces by the networks; more copies are searched only where the first ones show no clear face, or small ones."""
    height, width = photo.shape[:2]
    base = brighten(shrink(photo, MORE_SIDES[-1]))
    factor = np.array((width / base.shape[1], height / base.shape[0]))
    candidates: list[Candidate] = []
    known: dict[int, _Fitted] = {}  # by the candidate's identity: nothing is fitted twice

    def clear(*copies: tuple[int, float], picture: np.ndarray = base) -> list[_Fitted]:
        nonlocal candidates, known
        for side, turn in copies:
            found = detect_faces(picture, side, turn, FAINT.score)
            candidates = candidates + [Candidate((one.points + 0.5) * factor - 0.5, one.score) for one in found]
        candidates = merge_candidates(candidates)
        known = {id(one): known.get(id(one)) or _fit(photo, one) for one in candidates}
        return [one for one in known.values() if one.within(CLEAR)]

    found = clear((FIRST_SIDE, 0.0))
    largest = max((one.candidate.size for one in found), default=0.0) * min(1.0, FIRST_SIDE / max(photo.shape[:2]))
    if largest < SMALL:
        larger = max(base.shape[:2]) > 1.3 * FIRST_SIDE
        found = clear(*((side, 0.0) for side in MORE_SIDES if side < FIRST_SIDE or larger))
    if not found:
        found = clear((FIRST_SIDE, 0.0), picture=even_out(base))
    upright = {id(one) for one in candidates}
    if not found:
        clear(*((FIRST_SIDE, turn) for turn in TURNS))
    limits = {key: (PLAUSIBLE, FAINT) if key in upright else (CLEAR,) for key in known}
    return _distinct([one.face for key, one in known.items() if any(map(one.within, limits[key]))])


def _ordered(faces: list[Face]) -> list[Face]:
    return sorted(faces, key=lambda face: (not face.whole, -face.size))


def _distinct(faces: list[Face]) -> list[Face]:
    """Of those that cover each other, the surest."""
    kept: list[Face] = []
    for face in sorted(faces, key=lambda face: -face.mesh_score):
        if all(_overlap(face.box, other.box) < COVERED for other in kept):
            kept.append(face)
    return kept


def _overlap(one: Box, other: Box) -> float:
    """The common area of two boxes, as a part of the smaller one."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (one, other)]
    return max(width, 0.0) * max(height, 0.0) / max(min(areas), 1e-9)


def _fit(photo: np.ndarray, candidate: Candidate) -> _Fitted:
    """Dense points, landmarks and pose from a candidate, and how well they agree; upside down where it fits better."""
    fitted = _fit_upright(photo, candidate)
    if fitted.face.mesh_score < CLEAR.mesh:
        points = candidate.points
        middle = (points[:2].mean(0) + points[3:].mean(0)) / 2
        other = _fit_upright(photo, candidate._replace(points=2 * middle - points))
        if other.face.mesh_score > fitted.face.mesh_score:
            return other._replace(candidate=candidate)
    return fitted


def _fit_upright(photo: np.ndarray, candidate: Candidate) -> _Fitted:
    mesh = fit_face_mesh(photo, candidate.landmarks, canonical_face().mirror)
    fit = fit_rigid_face(mesh.points)
    face = face_of_points(mesh.points, photo.shape, candidate.score, mesh.score)
    apart = float(np.hypot(*(face.landmarks - candidate.landmarks).T).mean()) / max(fit.scale, 1e-9)
    return _Fitted(candidate, face, fit.error, apart)


def _cascade_faces(photo: np.ndarray) -> list[Face]:
    small = shrink(photo, CASCADE_SIDE)
    factor = np.array((photo.shape[1] / small.shape[1], photo.shape[0] / small.shape[0]))
    return [_bare_face(photo, (points + 0.5) * factor - 0.5) for points in haar_landmarks(small)]


def _bare_face(photo: np.ndarray, landmarks: np.ndarray) -> Face:
    """A face of which the landmarks alone are known; its box is where the mean face's would be."""
    left, right, _ = landmarks
    x, y = (right - left) / np.hypot(*(right - left))
    rotation = np.array(((x, y, 0.0), (-y, x, 0.0), (0.0, 0.0, 1.0)))
    fit = RigidFit(float(np.hypot(*(right - left))), rotation, (left + right) / 2, 0.0)
    box = _box(fit.project(canonical_face().points))
    return Face(landmarks, None, box, 0.0, None, _inside(box, photo.shape), 0.0)


def _box(points: np.ndarray) -> Box:
    (x0, y0), (x1, y1) = points[:, :2].min(0), points[:, :2].max(0)
    return float(x0), float(y0), float(x1), float(y1)


def _inside(box: Box, shape: tuple[int, ...]) -> bool:
    x0, y0, x1, y1 = box
    height, width = shape[:2]
    slack = TOUCH * max(x1 - x0, y1 - y0) + 0.5
    return min(x0, y0) >= -slack and x1 <= width - 1 + slack and y1 <= height - 1 + slack


def _check_photo(photo: np.ndarray) -> None:
    if photo.ndim != 3 or photo.shape[2] != 3 or photo.dtype != np.uint8 or min(photo.shape[:2]) < 1:
        raise ValueError(f"photo: expected (H, W, 3) uint8 sRGB, got {photo.dtype} of shape {photo.shape}")
