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
from facerelight.model.subjects import face_operators
from facerelight.numerics import gaussian
from facerelight.viewpoint.views import ViewFields, ViewSource, check_view_images

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
        """Each person's difference from the mean under every view."""
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
    """

    def __init__(self, source: ViewSource, rank: int = 40, temper: float = 100.0) -> None:
        if rank < 0 or temper < 1:
            raise ValueError(f"views: expected rank >= 0 and temper >= 1, got {rank} and {temper}")
        self.source, self.rank, self.temper = source, rank, temper

    def __call__(self, images: Tensor, source_views: Sequence[Any], target_view: Any) -> ViewRelit:
        """Render ``images (B, K, H, W)`` of B persons under ``target_view``: the conditional mean and variance (5.3 to
        5.5).

        Args:
            images: linear radiance; the k-th image of everybody was taken under the same view.
            source_views: for each image its view (a :class:`View`, or a light ``(3,)`` of :class:`LightViews`) or,
                where that is unknown, a list of candidates (or lights ``(M, 3)``). Every combination is a reading of
                the inputs; the readings are averaged with their tempered evidence as weights (5.5), person by person.
            target_view: what to render.
        """
        size = self.source.size
        check_view_images(images, source_views, size)
        readings: list[list[Any]] = [[]]
        for view in source_views:
            readings = [[*r, v] for r in readings for v in _candidates(view)]
        parts = [self._read(images.flatten(2), reading, target_view) for reading in readings]
        means, variances, codes, evidence = (torch.stack(part) for part in zip(*parts, strict=True))  # (S, B, ...)
        weight = torch.softmax(evidence, 0)
        mean = torch.einsum("sb,sbp->bp", weight, means)
        variance = torch.einsum("sb,sbp->bp", weight, variances + (means - mean).square())
        code = torch.einsum("sb,sbk->bk", weight, codes)
        return ViewRelit(
            mean.to(images).unflatten(1, size),
            variance.to(images).unflatten(1, size),
            code.to(images),
            weight.T.to(images),
        )

    def _read(self, images: Tensor, views: Sequence[View], target: View) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """For one reading of the inputs ``(B, K, P)``: output mean and variance ``(B, P)``, code ``(B, k)``, tempered
        log evidence ``(B,)``."""
        known = self.source.fields([target, *views])
        fields = known.fields.sum(0).double()  # (V, N, P)
        people = fields.shape[1]
        operators = face_operators(torch.einsum("vnp,vmp->nm", fields, fields), min(self.rank, people - 2))
        loadings = torch.einsum("kn,vnp->pvk", operators.loadings.double(), fields)
        residual = torch.einsum("mn,vnp->pvm", operators.residual.double(), fields)
        covariance = residual @ residual.mT / people + known.local.permute(2, 0, 1).double()  # (P, V, V)
        factor = gaussian.safe_cholesky(covariance[:, 1:, 1:])
        inputs = gaussian.solve_lower(factor, loadings[:, 1:])  # (P, K, k)
        cross = gaussian.solve_lower(factor, covariance[:, 1:, :1])  # (P, K, 1)
        left = loadings[:, 0] - (cross * inputs).sum(1)  # D, (P, k)
        own = gaussian.positive_variance(covariance[:, 0, 0] - cross.square().sum((1, 2)), covariance[:, 0, 0])
        volume = 2 * factor.diagonal(dim1=1, dim2=2).log().sum()
        results = []
        if not len(images):
            empty = images.new_zeros(0, images.shape[2], dtype=torch.float64)
            return empty, empty, empty.new_zeros(0, inputs.shape[2]), empty.new_zeros(0)
        for person in images:
            white = gaussian.solve_lower(factor, (person - known.mean[1:]).double().T[..., None])  # (P, K, 1)
            code, spread = gaussian.low_rank_code(inputs, white, self.temper)
            mean = known.mean[0].double() + (left @ code)[:, 0] + (cross * white).sum((1, 2))
            missed = (white - inputs @ code).square().sum() + self.temper * code.square().sum()
            evidence = -0.5 * (missed + volume - 2 * self.temper * spread.diagonal().log().sum()) / self.temper
            results.append((mean, own + (left @ spread).square().sum(-1), code[:, 0], evidence))
        mean, variance, code, evidence = (torch.stack(part) for part in zip(*results, strict=True))
        return mean, variance, code, evidence


def _candidates(view: Any) -> list[Any]:
    """The views that one input may have been taken under: one, or those of a list; a light is a view, not a list."""
    listed = isinstance(view, list | tuple) and not (len(view) and isinstance(view[0], int | float))
    several = list(view) if listed or (isinstance(view, Tensor) and view.dim() == 2) else [view]
    if not several:
        raise ValueError("views: expected a view or several candidates for every image, got none")
    return several
