"""The thesis's own ways, beside which the package's are measured: (5.2) to the letter, and poses between 45 poses."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerelight.numerics.gaussian import NumericalWarning
from facerelight.numerics.kernels import kernel_weights
from facerelight.viewpoint.pose import BootstrapViews, View
from facerelight.viewpoint.regions import GroupRelighter
from facerelight.viewpoint.views import ViewFields

__all__ = ["POSES", "GridViews", "PrintedGroups"]

POSES = tuple(View(float(a), e) for a in np.linspace(-90, 90, 15) for e in (-10.0, 0.0, 20.0))
"""The 45 poses of 5.6."""
NOISE = 4e-6  # variance of a pixel that a view does not share with another


class PrintedGroups(GroupRelighter):
    """The thesis's (5.2) as it is printed, for one input; best with the sample covariance.

    It inverts ``S1 C_n S1^T + C_v0``, with the deviation's covariance at the output light, where it must be ``C_v1``;
    its variances may come out negative, which is not warned of.
    """

    def _read(self, images: Tensor, views: list[Any], target: Any) -> tuple[Tensor, Tensor, Tensor]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            return super()._read(images, views, target)

    def _covariance(self, fields: Tensor, local: Tensor, outputs: Tensor, inputs: Tensor) -> Tensor:
        right = super()._covariance(fields, local, outputs, inputs)
        swapped = torch.stack((fields[0], fields[1][[0, 0]]))
        r = outputs.shape[1]
        right[:, r:, r:] = super()._covariance(swapped, local[:1, :1].expand_as(local), outputs, inputs)[:, r:, r:]
        return right


class GridViews:
    """Poses between those of :data:`POSES`, by kernel regression (5.6).

    Args:
        source: renders the 45 poses.
        width: of the kernel in degrees.
    """

    def __init__(self, source: BootstrapViews, width: float) -> None:
        self.source, self.width = source, width
        self.grid = torch.stack([source.images(view).flatten(1) for view in POSES])  # (45, N, P)
        self.angles = torch.tensor([[view.azimuth, view.elevation] for view in POSES])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.source.size

    def fields(self, views: Sequence[View]) -> ViewFields:
        """People under poses, interpolated."""
        at = torch.tensor([[view.azimuth, view.elevation] for view in views])
        weights = kernel_weights(torch.cdist(at, self.angles).square(), self.width)
        images = torch.einsum("vg,gnp->vnp", weights, self.grid)
        mean = images.mean(1)
        same = torch.tensor([[float(a == b) for b in views] for a in views])
        return ViewFields(mean, (images - mean[:, None])[None], NOISE * same[..., None].expand(-1, -1, mean.shape[1]))
