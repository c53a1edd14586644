"""The ratio of new light to old over a whole bust: the face's from the model, the rest from shading, joined without a
seam.

All maps are of :data:`facerelight.photo.bust.frame.FINE`. A light is a sum of points, and so is what it does: the
model's posterior mean and the bust's irradiance are linear in it. The mean over people is a soft light itself: it knows
how bright each part of a face becomes, but not where the edges of this face's shadows run. Those are the bust's, whose
head has the face's own pose and proportions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.sources import LightMixture
from facerelight.numerics.luminance import RATIO_FLOOR
from facerelight.photo.bust.frame import BUST, FINE, between, blur, crop_onto, smooth_step
from facerelight.photo.bust.shading import BustShading

__all__ = ["FaceEvidence", "LightRatio", "surely_another"]

LEAK = 0.25  # what the mean over people leaves of a lamp where most people are in shadow
COARSE = 0.3  # units: coarser than this the model shades the face, finer mostly the bust
EDGES = 0.85  # of the face's fine shading is the bust's
FAINT_FACE, FAINT = 0.005, 0.02  # of the brightest bust shading: below it ratios level out
AROUND, HEARSAY = 0.1, 0.02  # units over which, and weight with which, the unsure is asked
DETAIL = 1.0  # pixels of the crop: finer than this a photograph shows pigment, coarser than this light as well
LEVEL, NEAR_RIM = 0.7, 0.8  # the most by which the bust's log ratio is moved to meet the face's
JOIN = 0.28  # units over which what the rim asks for fades
DARKEST, BRIGHTEST = -4.0, 1.5  # of the face's log ratio
LIFTED = 2.2  # of the same, where shading is taken away
VAGUE = 0.3  # units: beyond the face shading is a guess, and smooth
DEEPER, BRIGHTER = 0.3, 0.1  # than the face's own darkest and brightest, in log, the rest may become
BUST_DARKEST, BUST_BRIGHTEST = -2.5, 0.8
SOFT = 20.0  # degrees: a source as large as this has no edges to sharpen
SAME_LIGHT = 0.05  # a change of the face's log ratio that is none


class FaceEvidence(NamedTuple):
    """What is known of the face, on the model's crop ``(h, w)``.

    ``luminance`` of the photograph; ``mask``, where the face is; ``trust``, where the photograph is skin that the model
    understands; ``radiance``: directions ``(P, 3)`` to the model's posterior mean ``(P, h, w)`` at the photograph's
    exposure.
    """

    luminance: np.ndarray
    mask: np.ndarray
    trust: np.ndarray
    radiance: Callable[[np.ndarray], np.ndarray]


class LightRatio:
    """Log ratios of any light over the photograph's own.

    Args:
        face: what is known of the face.
        crop: the model's crop.
        shading: the bust's.
        source: the photograph's own light.
    """

    def __init__(self, face: FaceEvidence, crop: CropFrame, shading: BustShading, source: LightMixture) -> None:
        self.face, self.crop, self.shading = face, crop, shading
        self._seam = _seam(1.0, 0.3, crop, face.mask)
        self.weight, self.rim = self._seam.weight, self._seam.rim
        self._norm = np.maximum(blur(self.weight, COARSE * FINE.density), 1e-3)
        self.trust = crop_onto(face.trust.astype(np.float32), crop, FINE)
        self._fully_lit = np.maximum(blur(face.radiance(np.array([[0.0, 0.0, 1.0]], np.float32))[0], 6), 1e-3)
        mean = float((face.luminance * face.mask).sum() / max(float(face.mask.sum()), 1e-6))
        self.dark = RATIO_FLOOR * max(mean, 1e-3)
        self._soft: dict[tuple[bytes, bytes, float], tuple[np.ndarray, np.ndarray]] = {}
        own = self._maps(source)
        self.source_face, self.source_bust = own[0][..., 0], own[1][..., 0]
        seen = crop_onto(blur(face.luminance, 0.8), crop, FINE, 1.0)
        self.unexplained = self.trust * np.clip(np.log((self.source_face + self.dark) / (seen + self.dark)), -1, 1)

    def __call__(self, light: LightMixture) -> np.ndarray:
        """``(H, W, C)`` log ratio; C is 1 for white light, else 3. Under the photograph's own light it is 0."""
        face, bust = self._maps(light)
        return np.stack([self._joined(face[..., c], bust[..., c]) for c in range(face.shape[-1])], -1)

    def flat(self, reflectance: np.ndarray, luminance: np.ndarray, known: np.ndarray) -> np.ndarray:
        """``(H, W)`` log ratio of light that shades nothing over the photograph's own: 0 on average over the face.

        On the face it takes all of the photograph's shading away, whether a light explains it or not, at what the
        model's crop resolves; beyond it that of the bust.

        Args:
            reflectance: ``(h, w)`` of the face, on the model's crop, in any unit.
            luminance: ``(h, w)``, what the photograph shows of it, without highlights.
            known: ``(h, w)`` in 0..1, where it is known.
        """
        seam, kept = _seam(1.08, 0.2, self.crop, self.face.mask), np.maximum(blur(known, DETAIL), 1e-3)
        bare, seen = (
            crop_onto(blur(part * known, DETAIL) / kept, self.crop, FINE) for part in (reflectance, luminance)
        )
        sure = (crop_onto(known.astype(np.float32), self.crop, FINE) * (seam.weight > 0)).astype(np.float32)
        weight = sure * seam.weight + 1e-6
        level = float((weight * seen).sum() / max(float((weight * bare).sum()), 1e-6))
        inner = np.log((level * bare + self.dark) / (seen + self.dark))
        inner = inner - float((weight * inner).sum() / weight.sum())
        white = float((weight * self.source_bust).sum() / weight.sum())
        outer = self._bust_ratio(np.full_like(self.source_bust, white), FAINT)
        return _join(inner, blur(outer, VAGUE * FINE.density), sure, seam, LIFTED)

    def _joined(self, face: np.ndarray, bust: np.ndarray) -> np.ndarray:
        """One channel's log ratio, ``(H, W)``, from the radiance of the face and the irradiance of the bust."""
        inner = np.log((face + self.dark) / (self.source_face + self.dark))
        inner = self._with_edges(inner, self._bust_ratio(bust, FAINT_FACE))
        inner = (
            inner + self._changed(inner) * self.unexplained
        )  # what the photograph's own light left unexplained goes with it
        return _join(inner, self._bust_ratio(bust, FAINT), self.trust, self._seam, BRIGHTEST)

    def _bust_ratio(self, bust: np.ndarray, faint: float) -> np.ndarray:
        return np.log(
            (bust + faint * max(float(bust.max()), 1e-6))
            / (self.source_bust + faint * max(float(self.source_bust.max()), 1e-6))
        )

    def _with_edges(self, model: np.ndarray, bust: np.ndarray) -> np.ndarray:
        """Coarse shading from the model, fine shading mostly from the bust."""
        gap = model - bust
        coarse = blur(gap * self.weight, COARSE * FINE.density) / self._norm
        return model + EDGES * (np.clip(bust + coarse, DARKEST, BRIGHTEST) - model)

    def _changed(self, inner: np.ndarray) -> float:
        """How surely the light is another, 0 to 1, from the spread of the log ratio over the face."""
        weight = self.weight * self.trust + 1e-6
        mean = float((weight * inner).sum() / weight.sum())
        variance = float((weight * (inner - mean) ** 2).sum() / weight.sum())
        return surely_another(variance)

    def _maps(self, light: LightMixture) -> tuple[np.ndarray, np.ndarray]:
        """The face's radiance and the white bust's irradiance under ``light``, ``(H, W, C)`` each: the sum over its
        sources.

        Soft light from one set of directions, such as the fill, is worked out once.
        """
        directions, weights, sizes = light.directions.numpy(), _channels(light), light.size.numpy()
        face = np.zeros((*FINE.size, weights.shape[1]), np.float32)
        bust = np.zeros_like(face)
        for members in _lamps(light):
            towards, share, size = directions[members], weights[members], float(sizes[members[0]])
            strength = float(share.max())
            if strength == 0:
                continue
            share = np.round(share / strength, 5)  # as exact as float32 sums are, so that other fills find it again
            key = (towards.tobytes(), share.tobytes(), size)
            found = self._soft.get(key)
            if found is None:
                found = self._face_light(towards, share, size), self._bust_light(towards, share, size)
            if size >= SOFT:
                self._soft = {key: found}
            face += strength * found[0]
            bust += strength * found[1]
        return face, bust

    def _face_light(self, directions: np.ndarray, weights: np.ndarray, size: float) -> np.ndarray:
        """The face's radiance under one source, ``(H, W, C)``.

        A lamp is deepened where the mean over people is dim: ``m q (1 + f) / (q + f)``, q its share of the fully lit
            face.
        """
        radiance = self.face.radiance(directions)  # (P, h, w)
        edged = float(np.clip((SOFT - size) / 10, 0, 1))
        if edged:
            share = radiance / self._fully_lit
            radiance = radiance * (share * (1 + LEAK) / (share + LEAK)) ** edged
        lit = np.tensordot(weights.T, radiance, 1).astype(np.float32)  # (C, h, w)
        return np.stack([crop_onto(channel, self.crop, FINE) for channel in lit], -1)

    def _bust_light(self, directions: np.ndarray, weights: np.ndarray, size: float) -> np.ndarray:
        """The white bust's irradiance under one source, ``(H, W, C)``."""
        if size >= SOFT:
            shades = np.stack([self.shading.shade(one, size) for one in directions])  # (P, H', W')
            lit = np.tensordot(weights.T, shades, 1).astype(np.float32)
            return np.stack([between(channel, BUST, FINE) for channel in lit], -1)
        middle = directions.mean(0)
        middle /= max(float(np.linalg.norm(middle)), 1e-6)
        seen = self.shading.fine_visibility(middle, size)
        lit = sum(
            self.shading.fine_lambert(one)[..., None] * share for one, share in zip(directions, weights, strict=True)
        )
        return lit * seen[..., None]


