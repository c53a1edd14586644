"""How bright a person is next to the average face, read off images of known light: the unknown gain of statistics that
are learned with ``brightness``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.numerics.gaussian import safe_cholesky, solve_lower
from facerelight.numerics.kernels import error_correlation

__all__ = ["Gain", "read_gain", "reading_errors", "reading_weight"]

LEAST_READ = 1e-3  # of the average face's brightness
LEAST_SEEN = 1e-6  # of the average face's power
ERROR_REACH, OWN_ERROR = 0.95, 0.05  # of readings, on the unit sphere of lights


class Gain(NamedTuple):
    """``value ()``, by which a person's images are brighter than the model's; ``spread ()``, the standard deviation of
    its logarithm that is left after the images were seen (0: it is known); float64."""

    value: Tensor
    spread: Tensor


def read_gain(
    images: Tensor, expected: Tensor, spread: float, errors: Tensor, weight: Tensor, noise: Tensor | float = 0.0
) -> Gain:
    """The least-squares gain of each input, and of all together with what is known of people beforehand.

    An image without light, or without a pixel that counts, tells nothing.

    Args:
        images: ``(K, P)`` radiance of one person.
        expected: ``(K, P)``, the average face under the same lights.
        spread: of the logarithm of people's gains; 0: every gain is 1.
        errors: ``(K, K)``, covariance of the errors of the logarithms that are read, see :func:`reading_errors`.
        weight: ``(K, P)``, how much each pixel counts, see :func:`reading_weight`.
        noise: standard deviation of the images' noise, radiance, broadcast to ``(K, P)``.
    """
    one = images.new_ones((), dtype=torch.float64)
    if spread == 0:
        return Gain(one, torch.zeros_like(one))
    seen, counted = images.double(), weight.double() * expected.double()
    power, slope = (counted * expected).sum(1), (counted * seen).sum(1)  # (K,)
    tells = (power > LEAST_SEEN * expected.double().square().sum(1)) & (slope > LEAST_READ * power)
    if not tells.any():
        return Gain(one, spread * one)
    read = (slope[tells] / power[tells]).log()
    noisy = (counted * noise).square().sum(1)[tells] / slope[tells].square()
    factor = safe_cholesky(errors.double()[tells][:, tells] + torch.diag(noisy))
    ones, white = solve_lower(factor, torch.stack((torch.ones_like(read), read), 1)).unbind(1)
    precision = 1 / spread**2 + ones @ ones
    return Gain(torch.exp(ones @ white / precision), precision.rsqrt())


def reading_weight(expected: Tensor, noise: Tensor, mask: Tensor | None = None) -> Tensor:
    """How much each pixel counts where a gain is read, ``(K, P)``: less, the more ``noise`` it has beside the
    ``expected`` face, and as much as the ``mask (P,)`` says."""
    weight = 1 / (1 + noise.double().square() / expected.double().square().mean(1, keepdim=True).clamp_min(1e-12))
    return (weight if mask is None else weight * mask).expand_as(expected)


def reading_errors(
    noise: Tensor, lights: Tensor, expected: Tensor, weight: Tensor, loadings: Tensor | None = None
) -> Tensor:
    """Covariance ``(K, K)`` of the errors of the logarithms of gains, each read off one image.

    A reading errs with what people differ in besides brightness, and so alike under lights that are near each other. A
    part of the face averages less of that out than the whole, by as much as the whole-face loadings tell; without them,
    as if pixels differed on their own.

    Args:
        noise: ``(K,)``, standard deviation of a reading off a whole image.
        lights: ``(K, 3)``, unit vectors.
        expected, weight: see :func:`read_gain`.
        loadings: ``(K, k, P)`` under the lights.
    """

    def deviation(counted: Tensor) -> Tensor:  # counted (K, P), of the least-squares reading
        reading = counted / (counted * expected).sum(1, keepdim=True).clamp_min(1e-12)
        return (reading if loadings is None else (loadings @ reading[..., None])[..., 0]).norm(dim=1)

    wider = deviation(expected * weight.to(expected)) / deviation(expected).clamp_min(1e-12)
    deviations = (noise * wider).double()
    return deviations[:, None] * deviations * error_correlation(lights, ERROR_REACH, OWN_ERROR)
