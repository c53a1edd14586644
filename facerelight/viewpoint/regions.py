"""Several pixels at a time (5.5): which go together, and relighting them by one joint Gaussian a group (5.1, 5.2,
5.6)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from facerelight.numerics.checks import check_finite, check_index, check_noise, check_shape
from facerelight.numerics.gaussian import condition_gaussian, positive_variance
from facerelight.numerics.shrinkage import KINDS, Shrinkage, shrunk_covariance
from facerelight.viewpoint.readings import Block, MixtureMethod, ViewSampler, choose_image, read_views
from facerelight.viewpoint.views import ViewSource

__all__ = [
    "GroupRelighter",
    "GroupRelit",
    "Region",
    "correlation_table",
    "group_by_correlation",
    "make_regions",
    "random_groups",
]

GROUPS_AT_ONCE = 256


class Region(NamedTuple):
    """T groups of one size: the pixels rendered together, ``outputs (T, r_out)``, and those they are rendered from,
    ``inputs (T, r_in)``."""

    outputs: Tensor
    inputs: Tensor


class GroupRelit(NamedTuple):
    """``mean``, ``variance`` ``(B, H, W)``; ``log_det (G,)``, the logarithm of det C_m of every group, on average over
    persons and readings: what is left unknown (5.5.1)."""

    mean: Tensor
    variance: Tensor
    log_det: Tensor


def correlation_table(samples: Tensor) -> Tensor:
    """Absolute correlations ``(P, P)`` between the pixels of samples ``(S, P)``, the lookup table of Algorithm 3; 4 P^2
    bytes."""
    unit = _unit(samples)
    return (unit.T @ unit).abs()


def group_by_correlation(samples: Tensor, size: int, table: Tensor | None = None) -> list[Tensor]:
    """Algorithm 3: the first pixel left and the ``size - 1`` pixels most correlated with it, again and again.

    Args:
        samples: bootstrap images, one a row, ``(S, P)``.
        size: pixels a group; the last group may be smaller.
        table: of :func:`correlation_table`; None: each row when it is needed. The groups are the same.

    Returns:
        Pixel indices of each group; of equally correlated pixels (to 1e-5) the first comes first.
    """
    if size < 1:
        raise ValueError(f"size: expected at least 1 pixel a group, got {size}")
    unit = _unit(samples)
    left = torch.ones(samples.shape[1], dtype=torch.bool)
    groups = []
    while left.any():
        current = int(left.int().argmax())
        row = (unit.T @ unit[:, current]).abs() if table is None else table[current].clone()
        row = (row * 1e5).round()
        row[current] = torch.inf
        row[~left] = -1
        chosen = row.argsort(descending=True, stable=True)[: min(size, int(left.sum()))]
        left[chosen] = False
        groups.append(chosen)
    return groups


def random_groups(pixels: int, size: int, generator: torch.Generator | None = None) -> list[Tensor]:
    """A random partition into groups of ``size`` pixels, the last one maybe smaller (the first heuristic of 5.5.1)."""
    if pixels < 1 or size < 1:
        raise ValueError(f"groups: expected at least 1 pixel, and 1 a group, got {pixels} and {size}")
    return list(torch.randperm(pixels, generator=generator).split(size))


def make_regions(groups: Sequence[Tensor], samples: Tensor | None = None, inputs: int | None = None) -> list[Region]:
    """Groups of one size stacked, each with the pixels that it is rendered from.

    Args:
        groups: a partition of the pixels.
        samples: bootstrap images ``(S, P)``, wanted where ``inputs`` is given.
        inputs: ``r_in``, at least the group's size: the group itself and the pixels most correlated with its first.
            None: ``r_in = r_out``.
    """
    if not len(groups) or any(not len(group) for group in groups):
        raise ValueError(f"groups: expected one or more of a pixel or more each, got {len(groups)} with an empty one")
    pixels = 1 + max(int(group.max()) for group in groups) if samples is None else samples.shape[-1]
    for group in groups:
        check_index(group, "groups", "r_out", pixels)
    unit = None if samples is None else _unit(samples)
    sized: dict[int, list[tuple[Tensor, Tensor]]] = {}
    for group in groups:
        source = group
        if inputs is not None and inputs != len(group):
            if unit is None or inputs < len(group):
                raise ValueError(
                    f"inputs: expected at least the group's {len(group)} pixels,"
                    f" and samples to choose more, got {inputs}"
                )
            row = (unit.T @ unit[:, int(group[0])]).abs()
            row[group] = -1
            source = torch.cat((group, row.argsort(descending=True, stable=True)[: inputs - len(group)]))
        sized.setdefault(len(group), []).append((group, source))
    return [Region(*(torch.stack(parts) for parts in zip(*members, strict=True))) for members in sized.values()]


class GroupRelighter:
    """Conditional mean and variance of groups of pixels given groups of pixels, for any K, r_in, r_out and any kind of
    view, known or not: Table 5.1.

    Args:
        source: what the bootstrap's people look like under views.
        regions: of :func:`make_regions`; together they cover every pixel once.
        shrinkage: of the joint covariance of a group: "sample" as the thesis, which turns to noise from a few pixels
            on; "block" towards single pixels, which keeps Consistency; "ledoit_wolf" and "oas" towards the identity.
        noise: standard deviation of what an input holds besides the face, in grey levels of 255; 0: inputs are returned
            exactly (Theorem 3).

    Raises:
        ValueError: regions that leave a pixel out or render one twice, or an unknown shrinkage.
    """

    def __init__(
        self, source: ViewSource, regions: Sequence[Region], shrinkage: Shrinkage = "block", noise: float = 1.0
    ) -> None:
        _check_partition(regions, source.size[0] * source.size[1])
        if shrinkage not in KINDS:
            raise ValueError(f"shrinkage: expected one of {', '.join(KINDS)}, got {shrinkage!r}")
        self.source, self.regions, self.shrinkage = source, regions, shrinkage
        self.noise = check_noise(noise)

    def __call__(
        self,
        images: Tensor,
        source_views: Sequence[Any] | None,
        target_view: Any,
        method: MixtureMethod = "expected",
        sampler: ViewSampler | None = None,
        draws: int = 32,
        generator: torch.Generator | None = None,
    ) -> GroupRelit:
        """Render ``images (B, K, H, W)`` of B persons, taken under the K ``source_views``, under ``target_view``.

        Args:
            images: linear radiance; the k-th image of everybody was taken under the same view, where that is known.
            source_views: one an image, None (or a light of NaN) where it is unknown; None: all are.
            target_view: what to render.
            method: "expected", the mean image (Algorithm 2); "map", the most probable grey levels (Algorithm 1); the
                same where all views are known.
            sampler: draws unknown views, person by person; a light estimator, for lights.
            draws: how many sets of them.
            generator: makes the draws another set.
        """
        drawn = read_views(images, source_views, self.source.size, sampler, draws, generator)
        if not len(images):
            empty = images.new_zeros(0, *self.source.size)
            return GroupRelit(empty, empty, images.new_zeros(0, dtype=torch.float64))
        readings = [[self._read(*_only(block), target_view) for block in blocks] for blocks in drawn]
        mean, variance = (torch.stack([torch.cat([r[i] for r in blocks]) for blocks in readings]) for i in (0, 1))
        log_det = torch.stack([r[2] for blocks in readings for r in blocks]).mean(0)
        weight = mean.new_full(mean.shape[:2], 1 / len(mean))
        chosen, spread = choose_image(mean, variance, weight, method)
        chosen, spread = (image.to(images).unflatten(1, self.source.size) for image in (chosen, spread))
        return GroupRelit(chosen, spread, log_det)

    def _read(self, images: Tensor, views: list[Any], target: Any) -> tuple[Tensor, Tensor, Tensor]:
        """(5.6) for known views: mean and variance of ``images (B, K, P)`` under ``target``, ``(B, P)``, and
        ``log_det (G,)``; what is linear in the inputs is that of their gains taken off."""
        known = self.source.fields([target, *views])
        gain, unsure = known.gains(images, self.noise)  # (B,), or (1,) where all are alike
        average = known.mean[0].double()
        seen = images / gain.to(images)[:, None, None] - known.mean[1:]  # (B, K, P)
        residual = torch.stack((seen, (-known.mean[1:]).expand_as(seen))).double()  # and of black inputs, (2, B, K, P)
        mean = average.expand(2, len(images), -1).clone()
        variance = mean.new_zeros(len(gain), len(average))
        step = max(1, GROUPS_AT_ONCE // len(images))  # each person has a factor
        log_det = []
        for region in self.regions:
            for outputs, inputs in zip(region.outputs.split(step), region.inputs.split(step), strict=True):
                covariance = self._covariance(known.fields, known.local, outputs, inputs)  # (T, D, D)
                r = outputs.shape[1]
                own, cross = covariance[:, :r, :r], covariance[:, :r, r:]
                noise = (self.noise / gain).square()[:, None, None, None]
                noisy = covariance[:, r:, r:] + noise * torch.eye(cross.shape[2]).to(cross)  # (B, T, K r_in, K r_in)
                y = residual[..., inputs].transpose(2, 3).flatten(3)  # (2, B, T, K r_in), view by view
                given = condition_gaussian(own.new_zeros(r), y.new_zeros(y.shape[3]), own, cross, noisy, y)
                mean[..., outputs] += given.mean
                left = given.covariance.diagonal(dim1=2, dim2=3)  # (B, T, r_out)
                variance[:, outputs] = positive_variance(left, own.diagonal(dim1=1, dim2=2))
                log_det.append(torch.linalg.eigvalsh(given.covariance).clamp_min(1e-12).log().sum(-1).mean(0))
        image, black = mean
        gain, unsure = gain[:, None], unsure[:, None]
        variance = gain.square() * (variance + unsure.square() * black.square()) + self.noise**2
        return (gain * image).clamp_min(0), variance, torch.cat(log_det)

    def _covariance(self, fields: Tensor, local: Tensor, outputs: Tensor, inputs: Tensor) -> Tensor:
        """Joint covariances (5.6) of the outputs and of all inputs, ``(T, D, D)`` with ``D = r_out + K r_in``."""
        views, people = fields.shape[1:3]
        pixel = torch.cat((outputs, inputs.repeat(1, views - 1)), 1)  # (T, D)
        view = torch.cat(
            (torch.zeros(outputs.shape[1]), torch.arange(1, views).repeat_interleave(inputs.shape[1]))
        ).long()
        parts = (part[view[None].expand_as(pixel), :, pixel].mT.double() for part in fields)  # (T, N, D) each
        covariance = torch.stack([shrunk_covariance(part, self.shrinkage, pixel) for part in parts]).sum(0) * (
            people / (people - 1)
        )
        same = pixel[:, :, None] == pixel[:, None]
        return covariance + torch.where(same, local[view[:, None], view[None], pixel[:, :, None]].double(), 0.0)


def _only(block: Block) -> tuple[Tensor, list[Any]]:
    """The images of a block, and their views."""
    if len(block.readings) != 1:
        raise ValueError(
            "views: expected one an image, got lists of candidates; give None and a sampler where they are unknown"
        )
    return block.images, block.readings[0]


def _check_partition(regions: Sequence[Region], pixels: int) -> None:
    """Every pixel is rendered once, from pixels that exist."""
    times = torch.zeros(pixels, dtype=torch.long)
    for region in regions:
        outputs = check_index(region.outputs, "region outputs", "T r_out", pixels)
        inputs = check_index(region.inputs, "region inputs", "T r_in", pixels)
        if len(inputs) != len(outputs):
            raise ValueError(f"regions: expected inputs for each of {len(outputs)} groups, got {len(inputs)}")
        times += outputs.flatten().cpu().bincount(minlength=pixels)
    left, twice = int((times == 0).sum()), int((times > 1).sum())
    if left or twice:
        raise ValueError(
            f"regions: expected every one of {pixels} pixels once, got {left} in none and {twice} in several;"
            " make them of a partition with make_regions"
        )


def _unit(samples: Tensor) -> Tensor:
    """Columns centred and of unit length; zero where a pixel never varies."""
    check_finite(check_shape(samples, "samples", "S P"), "samples", "images as rows")
    if len(samples) < 2:
        raise ValueError(f"samples: expected two or more images as rows (S, P), got {tuple(samples.shape)}")
    centred = samples - samples.mean(0)
    return centred / centred.norm(dim=0).clamp_min(1e-12)
