"""Other poses and expressions (5.6, 7.3): the same Gaussian model, its statistics rendered on demand at exactly the
views asked for.

The thesis learns 45 poses and interpolates between them, which mixes neighbouring poses into ghosts. The bootstrap is
rendered, so its people can be seen at the very pose, light and expression of each input and of the output; nothing is
interpolated.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from facerelight.config import TrainConfig, cache_folder
from facerelight.geometry.lights import light_from_angles
from facerelight.model.file import replacing
from facerelight.numerics import gaussian
from facerelight.numerics.checks import check_noise
from facerelight.viewpoint.readings import Block, MixtureMethod, ViewSampler, choose_image, read_views
from facerelight.viewpoint.views import ViewFields, ViewSource
from facerelight.viewpoint.whole_face import Seen, face_of_views

__all__ = ["BootstrapViews", "View", "ViewRelighter", "ViewRelit"]


@dataclass(frozen=True)
class View:
    """What an image is taken under; angles in degrees.

    Args:
        azimuth, elevation: of the camera about the head; positive azimuth shows the side of the face at image-left of a
            frontal picture.
        light: azimuth and elevation of the light, relative to the camera.
        expression: names and weights in 0..1 of expression shapes, such as ``(("jawOpen", 0.6),)``.
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    light: tuple[float, float] = (0.0, 0.0)
    expression: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        angles = (self.azimuth, self.elevation, *self.light)
        if len(self.light) != 2 or not all(math.isfinite(angle) for angle in angles):
            raise ValueError(f"view: expected finite angles and a light's azimuth and elevation, got {self}")
        if max(abs(self.elevation), abs(self.light[1])) > 90:
            raise ValueError(f"view: expected elevations in [-90, 90], got {self}")
        if not all(0 <= weight <= 1 for _, weight in self.expression):
            raise ValueError(f"view: expected weights of expressions from 0 to 1, got {self.expression}")


class ViewRelit(NamedTuple):
    """``mean``, ``variance`` ``(B, H, W)``; ``code (B, k)``, what is known of each person; ``weight (B, S)`` of the
    readings of the inputs."""

    mean: Tensor
    variance: Tensor
    code: Tensor
    weight: Tensor


class BootstrapViews:
    """The rendered people of a training config under any view, on demand, cached on disk.

    Args:
        config: whose heads, paint and crop.
        cache: folder for rendered views; None: the user's cache.
        floor: least standard deviation of a pixel over people, in radiance.
        first: index of the first person (held-out people come after the bootstrap's).
    """

    def __init__(
        self, config: TrainConfig, cache: str | Path | None = None, floor: float = 2e-3, first: int = 0
    ) -> None:
        upright = replace(config.domain, turn=0.0, misalign=0.0)  # a view says how the head stands
        self.config, self.floor, self.first = replace(config, domain=upright), floor, first
        self.folder = Path(cache) if cache else cache_folder() / "views"

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.config.height, self.config.width

    def images(self, view: View) -> Tensor:
        """Every person under ``view``, ``(N, H, W)``, linear radiance; rendered at the first call."""
        world = replace(self.config, fit=type(self.config.fit)(), lights=4).identity()
        text = json.dumps([world, asdict(view), self.first], sort_keys=True)
        path = self.folder / f"{hashlib.sha256(text.encode()).hexdigest()[:20]}.npy"
        if not path.exists():
            rendered = self._render(view)
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as partial, partial.open("wb") as file:
                np.save(file, rendered.numpy())
        return torch.from_numpy(np.load(path, allow_pickle=False))

    def _render(self, view: View) -> Tensor:
        from facerelight.train.dataset import make_dataset

        light = light_from_angles(*view.light)[None]
        dataset = make_dataset(self.config, light, (view.azimuth, view.elevation), dict(view.expression))
        dataset.count += self.first
        return dataset.images(range(self.first, dataset.count))[:, 0]

    def fields(self, views: Sequence[View]) -> ViewFields:
        """Each person's difference from the mean under every view; their brightness is part of it."""
        images = torch.stack([self.images(view).flatten(1) for view in views])  # (V, N, P)
        mean = images.mean(1)
        same = torch.tensor([[float(a == b) for b in views] for a in views])
        local = self.floor**2 * same[..., None].expand(-1, -1, mean.shape[1])
        return ViewFields(mean, (images - mean[:, None])[None], local)


