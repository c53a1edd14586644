"""How good a decomposition is, beside pictures whose parts are known, and beside what one could do without it."""

from __future__ import annotations

import math

import cv2
import numpy as np
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.evaluation.rendered.truth import TruePicture
from facerelight.evaluation.scan import encode_srgb
from facerelight.geometry.lights import angular_distance
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo.bust.mesh import unit_vectors
from facerelight.photo.colour import to_scene
from facerelight.photo.face_model import in_front
from facerelight.photo.layers.decomposition import Decomposition
from facerelight.photo.layers.lambert import LambertSphere
from facerelight.photo.session import PhotoRelighter

__all__ = ["MEASURES", "measure_decomposition"]

MEASURES = ("normals", "reflectance", "shading", "light")
"""Median angle in degrees; relative root mean square after one gain, percent, twice; angle of the middle in degrees."""
REACH_95 = 1.96
ANGLE_95 = math.sqrt(-math.log(0.05))  # of a root mean square angle: two independent parts of one spread
LUMA = np.array(LUMINANCE, np.float32)


def measure_decomposition(
    session: PhotoRelighter, parts: Decomposition, truth: TruePicture
) -> dict[str, dict[str, float]]:
    """Errors on the face by row: "facerelight"; "average face", its normals and reflectance; "one lamp", the model's
    normals when the light is taken for one lamp in its middle; "fitted bust", the mean bust's normals; "the photo",
    taken for a reflectance, and its light for the one the session relights from. Of "facerelight" also ``*_within``:
    percent inside the 95 % interval."""
    face = truth.face & (parts.matte > 0.5)
    scene = to_scene(truth.photo.astype(np.float32) / 255) @ LUMA
    reflectance = to_scene(encode_srgb(parts.reflectance)) @ LUMA
    shading = scene / np.maximum(reflectance, 1e-4)
    turned = _angles(parts.normals, truth.normal)[face]
    fitted, albedo = _fitted(reflectance[face], truth.albedo[face]), truth.albedo[face]
    away = _light_error(parts.light.direction, truth)
    claimed = (face & (parts.face > 0.9))[face]
    inside = np.abs(fitted - albedo) <= REACH_95 * parts.reflectance_std[face] * fitted
    near = turned <= ANGLE_95 * parts.normals_std[face]
    average, lamp = _crop_normals(session)
    mean = np.linalg.norm(session.relighter.statistics.n_mean.numpy(), axis=0)
    rows = {
        "facerelight": {
            "normals": _median(turned),
            "reflectance": _percent(reflectance[face], albedo),
            "shading": _percent(shading[face], truth.irradiance[face]),
            "light": away,
            "normals_within": 100 * float(near[claimed].mean()),
            "reflectance_within": 100 * float(inside[claimed].mean()),
            "light_within": 100.0 * (away <= ANGLE_95 * parts.light.direction_std),
        },
        "average face": {
            "normals": _median(_angles(_on_photo(session, average), truth.normal)[face]),
            "reflectance": _percent(_on_photo(session, mean)[face], truth.albedo[face]),
        },
        "one lamp": {"normals": _median(_angles(_on_photo(session, lamp), truth.normal)[face])},
        "fitted bust": {"normals": _median(_angles(_enlarged(parts.maps.bust, session), truth.normal)[face])},
        "the photo": {
            "reflectance": _percent(scene[face], truth.albedo[face]),
            "shading": _percent(np.ones(int(face.sum())), truth.irradiance[face]),
            "light": _light_error(session.source_light, truth),
        },
    }
    return {row: {name: round(value, 2) for name, value in found.items()} for row, found in rows.items()}


def _crop_normals(session: PhotoRelighter) -> tuple[np.ndarray, np.ndarray]:
    """Normals on the model's crop as the camera sees them, ``(h, w, 3)``: the average face's, and the model's when the
    light is one lamp."""
    relighter = session.relighter
    domain = relighter.statistics.metadata.get("config", {}).get("domain", {})  # type: ignore[attr-defined]
    sphere = LambertSphere(relighter.statistics.lights, float(domain.get("side_light", 0.0)))
    lamp = in_front(session.source_light.numpy()[None], session.model.rotation)
    posterior = relighter.condition(session.luminance[None, None], lamp, mask=session.mask[None])
    found = (relighter.statistics.n_mean, posterior.normals().mean[0].float())
    turn = session.model.rotation.T.astype(np.float32)
    average, own = (sphere.undo(n)[0].permute(1, 2, 0).numpy() @ turn for n in found)
    return average, own


def _on_photo(session: PhotoRelighter, crop: np.ndarray) -> np.ndarray:
    """A map of the model's crop on the photograph."""
    return _enlarged(session.window.from_crop(np.ascontiguousarray(crop, np.float32), outside=0.0), session)


def _enlarged(image: np.ndarray, session: PhotoRelighter) -> np.ndarray:
    """A map of the window's copy on the photograph; 0 beyond the window."""
    window = session.window
    out = np.zeros((*session.matte.shape, *image.shape[2:]), np.float32)
    part = out[window.rows, window.columns]
    part[...] = cv2.resize(image, part.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    return out


def _angles(normals: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Degrees between ``(H, W, 3)`` vectors."""
    cosine = (unit_vectors(normals) * unit_vectors(truth)).sum(-1)
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _fitted(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """``found (P,)`` after one gain."""
    return found * float((found * truth).sum() / max(float(np.square(found).sum()), 1e-12))


def _light_error(direction: Tensor, truth: TruePicture) -> float:
    return float(angular_distance(normalize(direction.double(), dim=0), truth.direction.double()))


def _median(values: np.ndarray) -> float:
    return float(np.median(values))


def _percent(found: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error after one gain, percent of the truth's mean."""
    return 100 * float(np.sqrt(np.square(_fitted(found, truth) - truth).mean()) / truth.mean())
