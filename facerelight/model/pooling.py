"""Statistics of coarser images: those of averages over square blocks of pixels."""

from __future__ import annotations

from torch import Tensor

from facerelight.model.statistics import FaceLoadings, FaceStatistics, PixelStatistics
from facerelight.numerics.gaussian import positive_root

__all__ = ["pooled_statistics"]


def pooled_statistics(statistics: FaceStatistics, block: int) -> FaceStatistics:
    """What ``statistics`` say of images shrunk by averages over ``block x block`` pixels, for use and not for updates.

    Means and loadings are averaged. What pixels have to themselves is taken to be one deviation over a block, and the
    temper of the code shrinks with the number of pixels, so that a coarse image tells as much of a person as a fine
    one.

    Args:
        statistics: learned ones.
        block: a divisor of their height and width.

    Returns:
        Statistics of size ``(H / block, W / block)``, of the same lights.

    Raises:
        ValueError: a block that does not divide the size.

    Example:
        >>> import torch
        >>> fine = FaceStatistics.fit(torch.rand(5, 3, 16, 8), torch.eye(3), rank=2, face_rank=2)
        >>> pooled_statistics(fine, 2).size
        (8, 4)
    """
    height, width = statistics.size
    if not isinstance(block, int) or block < 1 or height % block or width % block:
        raise ValueError(f"block: expected a divisor of {height} and of {width}, got {block!r}")
    assert statistics.pixel is not None
    coarse = FaceStatistics(statistics.lights)
    coarse.store, coarse.options, coarse.metadata = None, statistics.options, dict(statistics.metadata)
    for name in ("light_widths", "nugget_width", "gain_spread", "gain_noise"):
        setattr(coarse, name, getattr(statistics, name).clone())
    coarse.n_mean, coarse.v_mean = _pooled(statistics.n_mean, block), _pooled(statistics.v_mean, block)
    coarse.pixel = _pooled_pixels(statistics.pixel, block)
    if statistics.face is not None:
        face = statistics.face
        coarse.face = FaceLoadings(
            _pooled(face.n, block),
            _pooled(face.v, block),
            face.basis.clone(),
            _pooled(positive_root(face.v_power), block).square(),
            face.temper / block**2,
            _pooled_pixels(face.residual, block),
        )
    return coarse


def _pooled_pixels(pixel: PixelStatistics, block: int) -> PixelStatistics:
    std = _pooled(pixel.v_std, block)  # (J, h, w)
    shared = _pooled(pixel.v_std[:, None] * pixel.v_factor, block) / std[:, None].clamp_min(1e-12)
    return PixelStatistics(_pooled(pixel.n_factor, block), std, shared)


def _pooled(maps: Tensor, block: int) -> Tensor:
    """``(..., H, W)`` by averages over blocks."""
    if block == 1:
        return maps.clone()
    return maps.unflatten(-1, (-1, block)).unflatten(-3, (-1, block)).mean((-3, -1))
