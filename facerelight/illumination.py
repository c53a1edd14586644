"""Where the light comes from: kernel regression on images (4.4), and samples of the light given its known error (4.3)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from facerelight.gaussian import covariance_factor
from facerelight.kernels import kernel_weights, neighbour_widths
from facerelight.lights import unit_lights

__all__ = ["KernelIlluminationEstimator", "LightEstimate", "quasi_normal"]


class LightEstimate(NamedTuple):
    """``direction (B, K, 3)``: unit vectors towards the light, the bias already taken off; zero for an image without any light."""

    direction: Tensor


def quasi_normal(count: int, dimensions: int, generator: torch.Generator | None = None, independent: bool = False) -> Tensor:
    """``count`` standard normal points ``(count, dimensions)``: scrambled Sobol by default, or independent draws.

    Quasi-random points fill space evenly, so means over them converge almost as ``1 / count`` instead of ``1 / sqrt(count)``.
    """
    if independent:
        return torch.randn(count, dimensions, generator=generator)
    seed = int(torch.randint(2**31, (1,), generator=generator)) if generator is not None else 0
    points = torch.quasirandom.SobolEngine(dimensions, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    return torch.special.ndtri(points.clamp(1e-9, 1 - 1e-9)).float()


class KernelIlluminationEstimator(nn.Module):
    """Kernel regression from an image to its light (4.4), with the error that held-out people taught (4.3).

    Images are compared small and normalised in brightness, because cameras and flashes differ.

    Buffers: ``prototypes (R, D)`` unit vectors, ``prototype_lights (R, 3)``, ``widths (R,)``, ``bias (3,)``, ``error_factor (3, 3)``.

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

    def __init__(
        self, prototypes: Tensor, prototype_lights: Tensor, widths: Tensor, bias: Tensor, error_factor: Tensor, thumbnail: Tensor
    ) -> None:
        super().__init__()
        for name, tensor in (
            ("prototypes", prototypes),
            ("prototype_lights", prototype_lights),
            ("widths", widths),
            ("bias", bias),
            ("error_factor", error_factor),
            ("thumbnail", thumbnail),
        ):
            self.register_buffer(name, tensor)

    @classmethod
    def fit(
        cls,
        images: Tensor,
        lights: Tensor,
        valid: Tensor | None = None,
        fraction: float = 0.002,
        thumbnail: tuple[int, int] = (24, 21),
        folds: int = 5,
    ) -> KernelIlluminationEstimator:
        """Store ``images (N, J, H, W)`` under ``lights (J, 3)`` as prototypes; learn bias and error covariance over left-out people.

        Args:
            images: float radiance; NaN or ``valid (N, J)`` False mark missing ones.
            lights: unit vectors.
            valid: which images exist.
            fraction: of all prototypes, how many lie within one kernel width of each (the thesis says about a tenth).
            thumbnail: size at which images are compared.
            folds: groups of people left out in turn.
        """
        if images.dim() != 4 or images.shape[1] != len(lights):
            raise ValueError(f"images: expected (N, J, H, W) with J = {len(lights)} lights, got {tuple(images.shape)}")
        count, light_count = images.shape[:2]
        kept = torch.isfinite(images.flatten(2)).all(-1)
        kept = kept if valid is None else kept & valid
        thumbs, energy = _thumbnails(images.nan_to_num(0.0).flatten(0, 1), thumbnail)
        usable = (kept.flatten() & (energy > 0)).nonzero()[:, 0]
        person = usable // light_count
        points, directions = thumbs[usable], unit_lights(lights.float())[usable % light_count]
        size = torch.tensor(thumbnail)
        errors = []
        for fold in range(min(folds, count)):
            out = person % min(folds, count) == fold
            if out.all() or not out.any():
                continue
            trained = cls(points[~out], directions[~out], _widths(points[~out], fraction), torch.zeros(3), torch.zeros(3, 3), size)
            errors.append(directions[out] - trained._regress(points[out]))
        error = torch.cat(errors) if errors else torch.zeros(1, 3)
        bias = error.mean(0)
        factor = covariance_factor(error - bias, max(len(error) - 1, 1))
        return cls(points, directions, _widths(points, fraction), bias, factor, size)

    def _regress(self, points: Tensor) -> Tensor:
        squared = (2 - 2 * points @ self.prototypes.T).clamp_min(0)  # unit vectors
        mean = kernel_weights(squared, self.widths) @ self.prototype_lights
        return torch.nn.functional.normalize(mean, dim=-1)

    def forward(self, images: Tensor) -> LightEstimate:
        """Estimate the light of each of ``images (B, K, H, W)``."""
        if images.dim() != 4:
            raise ValueError(f"images: expected (B, K, H, W), got {tuple(images.shape)}")
        small, energy = _thumbnails(images.flatten(0, 1), tuple(self.thumbnail.tolist()))
        direction = torch.nn.functional.normalize(self._regress(small.to(self.prototypes)) + self.bias, dim=-1)
        return LightEstimate((direction * (energy > 0)[:, None]).unflatten(0, images.shape[:2]).to(images))

    def sample(self, images: Tensor, count: int, generator: torch.Generator | None = None, independent: bool = False) -> Tensor:
        """Draw ``count`` lights a image from ``N(estimate + bias, error covariance)``, put back on the sphere (4.3); ``(B, count, K, 3)``.

        Quasi-random by default; ``independent=True`` draws as the thesis does. The same ``generator`` state gives the same lights.
        """
        direction = self(images).direction  # (B, K, 3)
        persons, inputs = direction.shape[:2]
        noise = quasi_normal(count, 3 * inputs, generator, independent).reshape(count, inputs, 3).to(direction)
        drawn = direction[:, None] + noise @ self.error_factor.T.to(direction)
        drawn = torch.nn.functional.normalize(drawn, dim=-1)
        return drawn * (direction[:, None].square().sum(-1, keepdim=True) > 0)


def _thumbnails(images: Tensor, size: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Images ``(M, H, W)`` shrunk and normalised to unit length ``(M, D)``, and their length before."""
    small = torch.nn.functional.interpolate(images[:, None].float(), size=size, mode="area").flatten(1)
    energy = torch.linalg.vector_norm(small, dim=-1)
    energy = torch.where(energy > 1e-6 * small.shape[1] ** 0.5, energy, torch.zeros_like(energy))
    return small / energy.clamp_min(1e-12)[:, None], energy


def _widths(points: Tensor, fraction: float) -> Tensor:
    """A width for each prototype, so that about ``fraction`` of all prototypes lie within one width of it; by parts, to bound memory."""
    neighbours = max(1, min(round(fraction * len(points)), len(points) - 1))
    if len(points) <= 2048:
        return neighbour_widths(torch.cdist(points, points), neighbours)
    parts = [torch.cdist(part, points).kthvalue(neighbours + 1, dim=-1).values for part in points.split(1024)]
    return torch.cat(parts).clamp_min(torch.finfo(points.dtype).eps)
