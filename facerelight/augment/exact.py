"""The exact path: what the fast one is measured against, and what a relit training set on disk is made with."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from facerelight.augment.crop_relighter import UNSEEN, CropRelighter, Radiances, Source
from facerelight.augment.source import find_source_lights, front_lights
from facerelight.geometry.sums import LightSum
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.covariance import prior_mean
from facerelight.photo.face_model import MISFIT, crop_frame, wobble

__all__ = ["ExactRelighter"]


class ExactRelighter(CropRelighter):
    """Radiance of aligned faces under new lights by the model itself, at its own resolution and in each crop's own
    light; otherwise like :class:`~facerelight.augment.quick.QuickRelighter`.

    Args:
        relighter: the model.
    """

    def __init__(self, relighter: StatisticalRelighter) -> None:
        statistics = relighter.statistics
        super().__init__(statistics.size, 1, crop_frame(relighter).margin, statistics.n_mean)
        self.relighter = [relighter]  # in a list: no part of the state
        self.average = prior_mean(statistics, statistics.lights)

    def forward(
        self, luminance: Tensor, mask: Tensor, targets: list[LightSum], source: Source = "estimate"
    ) -> Radiances:
        """See :meth:`CropRelighter.forward`."""
        relighter = self.relighter[0]
        statistics = relighter.statistics
        seen, shown = (part.to(self.average).flatten(1) for part in (luminance, mask))
        find = front_lights if source == "front" else find_source_lights
        own = find(self.average, statistics.lights, seen, shown)
        strength = own.strength.clamp_min(1e-4)[:, None]
        single = prior_mean(statistics, own.direction)
        quotient = own.equivalent(self.average, single) / strength
        noise = (quotient * math.hypot(relighter.noise, MISFIT) / 255).square() + wobble(statistics, own.direction)
        noise = (noise + UNSEEN**2 * (1 - shown).clamp(0, 1)).sqrt()
        posterior = relighter.condition(
            (seen * quotient).unflatten(1, self.full_size)[:, None],
            own.direction[:, None],
            mask=mask.to(self.average).expand(len(seen), -1, -1),
            noise=noise.unflatten(1, self.full_size)[:, None],
        )
        lights = [LightSum(statistics.lights.expand(len(seen), -1, -1), own.share), *targets]
        maps = [posterior.mean(light.to(self.average).insert(1))[:, 0] for light in lights]
        gains = torch.stack([person.evidence[0].gain.value for person in posterior.people]).to(self.average)
        explained = gains[:, None] * self._explained(own.share, posterior.code())
        explained = explained.clamp_min(0).unflatten(1, self.full_size)
        bright = strength[..., None, None]
        found = Radiances(torch.stack(maps, 1) * bright, explained * bright[:, 0], own.known)
        return Radiances(*(part.to(luminance.device) for part in found))

    def _explained(self, share: Tensor, code: Tensor) -> Tensor:
        """What average face and code ``(B, k)`` make of lights that are ``share (B, J)`` of the bootstrap's,
        ``(B, P)``."""
        statistics = self.relighter[0].statistics
        average = prior_mean(statistics, LightSum(statistics.lights, share))
        if statistics.face is None:
            return average
        face = statistics.face
        of_light = torch.cat(
            (share @ statistics.lights, share @ statistics.weights(statistics.lights) @ face.basis.T), 1
        )
        loadings = torch.cat((face.n, face.v), 1).flatten(2)  # (k, 3 + m, P)
        return average + torch.einsum("bk,bf,kfp->bp", code, of_light, loadings)
