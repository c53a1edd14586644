"""What the statistical model knows of the face in a photograph: its own light, and its radiance under any other.

Few photographs are lit by one lamp. The photograph's light is fitted as a mixture of lights on the average face, and
the quotient of the average face under the mixture and under one light, its middle, takes the crop from one to the
other; on that the model is conditioned.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from functools import cache, cached_property
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.config import default_statistics_folder, find_statistics, quality_config
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.behind import nearest_side, share_reached
from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sources import LightMixture
from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.inference.methods import RELIGHTING_METHODS, Method
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.estimator import GaussianBelief
from facerelight.light.soft import fit_soft_light, one_lamp_quotient
from facerelight.model.covariance import prior_mean
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo.bust.frame import blur
from facerelight.photo.face_mask import face_mask

__all__ = ["FaceModel", "Quality", "SourceLight", "crop_frame", "in_front", "load_relighter", "wobble"]

LIGHT_DRAWS = 16
MISFIT = 3.0  # grey levels of 255: what compression, pose, expression and a sum of lights taken for one leave
OWN_ERROR = 1.5  # degrees, by which fits to two photographs under one light differ
SOFT_ERROR = (0.104, 0.144, 0.088)  # standard deviation of a fitted light, over 60 held-out rendered heads
FAINT = 0.003  # of the photograph's light: smaller amounts are the fit's own noise
MIXTURE_SIZE = 20.0  # degrees: the lights of a mixture stand about so far apart
CAMERA = torch.tensor([[0.0, 0.0, 1.0]])

Quality = Literal["draft", "standard", "reference"]
Renderer = Callable[[Tensor], Tensor]  # lights (Q, 3) -> maps (1, Q, h, w)


class SourceLight(NamedTuple):
    """A crop's own light: ``direction (3,)``, its middle, zero for a black crop; ``amounts (J,)`` of the bootstrap
    lights; ``equivalent (h, w)``, what the crop would look like under the one direction at unit strength;
    ``noise (h, w)``, standard deviation of what the latter holds besides the face."""

    direction: Tensor
    amounts: Tensor
    equivalent: Tensor
    noise: Tensor


def load_relighter(quality: Quality = "standard", cache: str | None = None) -> StatisticalRelighter:
    """The relighter with packaged or cached statistics of a quality, see :func:`facerelight.config.find_statistics`.

    Args:
        quality: see :data:`facerelight.config.QUALITIES`; "standard" comes with the package.
        cache: look only here; None: the package, then the user's cache.

    Raises:
        ValueError: an unknown quality.
        RuntimeError: they have not been trained yet; says which command does it.
    """
    config = quality_config(quality)
    folder = find_statistics(config, cache)
    if folder is None:
        place = default_statistics_folder(config, cache)
        command = "facerelight train" if quality == "standard" else f"facerelight relight PHOTO --quality {quality}"
        raise RuntimeError(f"statistics: none of quality {quality!r} in {place}; train them once with `{command}`")
    return StatisticalRelighter.from_pretrained(folder)


def crop_frame(relighter: StatisticalRelighter) -> CropFrame:
    """The crop that a relighter's statistics are of."""
    height, width = relighter.statistics.size
    margin = float(relighter.statistics.metadata.get("config", {}).get("margin", 0.0))  # type: ignore[attr-defined]
    return CropFrame(height, width, margin)


def wobble(statistics: FaceStatistics, lights: Tensor) -> Tensor:
    """Variance of the average face under unit ``lights (S, 3)`` by an error of ``OWN_ERROR``, ``(S, P)``."""
    about = torch.linalg.svd(lights[:, None])[2][:, 1:] * math.radians(OWN_ERROR)  # (S, 2, 3), across the sphere
    there = prior_mean(statistics, lights)
    moved = [prior_mean(statistics, unit_lights(lights + about[:, axis])) - there for axis in (0, 1)]
    return moved[0].square() + moved[1].square()