class ViewRelighter:
    """The whole-face model (a low-rank code shared by all pixels and all views, and a residual at each pixel) over
    views.

    Args:
        source: what the bootstrap's people look like under views.
        rank: of the code; 0 treats every pixel on its own, as the thesis does.
        temper: how many pixels count as one independent observation of the code.
        noise: standard deviation of what an input holds besides the face, in grey levels of 255; 0: inputs are returned
            exactly (Theorem 3).
    """

    def __init__(self, source: ViewSource, rank: int = 40, temper: float = 100.0, noise: float = 1.0) -> None:
        if rank < 0 or temper < 1:
            raise ValueError(f"views: expected rank >= 0 and temper >= 1, got {rank} and {temper}")
        self.source, self.rank, self.temper, self.noise = source, rank, temper, check_noise(noise)

    def __call__(
        self,
        images: Tensor,
        source_views: Sequence[Any] | None,
        target_view: Any,
        method: MixtureMethod = "expected",
        sampler: ViewSampler | None = None,
        draws: int = 32,
        generator: torch.Generator | None = None,
    ) -> ViewRelit:
        """Render ``images (B, K, H, W)`` of B persons under ``target_view``: the conditional mean and variance (5.3 to
        5.5).

        Args:
            images: linear radiance; the k-th image of everybody was taken under the same view, where that is known.
            source_views: for each image its view (a :class:`View`, or a light ``(3,)`` of :class:`LightViews`) or,
                where that is unknown, a list of candidates (or lights ``(M, 3)``), or None. Every combination of
                candidates is a reading of the inputs; the readings count by their tempered evidence, person by person.
                None (instead of all of them, too): drawn from ``sampler``, and the draws count alike.
            target_view: what to render.
            method: "expected", the mean image (5.5); "map", the most probable grey levels (5.4), then in ``mean``; the
                same where all views are known.
            sampler: draws unknown views, such as a :class:`~facerelight.viewpoint.pose_sampler.PoseSampler`.
            draws: how many sets of them.
            generator: makes the draws another set.
        """
        drawn = read_views(images, source_views, self.source.size, sampler, draws, generator)
        if not len(images):
            empty = images.new_zeros(0, *self.source.size)
            return ViewRelit(empty, empty, images.new_zeros(0, self.rank), images.new_zeros(0, 1))
        parts = [[self._block(block, target_view) for block in blocks] for blocks in drawn]  # draws, blocks
        mean, variance, code, weight = (
            torch.cat([torch.cat([block[i] for block in blocks], 1) for blocks in parts]) for i in range(4)
        )  # (S, B, ...)
        weight = weight / len(parts)
        chosen, spread = choose_image(mean, variance, weight, method)
        chosen, spread = (image.to(images).unflatten(1, self.source.size) for image in (chosen, spread))
        code = torch.einsum("sb,sbk->bk", weight, code)
        return ViewRelit(chosen, spread, code.to(images), weight.T.to(images))

    def _block(self, block: Block, target: Any) -> tuple[Tensor, ...]:
        """Of C readings: output mean and variance ``(C, B, P)``, code ``(C, B, k)``, and what each counts beside the
        others, ``(C, B)``."""
        read = [self._read(block.images, reading, target) for reading in block.readings]
        mean, variance, code, evidence = (torch.stack(part) for part in zip(*read, strict=True))
        return mean, variance, code, torch.softmax(evidence, 0)

    def _read(self, images: Tensor, views: Sequence[Any], target: Any) -> tuple[Tensor, ...]:
        """For one reading of the inputs ``(B, K, P)``: output mean and variance ``(B, P)``, code ``(B, k)``, tempered
        log evidence ``(B,)``; (5.6) with the whole face."""
        known = self.source.fields([target, *views])
        gains = known.gains(images, self.noise)
        face = face_of_views(known, self.rank)
        average, outputs, own = face.mean[0], face.loadings[:, 0], face.covariance[:, 0, 0]  # (P,), (P, k), (P,)
        results = []
        for index, person in enumerate(images):
            gain, unsure = (part[min(index, len(part) - 1)] for part in gains)
            seen = Seen.of(face, person, gain, self.noise, self.temper)
            cross = gaussian.solve_lower(seen.factor, face.covariance[:, 1:, :1])  # (P, K, 1)
            left = outputs - (cross * seen.inputs).sum(1)  # D, (P, k)
            mean, black = (average[:, None] + left @ seen.code + (cross * seen.white).sum(1)).T
            variance = gaussian.positive_variance(own - cross.square().sum((1, 2)), own)
            variance = variance + (left @ seen.spread).square().sum(-1) + unsure.square() * black.square()
            variance = gain.square() * variance + self.noise**2
            results.append(((gain * mean).clamp_min(0), variance, seen.code[:, 0], seen.evidence))
        mean, variance, code, evidence = (torch.stack(part) for part in zip(*results, strict=True))
        return mean, variance, code, evidence
