"""A photograph as layers of its own size: what lies in the person and what in the light.

In linear sRGB, pixel by pixel, ``reflectance * shading + highlights`` is the photograph wherever the person covers it.
On the face, shading is the model's at scales coarser than a cheek, and finer that of the mean bust fitted to the head;
beyond the face it is the bust's. What is finer still, and what neither explains, goes into the reflectance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from facerelight.numerics.luminance import BLACK
from facerelight.photo.bust.frame import FINE, Window, blur, crop_onto
from facerelight.photo.bust.mesh import unit_vectors
from facerelight.photo.bust.shading import BustShading
from facerelight.photo.colour import LUMA, TOE, developed, to_scene
from facerelight.photo.face_model import MISFIT, MIXTURE_SIZE, FaceModel, in_front
from facerelight.photo.files.pixels import scale_of
from facerelight.photo.layers.face import FaceParts, take_apart
from facerelight.photo.layers.highlights import OwnSkin, own_skin, without_highlights
from facerelight.photo.layers.own_light import OwnLight, light_colours
from facerelight.photo.person import Person
from facerelight.photo.ratio import FaceEvidence, LightRatio

__all__ = ["STRIP", "Decomposition", "LayerMaps", "decompose_person"]

OWN_SHARE = 0.5  # of the face's normals is the model's, the rest the fitted bust's
SURE_COVER = 0.98  # of the person's cover, from which nothing of the background shows
OWN_AT_RIM, MOST_AT_RIM = 0.6, 2.0  # of a pixel's light is the person's at least, and most, where the cover is partial
STRIP = 1 << 17  # pixels worked on at once
TINT_BLUR = 0.25  # units: colours of light vary slowly
OWN_BLUR = 0.04  # units: finer than this the model's normals hold pigment
STRAIGHT = np.array((0.0, 0.0, 1.0), np.float32)


class LayerMaps(NamedTuple):
    """What layers are made of, on the window's copy: ``cover`` and ``face (h, w)`` in 0..1; ``ground (h, w, 3)``; the
    ``skin`` of the face; ``log_shading (h, w, 3)`` of scene radiance; ``normal (h, w, 3)``, and the fitted
    ``bust``'s alone; ``normal_std`` in degrees and ``reflectance_std``, a share, ``(h, w)``."""

    cover: np.ndarray
    face: np.ndarray
    ground: np.ndarray
    skin: OwnSkin
    log_shading: np.ndarray
    normal: np.ndarray
    bust: np.ndarray
    normal_std: np.ndarray
    reflectance_std: np.ndarray


