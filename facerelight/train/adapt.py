"""Adapt rendered statistics to a few people's photographs: a conjugate update of means and covariances.

The rendered heads are the prior. Each new person's photographs are completed to all bootstrap lights by the model
itself (the E step of EM). The update is that of a normal-inverse-Wishart model, written as a bootstrap of two groups:
the completed people, and the rendered heads, moved so that the mean of all is the posterior mean. So every statistic,
loadings and cross-validated residuals included, is learned as ever.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import kornia
import torch
from torch import Tensor

from facerelight.geometry.alignment import CANONICAL_LANDMARKS, CANONICAL_SIZE, CropFrame, fit_similarity, warp_to_crop
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.estimator import LightEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.luminance import LUMINANCE
from facerelight.photo.faces.landmarks import find_landmarks
from facerelight.photo.files.disk import find_people, read_photo

__all__ = ["Person", "adapt", "read_people"]

LABEL = re.compile(r"A([+-]\d{3})E([+-]\d{2})")
OUTLINE = 1.05  # how far a photo is taken for a face, in units of the face's outline


class Person(NamedTuple):
    """Aligned photographs of one person: ``images (K, H, W)`` linear radiance; ``lights (K, 3)``, rows of NaN where
    unknown; ``mask (H, W)``, 1 where all of them show the face."""

    images: Tensor
    lights: Tensor
    mask: Tensor


def read_people(folder: str | Path, frame: CropFrame) -> list[Person]:
    """Photographs for :func:`adapt`, ``NAME.jpg`` or ``NAME/*.jpg``, brought into ``frame``.

    A photo of the canonical crop's proportions (168 wide, 192 high, in any size) is taken for an aligned one; in others
    landmarks are found. A light is known where the file's name holds its angles in Extended Yale B's manner,
    ``A+035E+40``: azimuth 35, elevation 40.

    Raises:
        ValueError: no photos, an unreadable one, or one without a face; says which.
    """
    people = []
    for photos in find_people(folder).values():
        images, lights, masks = [], [], []
        for path in photos:
            image, mask = _read_aligned(path, frame)
            label = LABEL.search(path.name)
            images.append(image)
            masks.append(mask)
            lights.append(light_from_angles(float(label[1]), float(label[2])) if label else torch.full((3,), torch.nan))
        people.append(Person(torch.stack(images), torch.stack(lights), torch.stack(masks).amin(0)))
    return people


def _read_aligned(path: Path, frame: CropFrame) -> tuple[Tensor, Tensor]:
    """Luminance in linear radiance ``(H, W)`` of the frame, and where the photo shows the face."""
    coded = torch.from_numpy(read_photo(path).rgb).permute(2, 0, 1)[None]
    height, width = coded.shape[2:]
    scale = height / CANONICAL_SIZE[0]
    if abs(width - scale * CANONICAL_SIZE[1]) < 1:
        landmarks = (torch.tensor(CANONICAL_LANDMARKS, dtype=torch.float64) + 0.5) * scale - 0.5
    else:
        try:
            landmarks = find_landmarks((coded[0].permute(1, 2, 0) * 255).round().byte().numpy())
        except RuntimeError as error:
            raise ValueError(f"{path}: {error}") from error
    matrix = fit_similarity(landmarks, frame.landmarks)[None]
    linear = kornia.color.rgb_to_linear_rgb(coded)
    grey = (linear * torch.tensor(LUMINANCE).to(linear)[:, None, None]).sum(1, keepdim=True)
    inside = warp_to_crop(
        torch.nn.functional.pad(torch.ones(1, 1, height, width), (1, 1, 1, 1)), _after_padding(matrix), frame
    )[0, 0]
    return warp_to_crop(grey, matrix, frame)[0, 0], ((inside > 0.99) & (frame.oval() < OUTLINE)).float()


def _after_padding(matrix: Tensor) -> Tensor:
    """``matrix`` for an image with one more pixel on every side."""
    return torch.cat((matrix[..., :2], matrix[..., 2:] - matrix[..., :2].sum(-1, keepdim=True)), -1)


def adapt(
    statistics: FaceStatistics,
    people: list[Person],
    estimator: LightEstimator | None = None,
    prior_heads: float = 2.0,
) -> FaceStatistics:
    """Statistics of the rendered heads and ``people`` together.

    Args:
        statistics: solved, and still keeping their images.
        people: one or more, the more lights each the better.
        estimator: finds lights that are unknown; None: the statistics' own likelihood.
        prior_heads: how many people the rendered mean counts for; the rendered covariance counts for as many as there
            are heads.

    Returns:
        New statistics under the same lights, in memory; ``statistics`` stay as they are.

    Raises:
        RuntimeError: the statistics were loaded, and their images are not kept.
        ValueError: nobody to adapt to, or images of another size.
    """
    if statistics.store is None:
        raise RuntimeError(
            "adapt: these statistics were loaded, and the images they came from are not kept;"
            " train with `adapt` instead"
        )
    if not people:
        raise ValueError("adapt: expected one person or more, got none")
    if prior_heads <= 0:
        raise ValueError(f"prior_heads: expected more than 0, got {prior_heads}")
    relighter = StatisticalRelighter(statistics, "pixel" if statistics.face is None else "face", estimator)
    rendered_mean = statistics.mean_images()
    completed = [_complete(relighter, person) for person in people]
    gains = [_gain(images, rendered_mean) for images in completed]
    mean = torch.stack([images / gain for images, gain in zip(completed, gains, strict=True)]).mean(0)
    heads, count = len(statistics.store), len(people)
    posterior_mean = (prior_heads * rendered_mean + count * mean) / (prior_heads + count)
    # So that all of them together have that mean.
    move = ((heads + count) * posterior_mean - count * mean) / heads - rendered_mean
    adapted = FaceStatistics(statistics.lights, statistics.options)
    for array in statistics.store:
        images = torch.from_numpy(array.copy())
        adapted.update(images + _gain(images, rendered_mean) * move, ~images[:, 0, 0].isnan())
    for images in completed:
        adapted.update(images)
    adapted.metadata = {**statistics.metadata, "adapted_to": len(people)}
    return adapted.solve()


def _complete(relighter: StatisticalRelighter, person: Person) -> Tensor:
    """A person's image under every bootstrap light, ``(J, H, W)``: the photograph where there is one, else the model's
    mean."""
    lights = relighter.statistics.lights
    complete = (
        relighter.condition(person.images[None], person.lights[None], draws=8, mask=person.mask[None])
        .mean(lights)[0]
        .clamp_min(0)
    )
    known = ~person.lights.isnan().any(1)
    for image, light in zip(person.images[known], person.lights[known], strict=True):
        same = (lights - torch.nn.functional.normalize(light, dim=0)).norm(dim=1) < 1e-3
        complete[same] = torch.where(person.mask > 0.5, image, complete[same])
    return complete


def _gain(images: Tensor, mean: Tensor) -> Tensor:
    """Brightness of ``images`` beside ``mean``, least squares over all lights that exist."""
    there = ~images[:, 0, 0].isnan()
    return (images[there] * mean[there]).sum() / mean[there].square().sum()
