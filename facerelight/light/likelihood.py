"""Where the light comes from, told by the model itself: the likelihood of an image over a grid of lights, tempered (4.4
taken further)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from facerelight.geometry.lights import angular_distance, even_hemisphere, nearest_lights
from facerelight.light.estimator import LightEstimator, shared_errors
from facerelight.model.covariance import image_covariance
from facerelight.model.light_terms import light_terms, loadings_at
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics import gaussian
from facerelight.numerics.checks import check_mask, check_radiance, check_shape, check_valid
from facerelight.numerics.luminance import BLACK
from facerelight.numerics.sampling import quasi_normal, spread_pixels

__all__ = ["LikelihoodIlluminationEstimator"]

TEMPERS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0)
CODE_TEMPER = 100 / 8064  # of the whole-face code, an observed pixel: 100 at 96 x 84
LEAST_GAIN = 1e-3
IMAGES_AT_ONCE = 16
REACH = 15.0  # degrees from the nearest bootstrap light


class LikelihoodIlluminationEstimator(LightEstimator):
    """Posterior over a grid of lights from ``p(image | light)``, the whole-face code integrated out and the image's
    gain fitted.

    It looks at every few pixels only. Pixels are not independent given the code, so the log likelihood is divided by
    ``temper``, which :meth:`calibrate` chooses to make the true lights of other people most probable.

    Args:
        statistics: what the bootstrap taught.
        count: lights of the grid to a hemisphere; those far from every bootstrap light are left out.
        pixels: about how many pixels to look at.

    Buffers: ``grid (R, 3)``; ``places (P,)`` of the pixels looked at; ``mean (R, P)``, ``std (R, P)`` and whitened
    ``loadings (R, P, k)`` of the images under each light; ``factor (R, k, k)``, a Cholesky factor of the code's
    precision; ``temper ()``.

    Example:
        >>> lights = torch.nn.functional.normalize(torch.randn(6, 3) + torch.tensor([0, 0, 2.0]), dim=1)
        >>> statistics = FaceStatistics.fit(torch.rand(5, 6, 24, 21), lights, rank=2, face_rank=2)
        >>> LikelihoodIlluminationEstimator(statistics, count=30)(torch.rand(2, 1, 24, 21)).direction.shape
        torch.Size([2, 1, 3])
    """

    grid: Tensor
    places: Tensor
    mean: Tensor
    std: Tensor
    loadings: Tensor
    factor: Tensor
    temper: Tensor

    def __init__(self, statistics: FaceStatistics, count: int = 300, pixels: int = 700) -> None:
        super().__init__()
        self.size: tuple[int, int] = statistics.size
        places = spread_pixels(self.size, pixels).to(statistics.lights.device)
        grid = _in_rings(_near_lights(even_hemisphere(count).to(statistics.lights), statistics.lights))
        pixel = statistics.pixel if statistics.face is None else statistics.face.residual
        assert pixel is not None
        means, stds, rows, factors = [], [], [], []
        for light in grid.split(1):
            terms = light_terms(statistics, pixel, light, statistics.face)
            std = image_covariance(statistics, pixel, terms, terms)[places, 0, 0].sqrt()
            means.append(terms.mean[0, places])
            stds.append(std.to(grid))
            if statistics.face is not None:
                white = loadings_at(statistics.face, terms)[0][:, places].T.double() / std[:, None]  # (P, k)
                temper = max(1.0, CODE_TEMPER * len(places))
                factors.append(gaussian.safe_cholesky(temper * torch.eye(white.shape[1]).to(white) + white.T @ white))
                rows.append(white.to(grid))
        self.register_buffer("grid", grid)
        self.register_buffer("places", places)
        self.register_buffer("mean", torch.stack(means))
        self.register_buffer("std", torch.stack(stds))
        self.register_buffer("loadings", torch.stack(rows) if rows else grid.new_zeros(len(grid), len(places), 0))
        self.register_buffer("factor", torch.stack(factors) if factors else grid.new_zeros(len(grid), 0, 0).double())
        self.register_buffer("temper", torch.tensor(64.0).to(grid))

    def get_extra_state(self) -> dict[str, tuple[int, int]]:
        """The size of the images that its places are in."""
        return {"size": self.size}

    def set_extra_state(self, state: dict[str, tuple[int, int]]) -> None:
        """See :meth:`get_extra_state`."""
        self.size = state["size"]

    def spacing(self) -> float:
        """Distance between neighbours in the grid, in radians."""
        return float(torch.cdist(self.grid, self.grid).kthvalue(2, dim=1).values.median())

    def log_likelihood(self, images: Tensor, mask: Tensor | None = None) -> Tensor:
        """Of ``images (M, H, W)`` under every light of the grid, up to a constant, untempered, ``(M, R)`` float64.

        Args:
            images: linear radiance; their brightness does not matter.
            mask: ``(M, H, W)``, 0 where they do not show the face.
        """
        check_radiance(images, "images", "M H W", self.size)
        if mask is not None:
            mask = check_mask(mask, "mask", "M H W", images.shape)
        if not len(images):
            return self.mean.new_zeros(0, len(self.grid), dtype=torch.float64)
        seen = images.flatten(1)[:, self.places].to(self.mean)
        weight = torch.ones_like(seen) if mask is None else mask.flatten(1)[:, self.places].to(seen)
        parts = [
            self._log_likelihood(image, kept)
            for image, kept in zip(seen.split(IMAGES_AT_ONCE), weight.split(IMAGES_AT_ONCE), strict=True)
        ]
        return torch.cat(parts)

    def _log_likelihood(self, seen: Tensor, weight: Tensor) -> Tensor:
        """Of the pixels ``seen (M, P)`` that count ``weight (M, P)``, ``(M, R)``."""
        root = weight.sqrt()[:, None] / self.std  # (M, R, P)
        expected, white = self.mean * root, seen[:, None] * root
        gain = ((white * expected).sum(2) / expected.square().sum(2).clamp_min(1e-12)).clamp_min(LEAST_GAIN)
        residual = white.div_(gain[..., None]).sub_(expected)
        misfit = residual.square().sum(2, dtype=torch.float64)
        if self.loadings.shape[2]:
            pull = torch.bmm((residual * weight.sqrt()[:, None]).transpose(0, 1), self.loadings).double()  # (R, M, k)
            factor = self.factor.double()
            half = gaussian.solve_lower(factor, pull.mT)  # (R, k, M)
            misfit = misfit - half.square().sum(1).T + 2 * factor.diagonal(dim1=1, dim2=2).log().sum(1)
        size = weight.double().sum(1, keepdim=True)
        return -0.5 * misfit - weight.double() @ self.std.double().log().T - size * gain.double().log()

    def posterior(self, images: Tensor, mask: Tensor | None = None) -> Tensor:
        """Probability of every light of the grid, ``(M, R)`` float64; all alike for an image without any light."""
        likelihood = self.log_likelihood(images, mask) * _lit(images)[:, None]
        return torch.softmax(likelihood / self.temper.double(), 1)

    def calibrate(self, images: Tensor, lights: Tensor, valid: Tensor | None = None) -> LikelihoodIlluminationEstimator:
        """Choose ``temper`` so that the true ``lights (J, 3)`` of ``images (N, J, H, W)`` become most probable; people
        not learned from."""
        check_shape(lights, "lights", "J 3", (None, 3))
        check_radiance(images, "images", "N J H W", (len(lights), *self.size), missing=valid is not None)
        there = torch.ones(images.shape[:2], dtype=torch.bool)
        if valid is not None:
            there = check_valid(valid, "valid", "N J", images.shape[:2])
        if not there.any():
            raise ValueError("images: expected one at least that exists, got none")
        truth = lights.to(self.grid).expand(len(images), -1, -1)[there]
        likelihood = self.log_likelihood(images[there])
        near = nearest_lights(truth, self.grid)
        score = {t: float(torch.log_softmax(likelihood / t, 1).gather(1, near[:, None]).mean()) for t in TEMPERS}
        self.temper.fill_(max(score, key=score.__getitem__))
        return self

    def locate(self, images: Tensor, mask: Tensor | None = None) -> GridBelief:
        """The posterior over the grid; see :meth:`LightEstimator.locate`."""
        inputs = images.shape[1]
        flat = images.flatten(0, 1)
        probability = self.posterior(flat, None if mask is None else mask.repeat_interleave(inputs, 0))  # (B K, R)
        direction = nn.functional.normalize(probability.to(self.grid) @ self.grid, dim=-1) * _lit(flat)[:, None]
        return GridBelief(direction.unflatten(0, images.shape[:2]), probability, self.grid, self.spacing() / 2)


class GridBelief(NamedTuple):
    """``probability (B K, R)`` of the lights of a ``grid (R, 3)`` with cells of radius ``cell``; its mean
    ``direction (B, K, 3)``."""

    direction: Tensor
    probability: Tensor
    grid: Tensor
    cell: float

    def draw(self, count: int, generator: torch.Generator | None, independent: bool) -> Tensor:
        """See :meth:`LightBelief.draw`: spread over the grid's cells, by default about one point a ``1 / count`` of the
        probability.

        One person's inputs are tied together as :func:`~facerelight.light.estimator.shared_errors` says: their places
        in the cells, and in the probability.
        """
        inputs = self.direction.shape[1]
        points = quasi_normal(count, 4 * inputs, generator, independent).reshape(count, inputs, 4).to(self.direction)
        points = torch.einsum("bjk,mkc->bjmc", shared_errors(self.direction), points).flatten(0, 1)  # (B K, count, 4)
        level = torch.special.ndtr(points[..., 0].double()).contiguous()
        chosen = torch.searchsorted(self.probability.cumsum(1), level).clamp_max(len(self.grid) - 1)  # (B K, count)
        drawn = self.grid[chosen] + self.cell * points[..., 1:].to(self.grid)  # (B K, count, 3)
        return drawn.unflatten(0, self.direction.shape[:2]).transpose(1, 2)


def _lit(images: Tensor) -> Tensor:
    """Which of ``images (M, H, W)`` hold any light, ``(M,)``."""
    return images.flatten(1).abs().amax(1) > BLACK


def _near_lights(hemisphere: Tensor, lights: Tensor) -> Tensor:
    """``hemisphere`` and its mirror image behind the face, as far as bootstrap ``lights`` come near."""
    sphere = torch.cat((hemisphere, hemisphere * torch.tensor((1.0, 1.0, -1.0)).to(hemisphere)))
    return sphere[angular_distance(sphere[:, None], lights[None]).amin(1) < REACH]


def _in_rings(grid: Tensor) -> Tensor:
    """``grid (R, 3)`` along rings about the camera's axis, there and back: lights that follow each other lie side by
    side, and so nearly equal posteriors that are read at one level give nearly one light."""
    spacing = float(torch.cdist(grid, grid).kthvalue(2, dim=1).values.median())
    ring = (grid[:, 2].clamp(-1, 1).acos() / spacing).round()
    turn = torch.atan2(grid[:, 1], grid[:, 0]) * (1 - 2 * (ring % 2))
    order = turn.argsort(stable=True)
    return grid[order[ring[order].argsort(stable=True)]]
