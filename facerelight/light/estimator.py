"""What an estimator of light is: it tells where the light of an image is and how unsure it is of that; the rest is
shared.

To add one, subclass :class:`LightEstimator` and implement :meth:`~LightEstimator.locate`; where its error is Gaussian,
return a :class:`GaussianBelief`. It then serves as ``estimator=`` of a relighter.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from facerelight.geometry.sums import LightSum
from facerelight.numerics.buffers import LearnedModule
from facerelight.numerics.checks import check_mask, check_radiance
from facerelight.numerics.gaussian import safe_cholesky
from facerelight.numerics.kernels import error_correlation
from facerelight.numerics.sampling import quasi_normal

__all__ = ["GaussianBelief", "LightBelief", "LightEstimate", "LightEstimator", "shared_errors"]

ERROR_REACH = 0.95  # on the unit sphere: correlations of 0.98, 0.77, 0.45 at 11, 40, 75 degrees, as 60 rendered heads
OWN_ERROR = 1e-5  # of an error's variance: half a degree apart, held-out heads share 0.99997 of it


class LightEstimate(NamedTuple):
    """``direction (B, K, 3)``: unit vectors towards the light, the bias already taken off; zero for an image without
    any light."""

    direction: Tensor


class LightBelief(Protocol):
    """A distribution over the lights of ``(B, K)`` images."""

    @property
    def direction(self) -> Tensor:
        """Its mean direction, ``(B, K, 3)`` unit vectors; zero for an image without any light."""
        ...

    def draw(self, count: int, generator: torch.Generator | None, independent: bool) -> Tensor:
        """``count`` lights of any length, ``(B, count, K, 3)``: quasi-random, or ``independent`` draws."""
        ...


class GaussianBelief(NamedTuple):
    """Normal about ``direction (B, K, 3)`` with covariance ``L L^T``, ``error_factor (3, 3)`` being L."""

    direction: Tensor
    error_factor: Tensor

    def draw(self, count: int, generator: torch.Generator | None, independent: bool) -> Tensor:
        """See :meth:`LightBelief.draw`; everybody gets the same deviations, which :func:`shared_errors` ties
        together."""
        inputs = self.direction.shape[1]
        noise = quasi_normal(count, 3 * inputs, generator, independent).reshape(count, inputs, 3).to(self.direction)
        noise = torch.einsum("bjk,mkc->bmjc", shared_errors(self.direction), noise)
        return self.direction[:, None] + noise @ self.error_factor.T.to(self.direction)  # (B, count, K, 3)


def shared_errors(directions: Tensor) -> Tensor:
    """How the errors of one person's lights go together: a lower factor ``(B, K, K)`` of their correlation
    ``exp(-d^2 / 2 ERROR_REACH^2)``, d the distance between the lights ``directions (B, K, 3)``.

    An estimator is wrong about a light mostly because of the person, and so alike for lights that are near each other:
    two images under nearly one light must not be taken for images under two.
    """
    return safe_cholesky(error_correlation(directions, ERROR_REACH, OWN_ERROR)).to(directions)


class LightEstimator(LearnedModule):
    """Finds the light of images; subclasses implement :meth:`locate`."""

    def locate(self, images: Tensor, mask: Tensor | None) -> LightBelief:
        """What is known of the light of each of ``images (B, K, H, W)``; ``mask (B, H, W)`` is 0 where they do not show
        the face, None: everywhere they do."""
        raise NotImplementedError(f"{type(self).__name__}: expected a method locate(images, mask)")

    def forward(self, images: Tensor, mask: Tensor | None = None) -> LightEstimate:
        """Estimate the light of each of ``images (B, K, H, W)``; ``mask (B, H, W)`` is 0 where they do not show the
        face."""
        return LightEstimate(self._located(images, mask).direction.to(images))

    def sample(
        self,
        images: Tensor,
        count: int,
        generator: torch.Generator | None = None,
        independent: bool = False,
        mask: Tensor | None = None,
    ) -> Tensor:
        """Draw ``count`` lights an image from what :meth:`locate` believes, put on the sphere (4.3);
        ``(B, count, K, 3)``.

        Quasi-random by default; ``independent=True`` draws as the thesis does. The same ``generator`` state gives the
        same lights. An image without any light has zero ones.

        Raises:
            ValueError: images, a mask or a count that are none.
        """
        if not isinstance(count, int) or count < 1:
            raise ValueError(f"count: expected at least 1 light an image, got {count!r}")
        belief = self._located(images, mask)
        drawn = nn.functional.normalize(belief.draw(count, generator, independent), dim=-1)  # (B, count, K, 3)
        lit = belief.direction[:, None].square().sum(-1, keepdim=True) > 0  # (B, 1, K, 1)
        return (drawn * lit).to(images)

    def sample_sums(
        self,
        images: Tensor,
        count: int,
        generator: torch.Generator | None = None,
        independent: bool = False,
        mask: Tensor | None = None,
    ) -> LightSum:
        """As :meth:`sample`, but each a sum of directions, amounts ``(B, count, K, n)``; here of one, and an image
        without any light has amounts of zero."""
        return LightSum.single(self.sample(images, count, generator, independent, mask))

    def _located(self, images: Tensor, mask: Tensor | None) -> LightBelief:
        check_radiance(images, "images", "B K H W")
        if mask is not None:
            mask = check_mask(mask, "mask", "B H W", (len(images), *images.shape[2:]))
        return self.locate(images, mask)
