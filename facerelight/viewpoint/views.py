"""What the bootstrap's people look like under given viewing conditions, person by person: the common ground of groups
and of poses.

A *view* is whatever an image was taken under: a light, for :class:`LightViews`; a pose, a light and an expression for
:class:`~facerelight.viewpoint.pose.BootstrapViews`. Covariances between any pixels under any views follow from the
people's fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from facerelight.geometry.lights import unit_lights
from facerelight.model.brightness import Gain, read_gain, reading_errors, reading_weight
from facerelight.model.statistics import FaceStatistics
from facerelight.model.subjects import fill_missing, fill_operators, gather_grams, measure_brightness, total_gram

__all__ = ["LightViews", "ViewFields", "ViewSource"]


class ViewFields(NamedTuple):
    """N people under V views at P pixels, all brought to one brightness where theirs is an unknown of its own.

    ``mean (V, P)``; ``fields (M, V, N, P)``, each person's difference from it as the sum of M independent parts (n and
    v); ``local (V, V, P)``, covariance that views share at one pixel over and above the fields' own.
    ``Cov = sum_m fields_m^T fields_m / (N - 1) + [same pixel] local``. ``gain_spread ()``: of the logarithm of people's
    brightness (0: it is in the fields); ``gain_errors (V, V)``: covariance of the errors of reading it off one image.
    """

    mean: Tensor
    fields: Tensor
    local: Tensor
    gain_spread: Tensor = torch.tensor(0.0)
    gain_errors: Tensor = torch.ones(1, 1)

    def gains(self, images: Tensor, noise: float) -> Gain:
        """The gain of each person whose ``images (B, K, P)``, as noisy as ``noise`` says, are under the last K views;
        ``value`` and ``spread`` are ``(B,)``, or ``(1,)`` where everybody has the same."""
        first, spread = len(self.mean) - images.shape[1], float(self.gain_spread)
        expected, errors = self.mean[first:], self.gain_errors.expand(len(self.mean), len(self.mean))[first:, first:]
        weight = reading_weight(expected, torch.full_like(expected[:, :1], noise))
        people = images if spread else images[:1]
        read = [read_gain(person, expected, spread, errors, weight, noise) for person in people]
        return Gain(*(torch.stack(parts) for parts in zip(*read, strict=True)))


class ViewSource(Protocol):
    """Something that knows what people look like under views; ``size`` is the images' height and width."""

    @property
    def size(self) -> tuple[int, int]: ...

    def fields(self, views: Sequence[Any]) -> ViewFields: ...


ROUNDING = 1e-6  # of a unit vector's length


class LightViews:
    """Views that differ in light alone: n and v of every bootstrap person kept, so that pixels can be modelled several
    at a time.

    For one pixel at a time this is the model of :class:`StatisticalRelighter` with a correlation factor of full rank.

    Args:
        statistics: fitted in this process, so that its people's images are still at hand; where they were learned with
            ``brightness``, people are brought to one brightness here too.
    """

    def __init__(self, statistics: FaceStatistics) -> None:
        if statistics.store is None or statistics.pixel is None:
            raise ValueError("statistics: expected freshly fitted ones that keep their images; loaded ones do not")
        self.statistics = statistics
        height, width = statistics.size
        store, block = statistics.store, statistics.options.block
        grams = gather_grams(store, statistics.lights.cpu(), block)
        fill = fill_operators(grams)
        images = fill_missing(store.block(0, height * width), fill)  # (N, J, P)
        if statistics.options.brightness:
            gain = measure_brightness(store, total_gram(grams, fill), fill, block).gain
            images = images / gain[:, None, None]
        images = images.to(statistics.lights)
        n = torch.linalg.pinv(statistics.lights.double()).to(images) @ images
        v = images - statistics.lights @ n
        self._n, deviation = n - n.mean(0), v - v.mean(0)
        length = deviation.square().sum(0).sqrt()  # (J, P)
        dof, floor = len(n) - 1, statistics.options.floor
        self._std = (length / dof**0.5).clamp_min(floor)
        self._unit = torch.where(
            length > floor * dof**0.5, deviation / length.clamp_min(1e-30), torch.zeros_like(deviation)
        )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the images."""
        return self.statistics.size

    def fields(self, views: Sequence[Tensor] | Tensor) -> ViewFields:
        """Fields under lights ``(V, 3)``: ``n^T s`` and ``sigma(s) w(s).(v / sigma)`` (3.13, 4.5, 4.6)."""
        try:
            lights = torch.stack([torch.as_tensor(view).to(self.statistics.lights) for view in views])
        except (RuntimeError, TypeError, ValueError) as error:
            raise ValueError(f"views: expected a light (3,) each, got {views!r}") from error
        if lights.dim() != 2:
            raise ValueError(f"views: expected a light (3,) each, got {tuple(lights.shape[1:])}")
        length = torch.linalg.vector_norm(lights, dim=1, keepdim=True)
        lights = torch.where((length - 1).abs() < ROUNDING, lights, unit_lights(lights))
        weights = self.statistics.weights(lights)  # (V, J)
        std = (weights @ self._std.square()).sqrt()  # (V, P)
        mixed = torch.einsum("vj,njp->vnp", weights, self._unit)
        of_n = torch.einsum("vc,ncp->vnp", lights, self._n)
        of_v = (len(self._n) - 1) ** 0.5 * std[:, None] * mixed
        unique = 1 - self._unit.square().sum(0)  # (J, P): 1 where a pixel never varies, else 0
        own = mixed.square().sum(1) + weights.square() @ unique
        narrow = std * (1 - own).clamp_min(0).sqrt()
        local = torch.einsum("aj,bj,jp,ap,bp->abp", weights, weights, unique, std, std)
        local = local + self.statistics.nugget(lights, lights)[..., None] * narrow[:, None] * narrow[None]
        mean = lights @ self.statistics.n_mean.flatten(1) + weights @ self.statistics.v_mean.flatten(1)
        noise = weights @ self.statistics.gain_noise  # (V,)
        errors = reading_errors(noise, lights, mean, torch.ones_like(mean))
        return ViewFields(mean, torch.stack((of_n, of_v)), local, self.statistics.gain_spread, errors)
