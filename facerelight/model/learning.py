"""Learning the statistics of n and v from the subjects' images.

Everything that is learned is a fixed linear function of the N subjects' images, so learning runs in two passes over
blocks of pixels: one gathers N x N and J x J Gram matrices, one applies the N x N *subject operators* found from them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.model.image_store import ImageStore
from facerelight.model.subjects import (
    Brightness,
    FaceOperators,
    Grams,
    face_operators,
    fill_missing,
    fill_operators,
    gather_grams,
    interpolation_error,
    measure_brightness,
    total_gram,
)
from facerelight.numerics import gaussian
from facerelight.numerics.kernels import neighbour_widths

__all__ = ["FitOptions", "Learned", "LearnedFace", "LearnedPixel", "learn"]

BLOCK_VALUES = 1_000_000  # images of all subjects in one block of pixels, 4 MB
GAP_SHRINK = 0.8  # leaving a light out widens the gap around it, and with it the best kernel
WIDTH_FACTORS = (0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.8, 1.0)  # kernel widths tried, in light spacings


@dataclass(frozen=True)
class FitOptions:
    """How statistics are learned.

    Args:
        rank: columns of the correlation factor of v over the lights (8 hold 89 % of its trace on real faces, 16 hold 97
            %).
        face_rank: loadings of the whole-face model; 0 leaves it out.
        basis: functions over the lights that the loadings of v share.
        temper: how many pixels count as one independent observation of the whole-face code. What neighbours share is a
            matter of faces, not of how finely they are sampled: 100 suits faces of 96 x 84 pixels, and other sizes in
            proportion to their pixels (``scripts/measure/temper.py``).
        brightness: learn from faces brought to one brightness and treat a person's (or camera's) gain as an unknown of
            its own, ``i = g (n^T s + v)``; False is the thesis's model.
        kernel_width: width of the kernel over lights, in local light spacings; None chooses it by leaving lights out.
        nugget_width: width of the narrow kernel that makes the model exactly consistent, in spacings.
        floor: least standard deviation of v, in radiance; keeps pixels that never vary well-posed.
        block: most pixels solved at a time; fewer where there are many heads, so that memory stays flat.
    """

    rank: int = 12
    face_rank: int = 0
    basis: int = 24
    temper: float = 100.0
    brightness: bool = False
    kernel_width: float | None = None
    nugget_width: float = 0.35
    floor: float = 2e-3
    block: int = 1024

    def __post_init__(self) -> None:
        if self.rank < 0 or self.face_rank < 0 or self.basis < 1 or self.block < 1:
            raise ValueError(f"statistics: expected ranks >= 0 and basis, block >= 1, got {self}")
        widths = self.nugget_width > 0 and (self.kernel_width is None or self.kernel_width > 0)
        if not (self.temper >= 1 and widths and self.floor > 0):
            raise ValueError(f"statistics: expected temper >= 1 and widths, floor > 0, got {self}")


class LearnedPixel(NamedTuple):
    """Second-order statistics, pixel by pixel (4.3): ``n_factor (3, 3, H, W)``, ``v_std (J, H, W)``,
    ``v_factor (J, r, H, W)``; see :class:`~facerelight.model.statistics.PixelStatistics`."""

    n_factor: Tensor
    v_std: Tensor
    v_factor: Tensor


class LearnedFace(NamedTuple):
    """Loadings over the whole face: ``n (k, 3, H, W)``, ``v (k, m, H, W)``, ``v_power (J, H, W)``, and what they leave;
    see :class:`~facerelight.model.statistics.FaceLoadings`."""

    n: Tensor
    v: Tensor
    v_power: Tensor
    residual: LearnedPixel


class Learned(NamedTuple):
    """All that a bootstrap teaches: ``light_widths (J,)``, ``nugget_width ()``, ``gain_spread ()``,
    ``gain_noise (J,)``, ``basis (m, J)`` over the lights, ``n_mean (3, H, W)``, ``v_mean (J, H, W)``."""

    light_widths: Tensor
    nugget_width: Tensor
    gain_spread: Tensor
    gain_noise: Tensor
    basis: Tensor
    n_mean: Tensor
    v_mean: Tensor
    pixel: LearnedPixel
    face: LearnedFace | None


def learn(store: ImageStore, lights: Tensor, options: FitOptions) -> Learned:
    """Every statistic of the subjects in ``store``, two or more of one size, under unit ``lights (J, 3)``."""
    height, width = store.shape[1:]
    pixels = height * width
    step = max(32, min(options.block, BLOCK_VALUES // (len(store) * len(lights))))
    grams = gather_grams(store, lights, step)
    light_widths, nugget_width = _kernel_widths(grams, lights, options)
    fill = fill_operators(grams)
    gram = total_gram(grams, fill)  # (N, N)
    brightness = measure_brightness(store, gram, fill, step) if options.brightness else None
    if brightness is not None:
        gram = gram / torch.outer(brightness.gain, brightness.gain)
    operators = face_operators(gram, options.face_rank) if options.face_rank else None
    basis = _light_basis(grams, options.basis)
    maps: dict[str, Tensor] = {}
    for start in range(0, pixels, step):
        images = store.block(start, min(start + step, pixels))  # (N, J, P)
        block = _learn_block(fill_missing(images, fill), lights, options, brightness, operators, basis)
        for name, values in block.items():
            if name not in maps:  # one allocation each: small ones kept between large ones would tear the heap apart
                maps[name] = values.new_empty(*values.shape[:-1], pixels)
            maps[name][..., start : start + values.shape[-1]] = values
    maps = {name: values.unflatten(-1, (height, width)) for name, values in maps.items()}
    face = None
    if operators is not None:
        residual = LearnedPixel(maps["face_n_factor"], maps["face_v_std"], maps["face_v_factor"])
        face = LearnedFace(maps["face_n"], maps["face_v"], maps["face_power"], residual)
    return Learned(
        light_widths,
        nugget_width,
        torch.tensor(0.0) if brightness is None else brightness.spread,
        torch.ones(len(lights)) if brightness is None else brightness.noise,
        basis,
        maps["n_mean"],
        maps["v_mean"],
        LearnedPixel(maps["n_factor"], maps["v_std"], maps["v_factor"]),
        face,
    )


def _learn_block(
    images: Tensor,
    lights: Tensor,
    options: FitOptions,
    brightness: Brightness | None,
    operators: FaceOperators | None,
    basis: Tensor,
) -> dict[str, Tensor]:
    """Every statistic of one block of pixels, from complete ``images (N, J, P)`` (4.2, 4.3)."""
    if brightness is not None:
        images = images / brightness.gain[:, None, None]
    solver = torch.linalg.pinv(lights.double()).float()  # (3, J)
    n = solver @ images  # (N, 3, P), least squares per subject (4.2)
    v = images - lights @ n  # (N, J, P)
    n_mean, v_mean = n.mean(0), v.mean(0)
    n_factor, v_std, v_factor = _learn_pixels(n - n_mean, v - v_mean, len(n) - 1, options)
    maps = {"n_mean": n_mean, "v_mean": v_mean, "n_factor": n_factor, "v_std": v_std, "v_factor": v_factor}
    if operators is not None:
        residual_n = torch.einsum("ab,b...->a...", operators.residual, n)  # (N, 3, P)
        residual_v = torch.einsum("ab,b...->a...", operators.residual, v)  # (N, J, P)
        learned = _learn_pixels(residual_n, residual_v, len(n), options)
        maps |= dict(zip(("face_n_factor", "face_v_std", "face_v_factor"), learned, strict=True))
        loadings = torch.einsum("ka,ajp->kjp", operators.loadings, v)  # (k, J, P)
        maps |= {
            "face_n": torch.einsum("ka,acp->kcp", operators.loadings, n),  # (k, 3, P)
            "face_v": basis @ loadings,  # (k, m, P)
            "face_power": loadings.square().sum(0),  # (J, P)
        }
    return maps


def _learn_pixels(n: Tensor, v: Tensor, dof: float, options: FitOptions) -> LearnedPixel:
    """Second-order statistics of a block of pixels from centred ``n (N, 3, P)`` and ``v (N, J, P)``."""
    n_factor = gaussian.covariance_factor(n.permute(2, 0, 1), dof).permute(1, 2, 0)  # (3, 3, P)
    length = v.square().sum(0).sqrt()  # (J, P)
    v_std = (length / dof**0.5).clamp_min(options.floor)
    unit = torch.where(length > options.floor * dof**0.5, v / length.clamp_min(1e-30), torch.zeros_like(v))  # (N, J, P)
    v_factor = gaussian.correlation_factor(unit.permute(2, 0, 1), options.rank).permute(1, 2, 0)  # (J, r, P)
    return LearnedPixel(n_factor, v_std, v_factor)


def _kernel_widths(grams: Grams, lights: Tensor, options: FitOptions) -> tuple[Tensor, Tensor]:
    """Kernel widths ``(J,)`` in proportion to the local spacing of the lights, the factor by leaving each light out in
    turn; and the narrow kernel's width ``()``."""
    distance = torch.cdist(lights.double(), lights.double())  # (J, J)
    spacing = neighbour_widths(distance, 3)
    factor = options.kernel_width
    if factor is None:
        best = min(WIDTH_FACTORS, key=lambda c: interpolation_error(grams.deviation, distance, c * spacing))
        factor = GAP_SHRINK * best
    return (factor * spacing).float(), (options.nugget_width * spacing.median()).float()


def _light_basis(grams: Grams, count: int) -> Tensor:
    """At most ``count`` orthonormal functions over the lights that hold most of how v varies between subjects,
    ``(m, J)``."""
    vectors = torch.linalg.eigh(grams.deviation_spread).eigenvectors
    return vectors[:, -min(count, len(vectors)) :].T.flip(0).float()
