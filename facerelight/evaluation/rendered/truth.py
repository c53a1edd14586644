"""Pictures whose parts are known: rendered heads, and the scanned one, under lamps, taken by a camera that no method
knows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.config import TrainConfig
from facerelight.evaluation.portrait import EXPOSURE, ROWS, SOURCES, PortraitTruth, film
from facerelight.evaluation.scan import ScannedHead
from facerelight.geometry.sources import Lamp, LightMixture, scene_light
from facerelight.numerics.luminance import LUMINANCE
from facerelight.train.dataset import make_dataset

__all__ = ["SETUPS", "TruePicture", "rendered_pictures", "scanned_pictures"]

SETUPS: dict[str, tuple[list[Lamp], float]] = SOURCES | {
    "hard": ([Lamp(-60, 15, 5)], 0.1),
    "above": ([Lamp(10, 50, 8)], 0.15),
}
"""Lamps and fill, by name."""
LEVEL = 0.18  # mean radiance of a rendered face as the camera is exposed, times its albedo beside a middle one
INNER = 0.95  # of the face's oval
BACKDROP = 0.25  # radiance


class TruePicture(NamedTuple):
    """``photo (H, W, 3)`` uint8 sRGB with ``landmarks (3, 2)``, and what it is made of: where the ``face`` is,
    ``(H, W)`` bool; unit ``normal (H, W, 3)``; ``albedo`` and diffuse ``irradiance (H, W)``, each up to a factor;
    ``direction (3,)``, the middle of the light."""

    photo: np.ndarray
    landmarks: np.ndarray
    face: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    irradiance: np.ndarray
    direction: Tensor


def rendered_pictures(
    config: TrainConfig, setups: Mapping[str, tuple[list[Lamp], float]]
) -> Iterator[tuple[str, TruePicture]]:
    """Every head of ``config`` under each of ``setups``; its crop is the picture, its landmarks those of the crop."""
    dataset, frame = make_dataset(config, torch.tensor([[0.0, 0.0, 1.0]])), config.frame
    inner = frame.oval().numpy() < INNER
    for index in range(config.heads):
        surface, material = dataset.surface(index)

        def put(values: Tensor, seen: Tensor = surface.pixel, size: tuple[int, int] = surface.size) -> np.ndarray:
            out = torch.zeros(size[0] * size[1], *values.shape[1:])
            out[seen] = values
            return out.view(*size, *values.shape[1:]).numpy()

        there = put(torch.ones(len(surface.pixel)))
        albedo, normal = put(surface.albedo), put(surface.normal)
        matt = material.__class__(**{**vars(material), "specular": 0.0})
        for name, (lamps, fill) in setups.items():
            light = scene_light(lamps, fill)
            picture, diffuse = np.zeros(surface.size, np.float32), np.zeros(surface.size, np.float32)
            for towards, weight in zip(light.directions, light.weights[:, 0].tolist(), strict=True):
                for whole, skin in ((picture, material), (diffuse, matt)):
                    plan = plan_effects(surface, towards, skin)
                    whole += weight * shade(surface, towards, skin, plan, dataset.renderer).numpy()
            face = inner & (there > 0)
            level = LEVEL * float(albedo[face].mean() / 0.5) ** 0.5 / float(picture[face].mean())
            scene = picture * level + BACKDROP * (1 - there)
            photo = film(np.repeat(scene[..., None], 3, -1))
            irradiance = diffuse / np.maximum(albedo, 1e-3)
            truth = TruePicture(photo, frame.landmarks.numpy(), face, normal, albedo, irradiance, _middle(light))
            yield name, truth
    dataset.close()


def scanned_pictures(
    head: ScannedHead, tone: str, setups: Mapping[str, tuple[list[Lamp], float]]
) -> Iterator[tuple[str, TruePicture]]:
    """The scanned head in one skin tone under each of ``setups``, its albedo's luminance."""
    truth = PortraitTruth(head, tone)
    luma = np.array(LUMINANCE, np.float32)
    albedo = head.picture(truth.albedo.astype(np.float32))[:ROWS]
    normal = head.picture(head.normal.astype(np.float32))[:ROWS]
    for name, (lamps, fill) in setups.items():
        scene = head.radiance(truth.albedo, lamps, fill)
        gain = EXPOSURE[tone] / float((scene[:ROWS] @ luma)[truth.regions.face].mean())
        lit = sum((1 - fill) * lamp.power * head.lamp(lamp).irradiance for lamp in lamps)
        lit = lit + fill * head.dome().irradiance
        irradiance = head.picture((lit @ luma).astype(np.float32))[:ROWS]
        photo = truth.photograph(scene * gain)
        yield (
            name,
            TruePicture(
                photo,
                truth.landmarks,
                truth.regions.face,
                normal,
                albedo @ luma,
                irradiance,
                _middle(scene_light(lamps, fill)),
            ),
        )


def _middle(light: LightMixture) -> Tensor:
    """The middle of a light, ``(3,)``."""
    return normalize(light.weights.mean(1) @ light.directions, dim=0)