class _Seam(NamedTuple):
    """Where the face goes over into the rest, ``(H, W)`` on :data:`FINE`: the face's ``weight`` in 0..1, its ``rim``,
    and that blurred."""

    weight: np.ndarray
    rim: np.ndarray
    near_rim: np.ndarray


def _seam(ends: float, width: float, crop: CropFrame, mask: np.ndarray) -> _Seam:
    """The face's weight falls to 0 over a ``width``, and ``ends``, in units of its oval; ``mask (h, w)`` of the crop
    says where skin is seen."""
    share = np.clip((ends - crop.oval().numpy()) / width, 0, 1)
    weight = crop_onto(smooth_step(share).astype(np.float32), crop, FINE)
    seen = crop_onto(blur(mask, 1.5), crop, FINE)
    rim = (4 * weight * (1 - weight) * seen + 0.02 * weight).astype(np.float32)
    return _Seam(weight, rim, blur(rim, JOIN * FINE.density))


def _join(inner: np.ndarray, outer: np.ndarray, trust: np.ndarray, seam: _Seam, most: float) -> np.ndarray:
    """Log ratios ``inner`` of the face, as far as ``trust`` goes and at most ``most``, and ``outer`` of the rest as
    one, ``(H, W)`` each."""
    sure = (trust + HEARSAY) * (seam.weight > 0)
    around = blur(inner * sure, AROUND * FINE.density) / np.maximum(blur(sure, AROUND * FINE.density), 1e-4)
    inner = trust * inner + (1 - trust) * around  # what is unsure follows what surrounds it
    level = float((seam.rim * (inner - outer)).sum() / max(float(seam.rim.sum()), 1e-6))
    near = blur(seam.rim * (inner - outer - level), JOIN * FINE.density) / np.maximum(seam.near_rim, 1e-4)
    outer = (
        outer + np.clip(level, -LEVEL, LEVEL) + np.clip(near, -NEAR_RIM, NEAR_RIM) * np.clip(6 * seam.near_rim, 0, 1)
    )
    # hair is hardly deeper in shade or brighter than the face
    low, high = np.quantile(inner[seam.weight > 0.5], (0.05, 0.95))
    outer = np.clip(outer, low - DEEPER, high + BRIGHTER)
    outer = np.clip(blur(outer, 1.2), BUST_DARKEST, BUST_BRIGHTEST)
    return seam.weight * np.clip(inner, DARKEST, most) + (1 - seam.weight) * outer


def surely_another(variance: float) -> float:
    """How surely a light is another, 0 to 1, from the ``variance`` of its log ratio."""
    return variance / (variance + SAME_LIGHT**2)


def _lamps(light: LightMixture) -> list[np.ndarray]:
    """Indices of the points of each source; large ones, which have no edges, are taken together."""
    number = np.where(light.size.numpy() >= SOFT, -1, light.source.numpy())
    return [np.flatnonzero(number == one) for one in np.unique(number)]


def _channels(light: LightMixture) -> np.ndarray:
    """Weights ``(P, C)``: one channel where the light is white."""
    weights = light.weights.numpy()
    return weights[:, :1] if light.white else weights
