"""Where the light comes from, by kernel regression on images (4.4), with the error that it is known to make (4.3)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from facerelight.geometry.lights import unit_lights
from facerelight.light.estimator import GaussianBelief, LightEstimator
from facerelight.numerics.checks import check_mask, check_radiance, check_shape, check_valid
from facerelight.numerics.gaussian import covariance_factor
from facerelight.numerics.kernels import kernel_weights, neighbour_widths
from facerelight.numerics.luminance import BLACK

__all__ = ["KernelIlluminationEstimator"]


class KernelIlluminationEstimator(LightEstimator):
    """Kernel regression from an image to its light (4.4), with the error that held-out people taught (4.3).

    Images are compared small and normalised in brightness, because cameras and flashes differ.

    Buffers: ``prototypes (R, D)`` unit vectors, ``prototype_lights (R, 3)``, ``widths (R,)``, ``bias (3,)``,
    ``error_factor (3, 3)``, ``weight (h, w)`` of the thumbnail's pixels in the comparison.

    Example:
        >>> lights = torch.nn.functional.normalize(torch.randn(12, 3), dim=-1)
        >>> estimator = KernelIlluminationEstimator.fit(torch.rand(4, 12, 24, 21), lights)
        >>> estimator(torch.rand(2, 1, 24, 21)).direction.shape
        torch.Size([2, 1, 3])
    """

    prototypes: Tensor
    prototype_lights: Tensor
    widths: Tensor
    bias: Tensor
    error_factor: Tensor
    weight: Tensor

    def __init__(
        self,
        prototypes: Tensor,
        prototype_lights: Tensor,
        widths: Tensor,
        bias: Tensor,
        error_factor: Tensor,
        weight: Tensor,
    ) -> None:
        super().__init__()
        for name, tensor in (
            ("prototypes", prototypes),
            ("prototype_lights", prototype_lights),
            ("widths", widths),
            ("bias", bias),
            ("error_factor", error_factor),
            ("weight", weight),
        ):
            self.register_buffer(name, tensor)
        count, pixels = len(prototypes), weight.numel()
        wanted = ((count, pixels), (count, 3), (count,), (3,), (3, 3))
        got = tuple(tuple(t.shape) for t in (prototypes, prototype_lights, widths, bias, error_factor))
        if got != wanted or not all(torch.isfinite(tensor).all() for tensor in self.buffers()):
            raise ValueError(f"light estimator: expected finite buffers of shapes {wanted}, got {got}")

    @classmethod
    def fit(
        cls,
        images: Tensor,
        lights: Tensor,
        valid: Tensor | None = None,
        fraction: float = 0.002,
        thumbnail: tuple[int, int] = (24, 21),
        weight: Tensor | None = None,
        folds: int = 5,
    ) -> KernelIlluminationEstimator:
        """Store ``images (N, J, H, W)`` under ``lights (J, 3)`` as prototypes; learn bias and error covariance over
        left-out people.

        Args:
            images: float radiance; NaN or ``valid (N, J)`` False mark missing ones.
            lights: unit vectors.
            valid: which images exist.
            fraction: of all prototypes, how many lie within one kernel width of each (the thesis says about a tenth).
            thumbnail: size at which images are compared.
            weight: ``(H, W)``, how much each pixel counts; leaves out what is not face. None: all alike.
            folds: groups of people left out in turn.

        Raises:
            ValueError: images, lights, ``valid`` or a weight that are none, or nothing to learn from.
        """
        check_shape(lights, "lights", "J 3", (None, 3))
        check_radiance(images, "images", "N J H W", (len(lights), None, None), missing=True)
        if weight is not None:
            weight = check_mask(weight, "weight", "H W", images.shape[2:])
        if valid is not None:
            valid = check_valid(valid, "valid", "N J", images.shape[:2]).to(images.device)
        count, light_count = images.shape[:2]
        kept = torch.isfinite(images.flatten(2)).all(-1)
        kept = kept if valid is None else kept & valid
        weight = (torch.ones(images.shape[2:]) if weight is None else weight).to(images.device)
        lights = lights.to(images.device)
        weight = torch.nn.functional.interpolate(weight[None, None].float(), size=thumbnail, mode="area")[0, 0]
        thumbs, energy = _thumbnails(images.nan_to_num(0.0).flatten(0, 1), weight)
        usable = (kept.flatten() & (energy > 0)).nonzero()[:, 0]
        if len(usable) < 2:
            raise ValueError(f"images: expected two that exist and are not black, got {len(usable)}")
        person = usable // light_count
        points, directions = thumbs[usable], unit_lights(lights.float())[usable % light_count]
        errors = []
        for fold in range(min(folds, count)):
            out = person % min(folds, count) == fold
            if out.all() or not out.any():
                continue
            trained = cls(
                points[~out],
                directions[~out],
                _widths(points[~out], fraction),
                points.new_zeros(3),
                points.new_zeros(3, 3),
                weight,
            )
            errors.append(directions[out] - trained._regress(points[out]))
        error = torch.cat(errors) if errors else points.new_zeros(1, 3)
        bias = error.mean(0)
        factor = covariance_factor(error - bias, max(len(error) - 1, 1))
        return cls(points, directions, _widths(points, fraction), bias, factor, weight)

    def _regress(self, points: Tensor, visible: Tensor | None = None) -> Tensor:
        """Kernel regression (4.4) for thumbnails ``(M, D)``; ``visible (M, D)`` weighs their pixels."""
        if visible is None:
            similarity = points @ self.prototypes.T
        else:
            length = (points.square() * visible).sum(-1, keepdim=True).sqrt() * (
                visible @ self.prototypes.square().T
            ).sqrt()
            similarity = (points * visible) @ self.prototypes.T / length.clamp_min(1e-12)
        squared = (2 - 2 * similarity).clamp_min(0)  # between unit vectors
        mean = kernel_weights(squared, self.widths) @ self.prototype_lights
        return torch.nn.functional.normalize(mean, dim=-1)

    def locate(self, images: Tensor, mask: Tensor | None = None) -> GaussianBelief:
        """The regression's light and the error that held-out people taught; see :meth:`LightEstimator.locate`."""
        small, energy = _thumbnails(images.flatten(0, 1), self.weight)  # (B K, D), (B K,)
        visible = None
        if mask is not None:
            visible = nn.functional.interpolate(mask[:, None].float(), size=tuple(self.weight.shape), mode="area")
            visible = visible.flatten(1).repeat_interleave(images.shape[1], 0).to(self.prototypes)  # (B K, D)
        direction = self._regress(small.to(self.prototypes), visible)  # (B K, 3)
        direction = nn.functional.normalize(direction + self.bias, dim=-1) * (energy > 0)[:, None]
        return GaussianBelief(direction.unflatten(0, images.shape[:2]).to(images), self.error_factor)


def _thumbnails(images: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Images ``(M, H, W)`` shrunk, weighted and normalised to unit length ``(M, D)``, and their length before."""
    small = torch.nn.functional.interpolate(images[:, None].to(weight), size=tuple(weight.shape), mode="area")
    small = (small * weight.sqrt()).flatten(1)
    energy = torch.linalg.vector_norm(small, dim=-1)
    energy = torch.where(energy > BLACK * small.shape[1] ** 0.5, energy, torch.zeros_like(energy))
    return small / energy.clamp_min(1e-12)[:, None], energy


def _widths(points: Tensor, fraction: float) -> Tensor:
    """A width for each prototype, so that about ``fraction`` of all prototypes lie within one width of it; by parts, to
    bound memory."""
    neighbours = max(1, min(round(fraction * len(points)), len(points) - 1))
    if len(points) <= 2048:
        return neighbour_widths(torch.cdist(points, points), neighbours)
    parts = [torch.cdist(part, points).kthvalue(neighbours + 1, dim=-1).values for part in points.split(1024)]
    return torch.cat(parts).clamp_min(torch.finfo(points.dtype).eps)
