"""Statistics made small enough to travel with the package: a twentieth of their size for a quarter of a grey level.

Maps of a face are smooth, and so a few coefficients of their cosine transform hold nearly all of them, as in JPEG:
every map is transformed, its coefficients are rounded to whole steps and deflated. Rounding errs by 0.3 steps root mean
square, in the units of the map, and by less where coefficients are small. Before that, what no image depends on is
taken out:

* a covariance depends on its factor F by ``F F^T`` alone, so the columns of a correlation factor are turned at every
  pixel to agree with the other pixels (orthogonal Procrustes), and n's factor is replaced by the symmetric square root;
* ``v_power`` is what the loadings in their basis give v, which is known, and a remainder, of which the root is kept.

Whatever the rounding does, the covariances that come back are valid: they are kept as factors, standard deviations as
logarithms, and rows of a correlation factor that became longer than 1 are cut to 1.
"""

from __future__ import annotations

import hashlib
import math
import zlib

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "RANK",
    "checksum",
    "compress",
    "compress_estimator",
    "decompress",
    "decompress_estimator",
    "deflate_maps",
    "inflate_maps",
]

STEPS = {
    "n_mean": 1e-4,
    "v_mean": 6e-4,
    "n": 2.2e-4,
    "v": 1.2e-3,
    "lost": 5e-3,
    "n_root": 1.5e-4,
    "v_log_std": 0.045,
    "v_factor": 0.1,
}
"""Of the coefficients: in radiance (1/255 is a grey level); of logarithms and of correlation factors, pure numbers.

In proportion to what a bit more of each buys: another megabyte lowers the error by about as much wherever it is spent.
"""
PIXEL = 2.0  # steps of the per-pixel model are so much larger: for the same ones it errs half as much
RANK = 8  # columns kept of the correlation factor; the first hold most
PROTOTYPE_STEP = 0.02  # of a light estimator's prototypes, unit vectors: moves a light by a quarter of a degree
HALF_WAY = 0.6  # where a coefficient is rounded up instead of down: zeros are cheap
MOST_BYTES = 4  # of a coefficient
PARTS = ("pixel.", "face.residual.")


def compress(tensors: dict[str, Tensor], coarseness: float = 1.0, rank: int = RANK) -> dict[str, Tensor]:
    """Make the tensors of statistics small.

    Args:
        tensors: the state of a solved :class:`facerelight.model.statistics.FaceStatistics`.
        coarseness: steps are so many times as large as :data:`STEPS`; the error grows about in proportion.
        rank: of the correlation factors that are kept.

    Returns:
        For every stack of maps ``NAME.codes``, ``NAME.shape`` and ``NAME.step``, see :func:`deflate_maps`; small
        tensors as they were.
    """
    packed: dict[str, Tensor] = {}

    def put(name: str, maps: Tensor) -> None:
        step = STEPS[name.rpartition(".")[2]] * coarseness * (PIXEL if name.startswith("pixel.") else 1)
        packed.update({f"{name}.{key}": value for key, value in deflate_maps(maps, step).items()})

    for name, tensor in tensors.items():
        key = name.rpartition(".")[2]
        if key == "n_factor":
            put(name.replace(key, "n_root"), _lower(_symmetric_root(tensor)))
        elif key == "v_factor":
            put(name, _aligned(tensor[:, :rank]))
        elif key == "v_std":
            put(name.replace(key, "v_log_std"), tensor.log())
        elif key == "v_power":
            lost = tensor - _power(tensors["face.v"], tensors["face.basis"])  # at some lights less than nothing
            put(name.replace(key, "lost"), lost.sign() * lost.abs().sqrt())
        elif key in STEPS:
            put(name, tensor)
        else:
            packed[name] = tensor
    return packed


def decompress(packed: dict[str, Tensor]) -> dict[str, Tensor]:
    """What :func:`compress` was given, to within its steps; correlation factors have the kept columns only.

    Raises:
        ValueError: codes that do not fit their shape; says which.
    """
    tensors = {name: tensor for name, tensor in packed.items() if not name.endswith((".codes", ".shape", ".step"))}
    for name in (name.removesuffix(".codes") for name in packed if name.endswith(".codes")):
        try:
            tensors[name] = inflate_maps(*(packed[f"{name}.{key}"] for key in ("codes", "shape", "step")))
        except (KeyError, TypeError, ValueError, zlib.error) as error:
            raise ValueError(f"{name}: expected the codes of a stack of maps, got {error}") from error
    for part in PARTS:
        if f"{part}n_root" in tensors:
            tensors[f"{part}n_factor"] = _symmetric(tensors.pop(f"{part}n_root"))
        if f"{part}v_factor" in tensors:
            factor = tensors[f"{part}v_factor"]  # rows no longer than 1: F F^T + diag(1 - rowsum F^2) is a correlation
            factor /= factor.square().sum(1, keepdim=True).clamp_min_(1).sqrt_()
        if f"{part}v_log_std" in tensors:
            tensors[f"{part}v_std"] = tensors.pop(f"{part}v_log_std").exp_()
    if "face.lost" in tensors:
        root, kept = tensors.pop("face.lost"), _power(tensors["face.v"], tensors["face.basis"])
        tensors["face.v_power"] = kept.addcmul_(root, root.abs()).clamp_min_(0)
    return tensors


def compress_estimator(tensors: dict[str, Tensor], coarseness: float = 1.0) -> dict[str, Tensor]:
    """Make a :class:`facerelight.light.kernel.KernelIlluminationEstimator`'s tensors small: its prototypes are maps."""
    packed = {name: tensor for name, tensor in tensors.items() if name != "prototypes"}
    maps = tensors["prototypes"].unflatten(1, tensors["weight"].shape)
    coded = deflate_maps(maps, PROTOTYPE_STEP * coarseness)
    return packed | {f"prototypes.{key}": value for key, value in coded.items()}


