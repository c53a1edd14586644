"""Where a face is turned to, told by the model itself: the likelihood of an image under candidate views, and draws from
it (5.4, 5.5). It follows the protocol of :class:`~facerelight.light.estimator.LightEstimator`, with views for lights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.numerics.checks import check_noise, check_radiance
from facerelight.numerics.sampling import quasi_normal
from facerelight.viewpoint.pose import View
from facerelight.viewpoint.views import ViewSource
from facerelight.viewpoint.whole_face import Seen, face_of_views

__all__ = ["PoseBelief", "PoseSampler", "views_about"]

STEP = 1.0  # degrees: views that are drawn nearer to each other are one, and are rendered once


def views_about(
    view: View,
    spread: tuple[float, float],
    count: int = 16,
    generator: torch.Generator | None = None,
    independent: bool = False,
) -> list[View]:
    """``count`` candidates about a ``view`` that is known roughly: normal in azimuth and elevation with a standard
    deviation of ``spread`` degrees, to whole degrees, so that many fall together.

    Raises:
        ValueError: a spread or a count that are none.
    """
    if min(spread) < 0 or count < 1:
        raise ValueError(f"views: expected spreads of 0 or more degrees and 1 view or more, got {spread}, {count}")
    turned = quasi_normal(count, 2, generator, independent).double() * torch.tensor(spread).double()  # (count, 2)
    about = torch.tensor([view.azimuth, view.elevation], dtype=torch.float64)
    at = torch.where(turned != 0, (((about + turned).clamp(-90, 90)) / STEP).round() * STEP, about)
    return [View(azimuth, elevation, view.light, view.expression) for azimuth, elevation in at.tolist()]


class PoseBelief(NamedTuple):
    """``probability (B, K, R)`` of each of R ``views`` of K images of B persons, float64."""

    probability: Tensor
    views: Sequence[View]

    def draw(self, count: int, generator: torch.Generator | None, independent: bool) -> list[list[list[View]]]:
        """``count`` sets of views, ``(B, count, K)``: quasi-random, about one a ``1 / count`` of the probability, or
        ``independent`` draws."""
        inputs = self.probability.shape[1]
        level = torch.special.ndtr(quasi_normal(count, inputs, generator, independent).double())  # (count, K)
        level = level.T.expand(len(self.probability), -1, -1).contiguous()  # (B, K, count)
        chosen = torch.searchsorted(self.probability.cumsum(2), level).clamp_max(len(self.views) - 1)
        return [[[self.views[r] for r in one] for one in person] for person in chosen.transpose(1, 2).tolist()]


class PoseSampler:
    """Draws the views of images from ``Pr(view | image)``, every one of ``candidates`` being equally likely beforehand.

    Args:
        source: what the bootstrap's people look like under views.
        candidates: such as :func:`views_about` a rough guess; one that is listed twice counts twice.
        rank, temper, noise: of the whole-face model, see :class:`~facerelight.viewpoint.pose.ViewRelighter`.

    Example:
        >>> from facerelight.config import TrainConfig
        >>> from facerelight.viewpoint.pose import BootstrapViews
        >>> guess = views_about(View(azimuth=20), spread=(8, 3))
        >>> sampler = PoseSampler(BootstrapViews(TrainConfig()), guess)
    """

    def __init__(
        self,
        source: ViewSource,
        candidates: Sequence[View],
        rank: int = 40,
        temper: float = 100.0,
        noise: float = 1.0,
    ) -> None:
        if not len(candidates):
            raise ValueError("candidates: expected one view or more, got none; try views_about")
        self.source, self.candidates = source, list(candidates)
        self.rank, self.temper, self.noise = rank, temper, check_noise(noise)

    def locate(self, images: Tensor) -> PoseBelief:
        """The posterior over the candidates, image by image."""
        check_radiance(images, "images", "B K H W", self.source.size)
        flat = images.flatten(0, 1).flatten(1)  # (B K, P)
        evidence: dict[View, list[Tensor]] = {}
        for view in self.candidates:
            if view not in evidence:
                known = self.source.fields([view])
                face = face_of_views(known, self.rank)
                gains = (known.gains(image[None, None], self.noise).value[0] for image in flat)
                evidence[view] = [
                    Seen.of(face, image[None], gain, self.noise, self.temper).evidence
                    for image, gain in zip(flat, gains, strict=True)
                ]
        table = [torch.stack(evidence[view]) if len(flat) else flat.new_zeros(0).double() for view in self.candidates]
        return PoseBelief(torch.softmax(torch.stack(table, 1), 1).unflatten(0, images.shape[:2]), self.candidates)

    def sample(
        self, images: Tensor, count: int, generator: torch.Generator | None = None, independent: bool = False
    ) -> list[list[list[View]]]:
        """Draw ``count`` views an image from what :meth:`locate` believes, ``(B, count, K)``.

        Raises:
            ValueError: images or a count that are none.
        """
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"count: expected at least 1 view an image, got {count!r}")
        return self.locate(images).draw(count, generator, independent)
