"""Views of the inputs that are not known: drawn from what is believed of them, and the mixture of Gaussians that the
output image then follows (3.6), of which the expected image (Algorithm 2, 5.5) or the most probable one (Algorithm 1,
5.4) is shown.

A *reading* is one answer to the question which views the inputs were taken under.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, Literal, NamedTuple, Protocol, get_args

import torch
from torch import Tensor

from facerelight.numerics.checks import check_radiance
from facerelight.numerics.mixture import mixture_mode

__all__ = ["Block", "MixtureMethod", "ViewSampler", "choose_image", "is_known", "read_views"]

MixtureMethod = Literal["expected", "map"]
"""The mean image (Algorithm 2, 5.5) or the most probable grey levels (Algorithm 1, 5.4)."""


class ViewSampler(Protocol):
    """Something that draws the views of images from ``Pr(views | images)``: a
    :class:`~facerelight.light.estimator.LightEstimator` where views are lights, a
    :class:`~facerelight.viewpoint.pose_sampler.PoseSampler` where they are poses."""

    def sample(
        self, images: Tensor, count: int, generator: torch.Generator | None = None, independent: bool = False
    ) -> Sequence[Sequence[Sequence[Any]]]:
        """``count`` equally likely sets of views of each person's ``images (B, K, H, W)``, ``(B, count, K)``; a zero
        light takes its image out of the evidence."""
        ...


class Block(NamedTuple):
    """Some persons with one set of readings: ``images (B', K', P)`` and ``readings``, C lists of K' views."""

    images: Tensor
    readings: list[list[Any]]


def is_known(view: Any) -> bool:
    """Whether a view was given: None and a light of NaN were not."""
    return view is not None and not (isinstance(view, Tensor) and bool(view.isnan().any()))


def read_views(
    images: Tensor,
    source_views: Sequence[Any] | None,
    size: tuple[int, int],
    sampler: ViewSampler | None = None,
    draws: int = 32,
    generator: torch.Generator | None = None,
) -> list[list[Block]]:
    """Equally likely draws of the views of ``images (B, K, H, W)``; the blocks of each draw hold everybody once.

    Where every view is given there is one draw of one block. The arguments are those of
    :class:`~facerelight.viewpoint.regions.GroupRelighter`.

    Raises:
        ValueError: images or views that are none, or unknown ones without a ``sampler``.
    """
    check_radiance(images, "images", "B K H W", size)
    views = [None] * images.shape[1] if source_views is None else source_views
    if not isinstance(views, Sequence) and not (isinstance(views, Tensor) and views.dim()):
        raise ValueError(f"views: expected one for each of {images.shape[1]} images, got {views!r}")
    if len(views) != images.shape[1] or not images.shape[1]:
        raise ValueError(
            f"images: expected (B, K, {size[0]}, {size[1]}) and K >= 1 views,"
            f" got {tuple(images.shape)} and {len(views)} views"
        )
    flat = images.flatten(2)
    if all(is_known(view) for view in views):
        return [[_lit(flat, list(views))]]
    if sampler is None:
        raise ValueError("views: expected all of them, or a sampler to draw the unknown ones from; got neither")
    if not isinstance(draws, int) or draws < 1:
        raise ValueError(f"draws: expected at least 1, got {draws!r}")
    drawn = sampler.sample(images, draws, generator)  # (B, draws, K)
    return [
        [
            _lit(flat[b : b + 1], [v if is_known(v) else drawn[b][m][k] for k, v in enumerate(views)])
            for b in range(len(images))
        ]
        for m in range(draws)
    ]


def _combined(views: Sequence[Any]) -> list[list[Any]]:
    """Every combination of the candidates of each view."""
    return [list(reading) for reading in product(*(_candidates(view) for view in views))]


def _candidates(view: Any) -> list[Any]:
    """The views that one input may have been taken under: one, or those of a list; a light is a view, not a list."""
    listed = isinstance(view, list | tuple) and not (len(view) and isinstance(view[0], int | float))
    several = list(view) if listed or (isinstance(view, Tensor) and view.dim() == 2) else [view]
    if not several:
        raise ValueError("views: expected a view or several candidates for every image, got none")
    return several


def _lit(images: Tensor, views: list[Any]) -> Block:
    """``images (B, K, P)`` without those that were taken or drawn without any light."""
    kept = [k for k, view in enumerate(views) if not (isinstance(view, Tensor) and not view.any())]
    return Block(images[:, kept], _combined([views[k] for k in kept]))


def choose_image(mean: Tensor, variance: Tensor, weight: Tensor, method: MixtureMethod) -> tuple[Tensor, Tensor]:
    """The image that is shown of a mixture of S Gaussians at every pixel, and the mixture's variance, ``(B, P)`` each.

    Args:
        mean, variance: of the readings, ``(S, B, P)``.
        weight: of each reading, ``(S, B)``, summing to 1 over the readings.
        method: "expected": ``E[m]`` (5.5); "map": the most probable grey level (5.4), evaluated exactly. Of one reading
            they are the same.
    """
    if method not in get_args(MixtureMethod):
        raise ValueError(f"method: expected one of {', '.join(get_args(MixtureMethod))}, got {method!r}")
    expected = torch.einsum("sb,sbp->bp", weight, mean)
    total = torch.einsum("sb,sbp->bp", weight, variance + (mean - expected).square())
    if method == "expected" or len(mean) == 1:
        return expected, total
    people = zip(mean.unbind(1), variance.unbind(1), weight.unbind(1), strict=True)
    return torch.stack([mixture_mode(*person) for person in people]), total
