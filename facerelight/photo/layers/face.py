"""The aligned face taken apart: its own light, its normals and its reflectance, and how sure the model is of each."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from facerelight.geometry.lights import angular_distance
from facerelight.geometry.sums import LightSum
from facerelight.inference.posterior import Posterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.covariance import prior_mean
from facerelight.photo.layers.lambert import LambertSphere

__all__ = ["FaceParts", "take_apart"]

DRAWS = 12  # of the face's light
NORMAL_ERROR, REFLECTANCE_ERROR = 12.0, 0.14
"""By how much true normals (degrees) and true albedo (a share) differ from the model's beyond its own spread; found on
rendered heads of seed 101."""


class FaceParts(NamedTuple):
    """An aligned face ``(h, w)``, as the head's own frame sees it.

    ``light``: the most probable amounts ``(1, n)`` of the bootstrap lights; ``draws``: other likely ones ``(M, n)``, as
    bright; ``posterior``, which renders it, one person; unit ``normal (3, h, w)``; ``reflectance
    (h, w)``, of an unknown scale; ``normal_std (h, w)`` degrees, root mean square of the angle;
    ``reflectance_std (h, w)``, a share of the reflectance, the scale apart.
    """

    light: LightSum
    draws: LightSum
    posterior: Posterior
    normal: Tensor
    reflectance: Tensor
    normal_std: Tensor
    reflectance_std: Tensor

    @property
    def direction(self) -> Tensor:
        """The middle of the light, ``(3,)``; zero without any."""
        return normalize(self.light.vector[0], dim=0)

    @property
    def direction_std(self) -> float:
        """Root mean square angle of the middle about :attr:`direction`, degrees; 0 without any light."""
        if not bool(self.light.amounts.any()):
            return 0.0
        away = angular_distance(normalize(self.draws.vector, dim=-1), self.direction.expand(len(self.draws.amounts), 3))
        return float(away.double().square().mean().sqrt())


def take_apart(relighter: StatisticalRelighter, image: Tensor, mask: Tensor, noise: float) -> FaceParts:
    """Take the face of ``image (h, w)``, linear radiance, apart; ``mask (h, w)`` says where it is.

    The light is estimated with samples, and n is integrated over them. What all samples share, how bright light and
    face are, cannot be told from one photograph: reflectance has no scale of its own.

    Args:
        relighter: the model.
        image: aligned, of the statistics' size.
        mask: 0 to 1.
        noise: standard deviation of what the image holds besides the face, radiance.

    Raises:
        ValueError: shapes that do not fit, or values out of range.

    Example:
        >>> from facerelight.geometry.lights import even_hemisphere
        >>> from facerelight.model.statistics import FaceStatistics
        >>> statistics = FaceStatistics.fit(torch.rand(6, 12, 24, 21), even_hemisphere(12), rank=2, face_rank=2)
        >>> parts = take_apart(StatisticalRelighter(statistics, "face"), torch.rand(24, 21), torch.ones(24, 21), 0.01)
        >>> parts.normal.shape, parts.reflectance.shape
        (torch.Size([3, 24, 21]), torch.Size([24, 21]))
    """
    statistics = relighter.statistics
    images, masks = image[None, None], mask[None]
    belief = relighter.soft_estimator().locate(images, masks)
    light = LightSum(belief.light.directions, belief.light.amounts[0])  # (1, n)
    drawn = belief.draw_sums(DRAWS, None, False).amounts[0, :, 0]  # (M, n)
    average = prior_mean(statistics, statistics.lights).clamp_min(0) @ mask.flatten().to(statistics.lights)  # (n,)
    level = (drawn @ average).clamp_min(1e-12)
    draws = LightSum(light.directions, drawn * (light.amounts @ average / level)[:, None])
    posterior = relighter.condition(
        images,
        LightSum(draws.directions, draws.amounts[None, :, None]),
        mask=masks,
        noise=torch.full((1, 1), noise),
    )
    found = posterior.normals()
    domain = statistics.metadata.get("config", {}).get("domain", {})  # type: ignore[attr-defined]
    sphere = LambertSphere(statistics.lights, float(domain.get("side_light", 0.0)))
    n = found.mean[0].cpu()
    normal, reflectance = sphere.undo(n)
    normal_std, reflectance_std = _spread(n, found.covariance[0].cpu())
    return FaceParts(
        LightSum(light.directions.cpu(), light.amounts.cpu()),
        LightSum(draws.directions.cpu(), draws.amounts.cpu()),
        posterior,
        normal,
        reflectance,
        torch.hypot(normal_std, torch.tensor(NORMAL_ERROR)),
        torch.hypot(reflectance_std, torch.tensor(REFLECTANCE_ERROR)),
    )


def _spread(n: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Of ``n (3, h, w)`` with ``covariance (3, 3, h, w)``: how its direction varies, degrees, and its length, a share
    of it; ``(h, w)`` each."""
    size = torch.linalg.vector_norm(n.double(), dim=0).clamp_min(1e-6)
    along = n.double() / size
    radial = torch.einsum("dhw,dehw,ehw->hw", along, covariance.double(), along).clamp_min(0)
    whole = covariance.double().diagonal(dim1=0, dim2=1).sum(-1)
    across = (whole - radial).clamp_min(0).sqrt() / size
    return torch.rad2deg(across).clamp_max(90).float(), (radial.sqrt() / size).float()
