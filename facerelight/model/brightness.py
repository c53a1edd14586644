"""How bright a person is next to the average face, read off images of known light: the unknown gain of statistics that
are learned with ``brightness``."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Gain", "read_gain", "reading_noise"]

LEAST_READ = 1e-3


class Gain(NamedTuple):
    """``value ()``, by which a person's images are brighter than the model's; ``spread ()``, the standard deviation of
    its logarithm that is left after the images were seen (0: it is known); float64."""

    value: Tensor
    spread: Tensor


def read_gain(images: Tensor, expected: Tensor, spread: float, noise: Tensor, weight: Tensor | None = None) -> Gain:
    """The least-squares gain of each input, shrunk towards 1 as its noise demands.

    Args:
        images: ``(K, P)`` radiance of one person.
        expected: ``(K, P)``, the average face under the same lights.
        spread: of the logarithm of people's gains; 0: every gain is 1.
        noise: ``(K,)``, that of the logarithm of a gain read off one image.
        weight: ``(P,)``, how much each pixel counts; None: all alike.
    """
    if spread == 0:
        one = images.new_ones((), dtype=torch.float64)
        return Gain(one, torch.zeros_like(one))
    weight = torch.ones_like(expected[0]) if weight is None else weight.to(expected)
    power = (expected.square() @ weight).clamp_min(1e-12)  # (K,)
    read = ((images * expected) @ weight / power).clamp_min(LEAST_READ).log().double()
    trust = 1 / noise.double().square()
    precision = 1 / spread**2 + trust.sum()
    return Gain(torch.exp((read * trust).sum() / precision), precision.rsqrt())


def reading_noise(noise: Tensor, expected: Tensor, loadings: Tensor, weight: Tensor) -> Tensor:
    """How unsure a gain is that is read off a part of the face, ``(K,)``, of its logarithm.

    A reading errs with what people differ in besides brightness. A part of the face averages less of that out than the
    whole, by as much as the whole-face loadings tell.

    Args:
        noise: ``(K,)``, of a gain read off whole images.
        expected: ``(K, P)``, the average face under the images' lights.
        loadings: ``(K, k, P)`` there.
        weight: ``(P,)``, how much each pixel counts.
    """

    def deviation(counted: Tensor) -> Tensor:  # counted (K, P), of the least-squares reading
        reading = counted / (counted * expected).sum(1, keepdim=True).clamp_min(1e-12)
        return (loadings @ reading[..., None])[..., 0].norm(dim=1)

    return noise * deviation(expected * weight.to(expected)) / deviation(expected).clamp_min(1e-6)
