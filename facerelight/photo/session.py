"""A colour photograph under a new light, at its own resolution; what is not the face stays as it is.

sRGB is decoded to linear light first and encoded last. The face is relit at the canonical crop; the ratio of relit to input goes back
to the photo's own pixels, so detail and colour are the photo's. Where the input is too dark for a ratio, the model's own prediction fills in.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import kornia
import numpy as np
import torch
from PIL import Image
from torch import Tensor

from facerelight.alignment import CropFrame, fit_similarity, warp_from_crop, warp_to_crop
from facerelight.config import default_statistics_folder, quality_config
from facerelight.covariance import prior_mean
from facerelight.illumination import KernelIlluminationEstimator, fit_soft_light, quasi_normal
from facerelight.lights import angles_from_light, light_from_angles
from facerelight.mle import MaximumLikelihood
from facerelight.photo.face_mask import face_mask
from facerelight.photo.landmarks import find_landmarks
from facerelight.relighter import METHODS, Method, StatisticalRelighter

__all__ = ["PhotoRelighter", "crop_frame", "load_relighter", "relight"]

DARK = 0.05  # linear radiance below which a ratio would only amplify noise
LARGEST_RATIO = 4.0
LIGHT_DRAWS = 16

Quality = Literal["draft", "standard", "reference"]
Renderer = Callable[[Tensor], Tensor]  # lights (Q, 3) -> maps (1, Q, h, w)
LUMA = (0.2126, 0.7152, 0.0722)


def load_relighter(quality: Quality = "standard", cache: str | None = None) -> StatisticalRelighter:
    """The relighter with the cached statistics of a quality, see :data:`facerelight.config.QUALITIES`.

    Raises:
        ValueError: an unknown quality.
        RuntimeError: they have not been trained yet; says which command does it.
    """
    folder = default_statistics_folder(quality_config(quality), cache)
    if not (folder / "statistics.safetensors").exists():
        command = "facerelight train" if quality == "standard" else f"facerelight relight PHOTO --quality {quality}"
        raise RuntimeError(f"statistics: none of quality {quality!r} in {folder}; train them once with `{command}`")
    return StatisticalRelighter.from_pretrained(folder)


def relight(
    photo: np.ndarray | Image.Image,
    azimuth: float = 0.0,
    elevation: float = 0.0,
    landmarks: Tensor | np.ndarray | list[tuple[float, float]] | None = None,
    relighter: StatisticalRelighter | None = None,
    quality: Quality = "standard",
) -> np.ndarray | Image.Image:
    """Relight the face in a photo.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB, as a NumPy array or a Pillow image.
        azimuth: degrees, where the new light stands; positive at image-left.
        elevation: degrees; positive above.
        landmarks: three (x, y) pixel pairs: eye centre at image-left, eye centre at image-right, mouth centre; None finds them.
        relighter: default: the one with the cached statistics of ``quality`` (``facerelight train`` makes them).
        quality: "draft", "standard" or "reference": coarser statistics of fewer heads, or finer ones of more.

    Returns:
        The relit photo, of the type and size that came in. For many lights, use :class:`PhotoRelighter`.

    Raises:
        ValueError: a photo or landmarks that cannot be used.
        RuntimeError: no statistics yet, or no face found.

    Example:
        >>> from skimage.data import astronaut  # doctest: +SKIP
        >>> relight(astronaut(), azimuth=-60, elevation=20).shape  # doctest: +SKIP
        (512, 512, 3)
    """
    array = np.asarray(photo.convert("RGB")) if isinstance(photo, Image.Image) else photo
    relit = PhotoRelighter(array, landmarks, relighter, quality=quality).render(azimuth, elevation)
    return Image.fromarray(relit) if isinstance(photo, Image.Image) else relit


def crop_frame(relighter: StatisticalRelighter) -> CropFrame:
    """The crop that a relighter's statistics are of."""
    height, width = relighter.statistics.size
    margin = float(relighter.statistics.metadata.get("config", {}).get("margin", 0.0))  # type: ignore[attr-defined]
    return CropFrame(height, width, margin)


