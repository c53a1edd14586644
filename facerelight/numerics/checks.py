"""The checks that every public callable makes of the tensors it is given: shape, dtype, finiteness, units.

Each raises a ``ValueError`` that names the argument, says what was expected, what came, and where it can what to do.
They return what they checked, so that a mask of integers comes back as the booleans it stands for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = [
    "check_finite",
    "check_index",
    "check_mask",
    "check_noise",
    "check_radiance",
    "check_shape",
    "check_unit",
    "check_valid",
]

FULL_SCALE = 20.0
"""Radiance: 1.0 is full scale, and a lamp or two may exceed it; more is another unit (0..255, 0..65535)."""
UNIT = 1e-3  # how far the length of a direction may be from 1


def check_shape(tensor: Tensor, name: str, letters: str, sizes: Sequence[int | None] = ()) -> Tensor:
    """A tensor with one dimension a letter.

    Args:
        tensor: any.
        name: of the argument, for the message.
        letters: such as "B K H W", for the message.
        sizes: of the dimensions, None where any will do; fewer than letters: the last ones. Default: any.

    Raises:
        ValueError: no tensor, or of another shape.
    """
    named = letters.split()
    wanted = [None] * (len(named) - len(sizes)) + list(sizes)
    shown = ", ".join(letter if size is None else str(size) for letter, size in zip(named, wanted, strict=True))
    if not isinstance(tensor, Tensor):
        raise ValueError(f"{name}: expected a tensor ({shown}), got {type(tensor).__name__}; try torch.as_tensor")
    fits = tensor.dim() == len(wanted) and all(
        size is None or size == length for size, length in zip(wanted, tensor.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{name}: expected ({shown}), got {tuple(tensor.shape)}")
    return tensor


def check_finite(tensor: Tensor, name: str, what: str = "values") -> Tensor:
    """A floating tensor without NaN or infinity; ``what`` it holds is for the message.

    Raises:
        ValueError: another dtype, NaN or infinity.
    """
    if not tensor.is_floating_point():
        raise ValueError(
            f"{name}: expected floating {what} in 0..1, got {tensor.dtype}; divide by 255 and decode sRGB first"
        )
    if not torch.isfinite(tensor).all():
        raise ValueError(f"{name}: expected finite {what}, got NaN or infinity")
    return tensor


def check_radiance(
    images: Tensor, name: str, letters: str, sizes: Sequence[int | None] = (), missing: bool = False
) -> Tensor:
    """Images in linear radiance, 1.0 = full scale, see :func:`check_shape`; ``missing`` ones may be NaN.

    Raises:
        ValueError: another shape or dtype, NaN or infinity, or values that are no radiance (0..255).
    """
    check_shape(images, name, letters, sizes)
    values = images.nan_to_num(nan=0.0, posinf=torch.inf, neginf=-torch.inf) if missing else images
    check_finite(values, name, "radiance")
    highest = float(values.detach().abs().amax()) if values.numel() else 0.0
    if highest > FULL_SCALE:
        raise ValueError(
            f"{name}: expected linear radiance with 1.0 = full scale, got values up to {highest:g};"
            " divide by 255 or 65535?"
        )
    return images


def check_mask(mask: Tensor, name: str, letters: str, sizes: Sequence[int | None] = ()) -> Tensor:
    """Weights from 0 to 1, or booleans, see :func:`check_shape`; booleans and integers come back as float32.

    Raises:
        ValueError: another shape, NaN, or values outside 0..1.
    """
    check_shape(mask, name, letters, sizes)
    weight = mask if mask.is_floating_point() else mask.float()
    if not ((weight >= 0) & (weight <= 1)).all():  # NaN is neither
        raise ValueError(f"{name}: expected weights from 0 to 1, got others (or NaN); divide by 255?")
    return weight


def check_valid(valid: Tensor, name: str, letters: str, sizes: Sequence[int | None] = ()) -> Tensor:
    """Booleans, or integers 0 and 1 as booleans: an integer tensor would be an index, and not a mask.

    Raises:
        ValueError: another shape, or anything but yes and no.
    """
    check_shape(valid, name, letters, sizes)
    if valid.dtype == torch.bool:
        return valid
    if valid.is_floating_point() or valid.is_complex() or not ((valid == 0) | (valid == 1)).all():
        raise ValueError(f"{name}: expected booleans, got {valid.dtype} that is not 0 and 1 alone; compare it first")
    return valid == 1


def check_unit(directions: Tensor, name: str) -> Tensor:
    """Unit vectors ``(..., 3)``, to a thousandth.

    Raises:
        ValueError: another shape or dtype, or a length that is not 1.
    """
    if not isinstance(directions, Tensor) or directions.shape[-1:] != (3,) or not directions.is_floating_point():
        got = f"{directions.dtype} {tuple(directions.shape)}" if isinstance(directions, Tensor) else repr(directions)
        raise ValueError(f"{name}: expected floating (..., 3), got {got}")
    if not ((torch.linalg.vector_norm(directions.detach(), dim=-1) - 1).abs() <= UNIT).all():  # NaN is not
        raise ValueError(f"{name}: expected unit vectors, got others; divide by their length first")
    return directions


def check_index(index: Tensor, name: str, letters: str, below: int) -> Tensor:
    """Integers from 0 to ``below - 1``, see :func:`check_shape`.

    Raises:
        ValueError: another shape or dtype, or numbers out of range.
    """
    check_shape(index, name, letters)
    if index.is_floating_point() or index.is_complex() or index.dtype == torch.bool:
        raise ValueError(f"{name}: expected integers, got {index.dtype}")
    if index.numel() and not 0 <= int(index.min()) <= int(index.max()) < below:
        raise ValueError(f"{name}: expected 0 to {below - 1}, got {int(index.min())} to {int(index.max())}")
    return index


def check_noise(noise: float) -> float:
    """The standard deviation of the inputs' noise in radiance; ``noise`` is in grey levels of 255, else a
    ``ValueError``."""
    if not (isinstance(noise, int | float) and math.isfinite(noise) and noise >= 0):
        raise ValueError(f"noise: expected grey levels of 255, 0 or more, got {noise!r}; 1 suits 8-bit images")
    return float(noise) / 255