class FaceModel:
    """One face, conditioned once.

    Args:
        relighter: the model.
        crops: ``(3, h, w)`` scene radiance of the photograph's face, and of further photographs of the same person.
        source_light: ``(3,)`` where the first photograph's light is known; None estimates it.
        method: "expected", "map" or "mle", see :class:`facerelight.inference.relighter.StatisticalRelighter`.
        rotation: ``(3, 3)``, how the head is turned from the camera. A turned head under a lamp is shaded like one that
            looks ahead under the lamp turned back, and so the model sees all lights from the head; None: it looks
            ahead.
        towards: ``(J, 3)`` unit vectors as the camera sees them, where the first photograph's light is looked for;
            None: the statistics' own lights, about the head.

    Raises:
        ValueError: an unknown method, or too few photographs for it.
    """

    def __init__(
        self,
        relighter: StatisticalRelighter,
        crops: list[Tensor],
        source_light: Tensor | None = None,
        method: Method = "expected",
        rotation: np.ndarray | None = None,
        towards: np.ndarray | None = None,
    ) -> None:
        if method not in RELIGHTING_METHODS:
            raise ValueError(f"method: expected one of {', '.join(RELIGHTING_METHODS)}, got {method!r}")
        self.relighter, self.frame = relighter, crop_frame(relighter)
        self.lights = relighter.statistics.lights.cpu()  # pictures stay on the CPU, whatever device the model is on
        self.luminance, self.mask = _luminance(crops[0]), face_mask(crops[0], self.frame)
        self.rotation = np.eye(3) if rotation is None else _relative(rotation, _looks_up(relighter))
        turn = torch.from_numpy(self.rotation).float()
        self.towards = (self.lights @ turn.T) if towards is None else torch.from_numpy(towards).float()
        self.lights = self.lights if towards is None else in_front(towards, self.rotation)
        known = None if source_light is None else source_light.reshape(3).to(turn) @ turn
        own = self._source(self.luminance, self.mask, known)
        sources, mask = [own], self.mask
        for crop in crops[1:]:
            other = face_mask(crop, self.frame)
            sources.append(self._source(_luminance(crop), other, None))
            mask = torch.minimum(mask, other)
        images, lights = torch.stack([s.equivalent for s in sources]), torch.stack([s.direction for s in sources])
        unsure = lights.square().sum(-1) > 0
        unsure[0] &= source_light is None
        noise = torch.stack([s.noise for s in sources])
        self._mean, self._variance = self._conditioned(images, lights, noise, mask, unsure, method)
        self.source_light = turn @ own.direction
        # The new lamp is as strong as keeps the face's brightness when it stands at the camera.
        self.exposure = 1.0
        at_camera = float((torch.from_numpy(self.radiance(CAMERA.numpy())[0]) * self.mask).sum())
        self.exposure = float((self.luminance * self.mask).sum()) / max(at_camera, 1e-6) or 1.0
        self.amounts = own.amounts
        self.light = self.mixture(own.amounts)

    def posed(self, crop: Tensor, rotation: np.ndarray) -> FaceModel:
        """The same person in the same light in another picture: nothing is conditioned anew.

        Args:
            crop: ``(3, h, w)`` scene radiance.
            rotation: ``(3, 3)``, how the head is turned in it.
        """
        other = copy(self)
        other.luminance, other.mask = _luminance(crop), face_mask(crop, self.frame)
        other.rotation = _relative(rotation, _looks_up(self.relighter))
        return other

    def mixture(self, amounts: Tensor) -> LightMixture:
        """The light of ``amounts (J,)`` from :attr:`towards`, in units of a lamp that keeps the photograph's
        brightness."""
        kept = amounts > FAINT * amounts.sum()
        if not kept.any():
            return LightMixture(
                CAMERA.clone(), torch.zeros(1, 3), torch.full((1,), MIXTURE_SIZE), torch.zeros(1, dtype=torch.long)
            )
        count = int(kept.sum())
        weights = (amounts[kept] / self.exposure)[:, None].expand(-1, 3).contiguous()
        return LightMixture(
            self.towards[kept], weights, torch.full((count,), MIXTURE_SIZE), torch.zeros(count, dtype=torch.long)
        )

    def _conditioned(
        self, images: Tensor, lights: Tensor, noise: Tensor, mask: Tensor, unsure: Tensor, method: Method
    ) -> tuple[Renderer, Renderer]:
        """What renders the person of ``images (K, h, w)``, with errors of ``noise (K, h, w)``, and its variance, under
        any light; ``unsure (K,)``, which lights are estimates."""
        if method == "mle":
            fixed = MaximumLikelihood(
                self.relighter.statistics, images, lights, noise.flatten(1), mask, self.relighter.noise / 255
            )
            return (lambda target: fixed.relight(target).mean[None]), (
                lambda target: fixed.relight(target).variance[None]
            )
        point = self.relighter.condition(images[None], lights, mask=mask[None], noise=noise[None])

        @cache
        def integrated() -> Posterior:
            """Over what is not known of the lights: the thesis warns of a point estimate's variance (3.4.1)."""
            belief = GaussianBelief(lights[None], torch.diag(torch.tensor(SOFT_ERROR)))
            drawn = torch.nn.functional.normalize(belief.draw(LIGHT_DRAWS, None, False)[0], dim=-1)
            drawn = torch.where(unsure[:, None], drawn, lights)
            return self.relighter.condition(images[None], drawn[None], mask=mask[None], noise=noise[None])

        if not unsure.any():
            return (point.mean if method == "expected" else point.mode), point.variance
        return (
            point.mean if method == "expected" else lambda target: integrated().mode(target),
            lambda target: integrated().variance(target),
        )

    def _source(self, luminance: Tensor, mask: Tensor, known: Tensor | None) -> SourceLight:
        """The light of one crop; with a ``known`` direction that alone, as strong as the fit says."""
        statistics = self.relighter.statistics
        average = prior_mean(statistics, self.lights.to(statistics.lights)).unflatten(1, statistics.size).cpu()
        amounts = fit_soft_light(average, luminance, mask)
        strength = float(amounts.sum())
        if strength < 1e-4:
            return SourceLight(
                torch.zeros(3), torch.zeros_like(amounts), luminance, self._noise(torch.ones_like(luminance))
            )
        share = amounts / strength
        if known is not None:
            nearest = torch.zeros_like(amounts)
            direction = torch.nn.functional.normalize(known.reshape(3).to(share), dim=0)
            nearest[(self.lights @ direction).argmax()] = strength
            scale = torch.full_like(luminance, 1 / strength)
            return SourceLight(direction, nearest, luminance * scale, self._noise(scale))
        direction = torch.nn.functional.normalize(share @ self.lights, dim=0)
        mixture = torch.tensordot(share, average.clamp_min(0), 1)
        light = direction[None].to(statistics.lights)
        single, moved = (
            part.unflatten(1, statistics.size)[0].cpu()
            for part in (prior_mean(statistics, light), wobble(statistics, light))
        )
        quotient = one_lamp_quotient(single, mixture)
        noise = self._noise(quotient / strength).square() + moved
        return SourceLight(direction, amounts, luminance / strength * quotient, noise.sqrt())

    def _noise(self, scale: Tensor) -> Tensor:
        """Standard deviation of the errors of a photograph whose radiance was multiplied by ``scale (h, w)``."""
        return scale * math.hypot(self.relighter.noise, MISFIT) / 255

    def crops(self, lights: Tensor) -> Tensor:
        """The aligned face under unit ``lights (Q, 3)``, scene radiance before exposure, ``(Q, h, w)``."""
        return self._mean(lights.to(self.relighter.statistics.lights))[0].cpu()

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """The head as it is turned, exposed like the photograph and never negative: ``directions (P, 3)`` to ``(P, h,
        w)``.

        Of light from behind the head, the model's answer for its nearest side is kept where the average face is turned
        far enough to be reached.
        """
        seen = directions.astype(np.float64) @ self.rotation
        radiance = (self.crops(in_front(directions, self.rotation)).clamp_min(0) * self.exposure).numpy()
        normal = torch.from_numpy(self.normal)
        for one in np.flatnonzero(seen[:, 2] < 0):
            radiance[one] *= share_reached(normal, torch.from_numpy(seen[one]).to(normal)[None]).numpy()
        return radiance

    @cached_property
    def normal(self) -> np.ndarray:
        """Unit normals of the average face, seen from the head, ``(h, w, 3)``."""
        n = self.relighter.statistics.n_mean.cpu().permute(1, 2, 0)
        return torch.nn.functional.normalize(n, dim=-1).numpy()

    def std(self, direction: np.ndarray) -> np.ndarray:
        """Standard deviation of :meth:`radiance` under one light ``(3,)``, ``(h, w)``."""
        light = in_front(direction[None], self.rotation).to(self.relighter.statistics.lights)
        noise = (self.relighter.noise / 255) ** 2  # of a new picture, which no exposure scales
        known = (self._variance(light)[0, 0] - noise).clamp_min(0) * self.exposure**2
        return (known + noise).sqrt().cpu().numpy()

    def trust(self, features: np.ndarray) -> np.ndarray:
        """Where the photograph shows what the model means, ``(h, w)`` in 0 to 1: lit skin, not eyes and teeth, hair,
        glasses or beard.

        Args:
            features: ``(h, w)``, 1 on eyes and on the inside of the mouth.
        """
        luminance = self.luminance.numpy()
        weights = self.light.weights[:, 0].numpy()
        expected = np.tensordot(weights, self.radiance(self.light.directions.numpy()), 1)
        level = float(
            (luminance * self.mask.numpy()).sum() / max(float(self.mask.sum()), 1e-6)
        )  # dark skin is not shade
        lit = np.clip((luminance / max(level, 1e-4) - 0.07) / 0.2, 0, 1)
        floor = 0.03 * max(level, 1e-4)
        apart = np.abs(np.log((blur(luminance, 2) + floor) / (blur(expected, 2) + floor)))
        agrees = np.clip((1 - apart) / 0.5, 0, 1)
        return blur(self.mask.numpy() * lit * (1 - features.clip(0, 1)) * agrees, 1)


def in_front(directions: np.ndarray, rotation: np.ndarray) -> Tensor:
    """``directions (P, 3)`` as a head that is turned by ``rotation (3, 3)`` sees them, those behind it at its nearest
    side, ``(P, 3)``."""
    return nearest_side(torch.from_numpy(directions.astype(np.float64) @ rotation)).float()


def _looks_up(relighter: StatisticalRelighter) -> float:
    """Degrees by which the heads of the statistics look up, on average."""
    domain = relighter.statistics.metadata.get("config", {}).get("domain", {})  # type: ignore[attr-defined]
    return float(domain.get("pitch", 0.0))


def _relative(rotation: np.ndarray, looks_up: float) -> np.ndarray:
    """How a head is turned beside those of the statistics, which look up by some degrees."""
    s, c = np.sin(np.deg2rad(looks_up)), np.cos(np.deg2rad(looks_up))
    return rotation @ np.array(((1, 0, 0), (0, c, s), (0, -s, c))).T


def _luminance(crop: Tensor) -> Tensor:
    """Of a crop ``(3, h, w)``, ``(h, w)``."""
    return torch.tensordot(torch.tensor(LUMINANCE).to(crop), crop, 1)