class PhotoRelighter:
    """One photo, conditioned once and rendered under as many lights as wanted.

    Args:
        photo: ``(H, W, 3)`` uint8 sRGB, or float sRGB-coded in 0..1.
        landmarks: as for :func:`relight`.
        relighter: as for :func:`relight`.
        source_light: ``(3,)`` unit vector where the photo's light is known; None estimates it.
        more: further photos of the same person, as evidence; their landmarks and lights are found.
        method: "expected": the mean under the estimated lights; "map": the most probable image, the lights' own uncertainty counted in;
            "mle": n without a prior, from three photos or more under different lights.
        quality: as for :func:`relight`.

    Raises:
        ValueError: a photo or landmarks that cannot be used, or too few photos for the method.
    """

    def __init__(
        self,
        photo: np.ndarray,
        landmarks: Tensor | np.ndarray | list[tuple[float, float]] | None = None,
        relighter: StatisticalRelighter | None = None,
        source_light: Tensor | None = None,
        more: Sequence[np.ndarray] = (),
        method: Method = "expected",
        quality: Quality = "standard",
    ) -> None:
        self.relighter = relighter or load_relighter(quality)
        self.frame = crop_frame(self.relighter)
        self.coded, self.landmarks, self.matrix, crop = self._align(photo, landmarks)
        self.linear = kornia.color.rgb_to_linear_rgb(self.coded)
        self.luminance, self.mask = _luminance(crop), face_mask(crop[0], self.frame)
        self.source_light, equivalent = self._single_light(self.luminance, self.mask, source_light)
        evidence, mask = [(equivalent, self.source_light)], self.mask
        for other in more:
            crop = self._align(other, None)[3]
            other_mask = face_mask(crop[0], self.frame)
            light, equivalent = self._single_light(_luminance(crop), other_mask, None)
            evidence.append((equivalent, light))
            mask = torch.minimum(mask, other_mask)
        images, lights = (torch.stack(parts) for parts in zip(*evidence, strict=True))
        self._mean, self._variance = self._conditioned(images, lights, mask, method)
        # The new lamp is as strong as keeps the face's brightness when it stands at the camera.
        at_camera = self._mean(torch.tensor([[0.0, 0.0, 1.0]]))[0, 0].clamp_min(0)
        self.exposure = float((self.luminance * self.mask).sum() / (at_camera * self.mask).sum().clamp_min(1e-6)) or 1.0

    def _align(self, photo: np.ndarray, landmarks: Tensor | np.ndarray | list[tuple[float, float]] | None) -> tuple[Tensor, ...]:
        """sRGB-coded ``(1, 3, H, W)``, landmarks, the matrix into the crop, and the linear crop ``(1, 3, h, w)``."""
        coded = _as_float(photo)
        if landmarks is None:
            landmarks = find_landmarks((coded * 255).round().astype(np.uint8))
        points = _check_landmarks(landmarks, coded.shape)
        matrix = fit_similarity(points, self.frame.landmarks)[None]
        image = torch.from_numpy(np.ascontiguousarray(coded)).permute(2, 0, 1)[None]
        return image, points, matrix, warp_to_crop(kornia.color.rgb_to_linear_rgb(image), matrix, self.frame)

    def _conditioned(self, images: Tensor, lights: Tensor, mask: Tensor, method: Method) -> tuple[Renderer, Renderer]:
        """What renders the person of ``images (K, h, w)``, and its variance, under any light."""
        if method not in METHODS:
            raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {method!r}")
        if method == "mle":
            fixed = MaximumLikelihood(self.relighter.statistics, images, lights)
            return (lambda target: fixed.relight(target).mean[None]), (lambda target: fixed.relight(target).variance[None])
        if method == "expected":
            posterior = self.relighter.condition(images[None], lights, mask=mask[None])
            return posterior.mean, posterior.variance
        estimator = self.relighter.estimator
        spread = estimator.error_factor if isinstance(estimator, KernelIlluminationEstimator) else 0.1 * torch.eye(3)
        noise = quasi_normal(LIGHT_DRAWS, 3 * len(lights)).view(LIGHT_DRAWS, -1, 3)
        seen = lights.square().sum(-1, keepdim=True) > 0
        drawn = torch.nn.functional.normalize(lights + noise @ spread.T, dim=-1) * seen
        posterior = self.relighter.condition(images[None], drawn[None], mask=mask[None])
        return posterior.mode, posterior.variance

    def _single_light(self, luminance: Tensor, mask: Tensor, known: Tensor | None) -> tuple[Tensor, Tensor]:
        """The one light that comes nearest to the photo's own, and what the crop would look like under it at unit strength.

        Few photos are lit by one lamp. The photo's light is fitted as a mixture of lights on the average face, and the quotient of the
        average face under the mixture and under the one light (its middle) takes the crop from one to the other.
        """
        statistics = self.relighter.statistics
        size = statistics.size
        average = prior_mean(statistics, statistics.lights).unflatten(1, size)
        amounts = fit_soft_light(average, luminance, mask)
        strength = float(amounts.sum())
        if strength < 1e-4:
            return torch.zeros(3), luminance
        share = amounts / strength
        light = torch.nn.functional.normalize(share @ statistics.lights if known is None else known.reshape(3).to(share), dim=0)
        mixture = torch.tensordot(share, average.clamp_min(0), 1)
        single = prior_mean(statistics, light[None]).view(size).clamp_min(0)
        quotient = ((single + DARK) / (mixture + DARK)).clamp(1 / LARGEST_RATIO, LARGEST_RATIO)
        return light, luminance / strength * (quotient if known is None else 1)

    @property
    def source_angles(self) -> tuple[float, float]:
        """Azimuth and elevation in degrees of the middle of the photo's own light, as estimated or given; 0, 0 for a black photo."""
        if float(self.source_light.square().sum()) == 0:
            return 0.0, 0.0
        azimuth, elevation = angles_from_light(self.source_light)
        return float(azimuth), float(elevation)

    def crops(self, lights: Tensor) -> Tensor:
        """The aligned face under unit ``lights (Q, 3)``, linear radiance before exposure, ``(Q, h, w)``."""
        return self._mean(lights)[0]

    @torch.inference_mode()
    def render(self, azimuth: float, elevation: float) -> np.ndarray:
        """The photo with its face lit from ``azimuth``, ``elevation`` (degrees): ``(H, W, 3)`` uint8 sRGB."""
        target = light_from_angles(float(azimuth), float(elevation))[None]
        relit = self.crops(target)[0].clamp_min(0) * self.exposure
        # Fine detail is the photo's own: the ratio is taken between slightly smoothed images.
        smooth, base = kornia.filters.gaussian_blur2d(torch.stack((relit, self.luminance))[None], (9, 9), (1.5, 1.5))[0]
        ratio = (smooth / base.clamp_min(DARK)).clamp_max(LARGEST_RATIO)
        rest = (smooth - ratio * base).clamp_min(0)  # what no ratio can bring out of the dark
        ratio, rest, mask = self._to_photo(ratio, rest, self.mask)
        color = (self.linear * mask).sum((2, 3), keepdim=True)
        color = color / (color * torch.tensor(LUMA)[:, None, None]).sum(1, keepdim=True).clamp_min(1e-6)
        changed = _soft_clip(self.linear * ratio + color * rest)
        mixed = self.linear + mask * (changed - self.linear)
        coded = torch.where(mask > 0, kornia.color.linear_rgb_to_rgb(mixed.clamp(0, 1)), self.coded)
        return (coded[0].permute(1, 2, 0) * 255).round().clamp(0, 255).byte().numpy()

    @torch.inference_mode()
    def std(self, azimuth: float, elevation: float) -> np.ndarray:
        """How unsure :meth:`render` is: the standard deviation of linear radiance, ``(H, W)`` float32, 0 outside the face."""
        target = light_from_angles(float(azimuth), float(elevation))[None]
        std = self._variance(target)[0, 0].sqrt() * self.exposure
        std, mask = self._to_photo(std, self.mask)
        return (std * mask).numpy()

    def _to_photo(self, *maps: Tensor) -> Tensor:
        """Maps of the crop on the photo's own pixels."""
        height, width = self.coded.shape[2:]
        return warp_from_crop(torch.stack(maps)[None], self.matrix, (height, width))[0]