@dataclass(frozen=True, eq=False)
class Decomposition:
    """The layers of one photograph of ``H`` x ``W`` pixels; each is made when it is asked for, and not kept.

    Colours are linear sRGB in radiance of the photograph: decode it, and ``reflectance * shading + highlights`` is it
    wherever :attr:`matte` is 1. Reflectance has no scale of its own: it is as bright as the photograph, shading being 1
    on average over the face (in its logarithm, scene radiance); and no colour of its own: the light as a whole is taken
    for white.

    ``light`` is the photograph's own light. ``size``: (H, W).

    Example:
        >>> from skimage.data import astronaut  # doctest: +SKIP
        >>> parts = PhotoRelighter(astronaut()).decompose()  # doctest: +SKIP
        >>> parts.normals.shape, parts.light.direction_std < 30  # doctest: +SKIP
        ((512, 512, 3), True)
    """

    light: OwnLight
    pixels: np.ndarray
    window: Window
    maps: LayerMaps

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the photograph in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def unit(self) -> float:
        """The distance between the eyes in pixels of the photograph."""
        return self.window.unit * self._part[1] / self.window.size[1]

    @property
    def matte(self) -> np.ndarray:
        """Cover of the person, ``(H, W)`` float32 in 0..1."""
        return self._whole(lambda rows: self._rows(self.maps.cover, rows))

    @property
    def face(self) -> np.ndarray:
        """Where the model speaks and standard deviations hold, ``(H, W)`` float32 in 0..1: the face alone."""
        return self._whole(lambda rows: self._rows(self.maps.face, rows))

    @property
    def reflectance(self) -> np.ndarray:
        """``(H, W, 3)`` float32, the person as if light came evenly to every place; 0 beyond the person."""
        return self._whole(lambda rows: self._parts(rows)[0], 3)

    @property
    def shading(self) -> np.ndarray:
        """``(H, W, 3)`` float32, what light, shape and shadows make of reflectance; 0 beyond the person."""
        return self._whole(lambda rows: self._parts(rows)[1], 3)

    @property
    def highlights(self) -> np.ndarray:
        """``(H, W, 3)`` float32, what the skin's surface mirrors; 0 beyond the person."""
        return self._whole(lambda rows: self._parts(rows)[2], 3)

    @property
    def normals(self) -> np.ndarray:
        """``(H, W, 3)`` float32 unit vectors, x to image-right, y up, z to the camera; 0 beyond the person. Beyond the
        face they are those of the mean bust, a guess."""

        def rows_at(rows: slice) -> np.ndarray:
            there = self._rows(self.maps.cover, rows)[..., None] > 0
            return np.asarray(unit_vectors(self._rows(self.maps.normal, rows)) * there)

        return self._whole(rows_at, 3)

    @property
    def normals_std(self) -> np.ndarray:
        """Root mean square angle in degrees by which :attr:`normals` may be off, ``(H, W)`` float32; 0 beyond the
        face."""
        return self._whole(lambda rows: self._rows(self.maps.normal_std * self.maps.face, rows))

    @property
    def reflectance_std(self) -> np.ndarray:
        """Standard deviation of :attr:`reflectance`, and with it of :attr:`shading`, as a share of it, ``(H, W)``
        float32, the unknown scale apart; 0 beyond the face."""
        return self._whole(lambda rows: self._rows(self.maps.reflectance_std * self.maps.face, rows))

    def _parts(self, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reflectance, shading and highlights at some rows of the window, ``(h, W, 3)`` each."""
        maps, white = self.maps, np.float32(scale_of(self.pixels))
        source = self.pixels[self.window.rows, self.window.columns][rows].astype(np.float32) / white
        cover = self._rows(maps.cover, rows)[..., None]
        scene = to_scene(source)
        share = (scene - (1 - cover) * self._rows(maps.ground, rows)) / np.maximum(cover, 0.05)
        scene = np.where(cover > SURE_COVER, scene, np.clip(share, OWN_AT_RIM * scene, MOST_AT_RIM * scene))
        where, diffuse, level = (
            self._rows(part, rows) for part in (maps.skin.where, maps.skin.diffuse, maps.skin.level)
        )
        skin = maps.skin._replace(where=where, diffuse=diffuse, level=level)
        matt = without_highlights(scene, skin)
        flat = np.exp(-self._rows(maps.log_shading, rows))
        body, bare = developed(matt), developed(matt * flat)
        there = cover > 0
        shading = np.where(bare > BLACK, body / np.maximum(bare, BLACK), flat**-TOE)
        return bare * there, shading * there, (developed(scene) - body) * there

    def _rows(self, image: np.ndarray, rows: slice) -> np.ndarray:
        """A map of the window's copy at some rows of the window, without making the rest."""
        height, width = self._part
        sy, sx = image.shape[0] / height, image.shape[1] / width
        matrix = np.array([[sx, 0, 0.5 * sx - 0.5], [0, sy, (rows.start + 0.5) * sy - 0.5]])
        size, flags = (width, rows.stop - rows.start), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(image, matrix, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)

    @property
    def _part(self) -> tuple[int, int]:
        """Height and width of the window in pixels of the photograph."""
        rows, columns = self.window.rows, self.window.columns
        return rows.stop - rows.start, columns.stop - columns.start

    def _whole(self, make: Callable[[slice], np.ndarray], channels: int = 1) -> np.ndarray:
        """A layer of the photograph's size, made strip by strip."""
        height, width = (
            self.window.rows.stop - self.window.rows.start,
            self.window.columns.stop - self.window.columns.start,
        )
        out = np.zeros((*self.size, channels), np.float32)
        step = max(1, STRIP // width)
        for top in range(0, height, step):
            rows = slice(top, min(top + step, height))
            there = slice(self.window.rows.start + rows.start, self.window.rows.start + rows.stop)
            out[there, self.window.columns] = make(rows).reshape(rows.stop - rows.start, width, channels)
        return out if channels > 1 else out[..., 0]


def decompose_person(
    pixels: np.ndarray, window: Window, person: Person, model: FaceModel, shading: BustShading, trust: np.ndarray
) -> Decomposition:
    """Take a photograph apart.

    Args:
        pixels: ``(H, W, 3)``.
        window: its part with the bust.
        person: what it shows of the person.
        model: of its face.
        shading: of the bust fitted to it.
        trust: ``(h, w)`` on the model's crop, where the photograph shows what the model means.
    """
    relighter, frame = model.relighter, model.frame
    noise = math.hypot(relighter.noise, MISFIT) / 255
    parts = take_apart(relighter, model.luminance, model.mask, noise)

    def radiance(directions: np.ndarray) -> np.ndarray:
        """The face under lights as the camera sees them, exposed like the photograph, ``(P, h, w)``."""
        lights = in_front(directions, model.rotation).to(relighter.statistics.lights)
        return parts.posterior.mean(lights)[0].cpu().numpy() * exposure

    exposure = 1.0
    at_camera = float((radiance(STRAIGHT[None])[0] * model.mask.numpy()).sum())
    exposure = float((model.luminance * model.mask).sum()) / max(at_camera, 1e-6) or 1.0
    face = window.from_crop(model.mask.numpy(), outside=0.0).clip(0, 1)
    known = np.sqrt((trust * model.mask.numpy() * (1 - window.onto_crop(person.features.not_skin))).clip(0, 1))
    bare = face * (1 - person.features.eyes_and_lips) * person.cover
    skin = own_skin(person.scene, bare, person.skin.diffuse, window.unit)
    body = window.onto_crop(without_highlights(person.scene, skin))
    light = _own_light(parts, model, exposure, body, trust, radiance)
    ratio = LightRatio(
        FaceEvidence(model.luminance.numpy(), model.mask.numpy(), trust, radiance), frame, shading, light.white
    )
    log_shading = _coloured(-ratio.flat(parts.reflectance.numpy(), body @ LUMA, known), ratio, light)
    maps = LayerMaps(
        person.cover,
        face,
        person.ground,
        skin,
        window.back(log_shading, FINE).reshape(*window.size, 3),
        window.back(_normals(parts, model, shading, ratio.weight * ratio.trust), FINE),
        window.back(shading.bust.fine_normal, FINE),
        window.from_crop(parts.normal_std.numpy(), outside=0.0),
        window.from_crop(parts.reflectance_std.numpy(), outside=0.0),
    )
    return Decomposition(light, pixels, window, maps)


def _own_light(
    parts: FaceParts,
    model: FaceModel,
    exposure: float,
    body: np.ndarray,
    trust: np.ndarray,
    radiance: Callable[[np.ndarray], np.ndarray],
) -> OwnLight:
    """The light as the camera sees it; ``body (h, w, 3)``, the crop without highlights."""
    turn = torch.from_numpy(model.rotation).float()
    directions, amounts = parts.light.directions.float() @ turn.T, parts.light.amounts[0].float() / exposure
    images = torch.from_numpy(radiance(directions.numpy())).flatten(1)
    colour = torch.from_numpy(np.ascontiguousarray(body.transpose(2, 0, 1))).flatten(1)
    colours = light_colours(colour, images, amounts, torch.from_numpy(trust).flatten(), directions)
    return OwnLight(
        directions,
        amounts,
        parts.draws.amounts.float().std(0) / exposure,
        colours,
        turn @ parts.direction.float(),
        parts.direction_std,
        MIXTURE_SIZE,
    )


def _coloured(log_shading: np.ndarray, ratio: LightRatio, light: OwnLight) -> np.ndarray:
    """``log_shading (H, W)`` in the light's own colours, ``(H, W, 3)``."""
    mixture = light.mixture
    tint = np.zeros((*log_shading.shape, 1), np.float32) if mixture.white else ratio(mixture)
    tint = blur(np.broadcast_to(tint, (*log_shading.shape, 3)), TINT_BLUR * FINE.density)
    return (log_shading[..., None] + tint).astype(np.float32)


def _normals(parts: FaceParts, model: FaceModel, shading: BustShading, sure: np.ndarray) -> np.ndarray:
    """Normals on :data:`FINE`, ``(H, W, 3)``: the fitted bust's, on the face the mean of those and the model's."""
    turn = model.rotation.astype(np.float32)
    own = crop_onto(parts.normal.permute(1, 2, 0).numpy() @ turn.T, model.frame, FINE)
    bust = shading.bust.fine_normal
    moved = blur(sure[..., None] * (unit_vectors(own) - bust), OWN_BLUR * FINE.density)
    return np.asarray(unit_vectors(bust + OWN_SHARE * moved), np.float32)
