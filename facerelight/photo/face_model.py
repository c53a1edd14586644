"""What the statistical model knows of the face in a photograph: its own light, and its radiance under any other.

Few photographs are lit by one lamp. The photograph's light is estimated as amounts of many, and the model is
conditioned on the face under their sum.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.config import default_statistics_folder, find_statistics, quality_config
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import unit_lights
from facerelight.geometry.sources import LightMixture
from facerelight.geometry.sums import LightSum
from facerelight.inference.maximum_likelihood import MaximumLikelihood
from facerelight.inference.methods import RELIGHTING_METHODS, Method
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import AmountsBelief
from facerelight.light.soft import fit_soft_light
from facerelight.model.covariance import prior_mean
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo.bust.frame import blur
from facerelight.photo.face_mask import face_mask

__all__ = ["FaceModel", "Quality", "SourceLight", "crop_frame", "load_relighter"]

LIGHT_DRAWS = 16
MISFIT = 3.0  # grey levels of 255: what compression, pose and expression leave
ALIKE = 0.9  # cosine of the amounts of two photographs from which on their light is taken for one
FAINTEST = 1e-4  # amount of light below which a crop is black
FAINT = 0.003  # of the photograph's light: smaller amounts are the fit's own noise
MIXTURE_SIZE = 20.0  # degrees: the lights of a mixture stand about so far apart
CAMERA = torch.tensor([[0.0, 0.0, 1.0]])

Quality = Literal["draft", "standard", "reference"]
Renderer = Callable[[Tensor], Tensor]  # lights (Q, 3) -> maps (1, Q, h, w)


class SourceLight(NamedTuple):
    """A crop's own light: ``direction (3,)``, its middle, zero for a black crop; ``amounts (J,)`` of the bootstrap
    lights; ``image (h, w)``, the crop at unit strength of the light; ``noise (h, w)``, standard deviation of what that
    holds besides the face; ``belief``, how unsure the amounts are, None where the light is known or there is none."""

    direction: Tensor
    amounts: Tensor
    image: Tensor
    noise: Tensor
    belief: AmountsBelief | None

    def share(self, count: int) -> Tensor:
        """Amounts ``(count,)`` that sum to 1; of a known light all of the last, which it is."""
        total = self.amounts.sum()
        share = torch.nn.functional.pad(self.amounts / total.clamp_min(1e-12), (0, count - len(self.amounts)))
        if self.belief is not None or float(total) == 0:
            return share
        return torch.nn.functional.one_hot(torch.tensor(count - 1), count).to(share)


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
    ) -> None:
        if method not in RELIGHTING_METHODS:
            raise ValueError(f"method: expected one of {', '.join(RELIGHTING_METHODS)}, got {method!r}")
        self.relighter, self.frame = relighter, crop_frame(relighter)
        self.lights = relighter.statistics.lights.cpu()  # pictures stay on the CPU, whatever device the model is on
        self.luminance, self.mask = _luminance(crops[0]), face_mask(crops[0], self.frame)
        self.rotation = np.eye(3) if rotation is None else _relative(rotation, _looks_up(relighter))
        turn = torch.from_numpy(self.rotation).float()
        known = None if source_light is None else unit_lights(source_light.reshape(3).to(turn) @ turn)
        own = self._source(self.luminance, self.mask, known)
        sources, mask = [own], self.mask
        for crop in crops[1:]:
            other = face_mask(crop, self.frame)
            sources.append(_sharing(own, self._source(_luminance(crop), other, None)))
            mask = torch.minimum(mask, other)
        self._mean, self._variance = self._conditioned(sources, mask, known, method)
        self.source_light = turn @ own.direction
        # The new lamp is as strong as keeps the face's brightness when it stands at the camera.
        self.exposure = 1.0
        at_camera = float((torch.from_numpy(self.radiance(CAMERA.numpy())[0]) * self.mask).sum())
        self.exposure = float((self.luminance * self.mask).sum()) / max(at_camera, 1e-6) or 1.0
        self.light = self._mixture(own.amounts)

    def _mixture(self, amounts: Tensor) -> LightMixture:
        """The photograph's own light in units of a lamp that keeps its brightness."""
        kept = amounts > FAINT * amounts.sum()
        if not kept.any():
            return LightMixture(
                CAMERA.clone(), torch.zeros(1, 3), torch.full((1,), MIXTURE_SIZE), torch.zeros(1, dtype=torch.long)
            )
        count = int(kept.sum())
        weights = (amounts[kept] / self.exposure)[:, None].expand(-1, 3).contiguous()
        directions = self.lights[kept] @ torch.from_numpy(self.rotation.T).float()
        return LightMixture(
            directions, weights, torch.full((count,), MIXTURE_SIZE), torch.zeros(count, dtype=torch.long)
        )

    def _conditioned(
        self, sources: list[SourceLight], mask: Tensor, known: Tensor | None, method: Method
    ) -> tuple[Renderer, Renderer]:
        """What renders the person of the ``sources``, and its variance, under any light; ``known (3,)``, the light of
        the first where it is no estimate."""
        images, noise = (torch.stack(part) for part in zip(*((s.image, s.noise) for s in sources), strict=True))
        directions = self.lights if known is None else torch.cat((self.lights, known[None]))
        amounts = torch.stack([s.share(len(directions)) for s in sources])  # (K, n)
        light = LightSum(directions, amounts)
        if method == "mle":
            fixed = MaximumLikelihood(self.relighter.statistics, images, light, noise.flatten(1), mask)
            return (lambda target: fixed.relight(target).mean[None]), (
                lambda target: fixed.relight(target).variance[None]
            )
        point = self.relighter.condition(images[None], light, mask=mask[None], noise=noise[None])
        unsure = [index for index, source in enumerate(sources) if source.belief is not None]
        if not unsure:
            return (point.mean if method == "expected" else point.mode), point.variance

        @cache
        def integrated() -> Posterior:
            """Over what is not known of the lights: the thesis warns of a point estimate's variance (3.4.1)."""
            factor = torch.cat([s.belief.factor for s in sources if s.belief is not None], 1)  # (1, K', J, m)
            belief = AmountsBelief(LightSum(self.lights, amounts[None, unsure, : len(self.lights)]), factor.cpu())
            drawn = amounts.repeat(LIGHT_DRAWS, 1, 1)  # (M, K, n)
            drawn[:, unsure, : len(self.lights)] = belief.draw_sums(LIGHT_DRAWS, None, False).amounts[0]
            hypotheses = LightSum(directions, drawn[None])
            return self.relighter.condition(images[None], hypotheses, mask=mask[None], noise=noise[None])

        return (
            point.mean if method == "expected" else lambda target: integrated().mode(target),
            lambda target: integrated().variance(target),
        )

    def _source(self, luminance: Tensor, mask: Tensor, known: Tensor | None) -> SourceLight:
        """The light of one crop; with a ``known`` direction that alone, as strong as the fit says."""
        statistics = self.relighter.statistics
        if known is None:
            belief = self.relighter.soft_estimator().locate(luminance[None, None], mask[None])
            amounts = belief.light.amounts[0, 0].cpu()
        else:
            belief, average = None, prior_mean(statistics, statistics.lights).unflatten(1, statistics.size).cpu()
            amounts = fit_soft_light(average, luminance, mask)
        strength = float(amounts.sum())
        scale = torch.full_like(luminance, 1 / strength if strength >= FAINTEST else 1.0)
        if strength < FAINTEST:
            belief, amounts, direction = None, torch.zeros_like(amounts), torch.zeros(3)
        elif known is None:
            direction = torch.nn.functional.normalize(amounts @ self.lights, dim=0)
        else:
            direction = known
            nearest = int((self.lights @ known).argmax())
            amounts = torch.zeros_like(amounts).index_fill(0, torch.tensor(nearest), strength)
        return SourceLight(direction, amounts, luminance * scale, self._noise(scale), belief)

    def _noise(self, scale: Tensor) -> Tensor:
        """Standard deviation of the errors of a photograph whose radiance was multiplied by ``scale (h, w)``."""
        return scale * math.hypot(self.relighter.noise, MISFIT) / 255

    def crops(self, lights: Tensor) -> Tensor:
        """The aligned face under unit ``lights (Q, 3)``, scene radiance before exposure, ``(Q, h, w)``."""
        return self._mean(lights.to(self.relighter.statistics.lights))[0].cpu()

    def radiance(self, directions: np.ndarray) -> np.ndarray:
        """The head as it is turned, exposed like the photograph and never negative: ``directions (P, 3)`` to ``(P, h,
        w)``.

        Light from behind the head comes from its nearest side.
        """
        return (self.crops(self._from_head(directions)).clamp_min(0) * self.exposure).numpy()

    def std(self, direction: np.ndarray) -> np.ndarray:
        """Standard deviation of :meth:`radiance` under one light ``(3,)``, ``(h, w)``."""
        light = self._from_head(direction[None]).to(self.relighter.statistics.lights)
        return (self._variance(light)[0, 0].sqrt() * self.exposure).cpu().numpy()

    def _from_head(self, directions: np.ndarray) -> Tensor:
        """``directions (P, 3)`` as the head sees them, none from behind it."""
        front = directions.astype(np.float64) @ self.rotation
        front[:, 2] = np.maximum(front[:, 2], 0)
        front /= np.maximum(np.linalg.norm(front, axis=1, keepdims=True), 1e-6)
        return torch.from_numpy(front.astype(np.float32))

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


def _sharing(first: SourceLight, other: SourceLight) -> SourceLight:
    """``other`` under the very light of ``first`` where the two cannot be told apart: estimates differ by more than
    lights of one session do."""
    alike = torch.cosine_similarity(first.amounts, other.amounts, dim=0)
    if first.belief is None or float(alike) < ALIKE:
        return other
    return other._replace(amounts=first.amounts * (other.amounts.sum() / first.amounts.sum()))


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