def _luminance(crop: Tensor) -> Tensor:
    """Of a linear crop ``(1, 3, h, w)``, ``(h, w)``."""
    return (crop * torch.tensor(LUMA)[:, None, None]).sum(1)[0]


def _soft_clip(radiance: Tensor, knee: float = 0.8) -> Tensor:
    """Roll highlights off smoothly towards 1 instead of clipping them to flat white."""
    over = (radiance - knee).clamp_min(0) / (1 - knee)
    return torch.where(radiance > knee, knee + (1 - knee) * over / (1 + over), radiance)


def _as_float(photo: np.ndarray) -> np.ndarray:
    if photo.ndim != 3 or photo.shape[2] != 3 or min(photo.shape[:2]) < 8:
        raise ValueError(f"photo: expected (H, W, 3) of at least 8 x 8 pixels, got {photo.shape}")
    if photo.dtype == np.uint8:
        return photo.astype(np.float32) / 255
    if not np.issubdtype(photo.dtype, np.floating) or not np.isfinite(photo).all() or photo.min() < 0 or photo.max() > 1:
        raise ValueError(f"photo: expected uint8 or float in 0..1, got {photo.dtype} with values up to {photo.max():g}")
    return photo.astype(np.float32)


def _check_landmarks(landmarks: Tensor | np.ndarray | list[tuple[float, float]], shape: tuple[int, ...]) -> Tensor:
    points = torch.as_tensor(np.asarray(landmarks, dtype=np.float64))
    if points.shape != (3, 2):
        raise ValueError(f"landmarks: expected three (x, y) pairs, got shape {tuple(points.shape)}")
    height, width = shape[:2]
    inside = (points >= -0.5).all() and (points[:, 0] <= width - 0.5).all() and (points[:, 1] <= height - 0.5).all()
    if not inside:
        raise ValueError(f"landmarks: expected pixels inside the {width} x {height} photo, got {points.tolist()}")
    if points[0, 0] == points[1, 0] and points[0, 1] == points[1, 1]:
        raise ValueError("landmarks: expected two different eyes, got the same point twice")
    return points