def decompress_estimator(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """What :func:`compress_estimator` was given; tensors that are not compressed as they are."""
    if "prototypes.codes" not in tensors:
        return tensors
    tensors = decompress(tensors)
    return tensors | {"prototypes": torch.nn.functional.normalize(tensors["prototypes"].flatten(1), dim=1)}


def deflate_maps(maps: Tensor, step: float) -> dict[str, Tensor]:
    """Code a stack of maps.

    Args:
        maps: ``(..., H, W)``.
        step: of the coefficients of the orthonormal cosine transform, in the maps' units.

    Returns:
        ``codes``, uint8: the coefficients in steps, one plane of bytes a digit to the base of 256 (-128 to 127, lowest
        first), deflated; ``shape`` of the maps; ``step ()``.
    """
    height, width = maps.shape[-2:]
    scaled = _cosines(height) @ maps.double() @ _cosines(width).T / step
    left = (scaled.sign() * (scaled.abs() + 1 - HALF_WAY).floor()).long()
    planes = []
    while left.any():
        digit = (left + 128) % 256 - 128
        planes.append(digit.to(torch.int8).numpy().tobytes())
        left = (left - digit) // 256
    codes = np.frombuffer(zlib.compress(b"".join(planes), 9), np.uint8).copy()
    return {"codes": torch.from_numpy(codes), "shape": torch.tensor(maps.shape), "step": torch.tensor(step)}


def inflate_maps(codes: Tensor, shape: Tensor, step: Tensor) -> Tensor:
    """The maps ``(..., H, W)`` float32 of :func:`deflate_maps`."""
    size = tuple(int(length) for length in shape)
    count = math.prod(size)
    if len(size) < 2 or min(size) < 0:
        raise ValueError(f"a shape of {size}")
    stream = zlib.decompressobj()  # whatever a hostile file holds, no more than the maps need
    content = stream.decompress(codes.numpy().data, MOST_BYTES * count + 1)
    digits = len(content) // count if count else 0
    if not stream.eof or len(content) != digits * count or digits > MOST_BYTES:
        raise ValueError(f"{len(content)} bytes for maps of shape {size}")
    coefficients = torch.zeros(size)
    for plane in np.frombuffer(bytearray(content), np.int8).reshape(digits, count)[::-1]:
        coefficients.mul_(256).add_(torch.from_numpy(plane).view(size))
    height, width = size[-2:]
    return (float(step) * _cosines(height).T.float()) @ (coefficients @ _cosines(width).float())


def checksum(tensors: dict[str, Tensor]) -> str:
    """SHA-256 over names, shapes and contents."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(f"{name} {tensors[name].dtype} {tuple(tensors[name].shape)};".encode())
        total.update(tensors[name].contiguous().numpy().data)
    return total.hexdigest()


def _cosines(count: int) -> Tensor:
    """The orthonormal cosine transform (DCT-II), ``(count, count)`` float64."""
    frequency = torch.arange(count, dtype=torch.float64)[:, None]
    waves = torch.cos(math.pi / count * frequency * (torch.arange(count) + 0.5)) * math.sqrt(2 / count)
    waves[:1] /= math.sqrt(2)
    return waves


def _aligned(factor: Tensor, rounds: int = 4) -> Tensor:
    """``factor (J, r, H, W)``, its columns turned at each pixel to lie as near as can be to the mean over pixels."""
    rows = factor.permute(2, 3, 0, 1).flatten(0, 1).double()  # (P, J, r)
    if factor.shape[1] == 0:
        return factor
    middle = rows[len(rows) // 2 + factor.shape[3] // 2 if len(rows) > factor.shape[3] else 0]
    for _ in range(rounds):
        left, _, right = torch.linalg.svd(rows.mT @ middle)
        rows = rows @ (left @ right)
        middle = rows.mean(0)
    return rows.unflatten(0, factor.shape[2:]).permute(2, 3, 0, 1)


def _symmetric_root(factor: Tensor) -> Tensor:
    """``S = S^T`` with ``S S = L L^T`` of ``factor (3, 3, H, W)``."""
    rows = factor.permute(2, 3, 0, 1).double()
    values, vectors = torch.linalg.eigh(rows @ rows.mT)
    return ((vectors * values.clamp_min(0).sqrt()[..., None, :]) @ vectors.mT).permute(2, 3, 0, 1)


def _lower(matrix: Tensor) -> Tensor:
    """The six entries of symmetric ``(3, 3, H, W)`` on and below the diagonal."""
    row, column = torch.tril_indices(3, 3)
    return matrix[row, column]


def _symmetric(lower: Tensor) -> Tensor:
    """``(3, 3, H, W)`` of the six entries of :func:`_lower`."""
    row, column = torch.tril_indices(3, 3)
    matrix = lower.new_empty(3, 3, *lower.shape[1:])
    matrix[row, column] = matrix[column, row] = lower
    return matrix


def _power(loadings: Tensor, basis: Tensor) -> Tensor:
    """The variance ``(J, H, W)`` that loadings ``(k, m, H, W)`` in a basis ``(m, J)`` give v at each light."""
    power = loadings.new_zeros(basis.shape[1], *loadings.shape[2:])
    for each in loadings:  # one at a time: all of them would be 150 MB
        power += torch.tensordot(basis.T, each, 1).square_()
    return power
