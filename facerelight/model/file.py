"""Statistics on disk: one safetensors file, its layout checked tensor by tensor before anything is built from it."""

from __future__ import annotations

import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from facerelight.model.compression import checksum, compress, decompress

__all__ = ["FORMAT_VERSION", "read_tensors", "replacing", "write_tensors"]

FORMAT = "facerelight-statistics"
FORMAT_VERSION = 2
KEY_LENGTH = 16  # hexadecimal digits that tell statistics apart

# The layout: J lights, H x W pixels, r columns of the correlation factor (each its own), k loadings, m functions over
# the lights.
PIXEL_LAYOUT = {"n_factor": "3 3 H W", "v_std": "J H W", "v_factor": "J r H W"}
LAYOUT = {
    "lights": "J 3",
    "light_widths": "J",
    "nugget_width": "",
    "gain_spread": "",
    "gain_noise": "J",
    "n_mean": "3 H W",
    "v_mean": "J H W",
    **{f"pixel.{name}": shape for name, shape in PIXEL_LAYOUT.items()},
}
FACE_LAYOUT = {
    "face.n": "k 3 H W",
    "face.v": "k m H W",
    "face.basis": "m J",
    "face.v_power": "J H W",
    "face.temper": "",
    **{f"face.residual.{name}": shape.replace("r", "q") for name, shape in PIXEL_LAYOUT.items()},
}


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A file of this process's own to write into, which then takes the place of ``path`` at once; gone after an
    error."""
    partial = path.with_name(f"{path.name}.{os.getpid()}-{secrets.token_hex(4)}.part")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_tensors(
    path: str | Path, tensors: dict[str, Tensor], notes: dict[str, object], coarseness: float = 0.0
) -> None:
    """Write tensors and notes, atomically.

    Args:
        coarseness: above 0 compressed, see :func:`facerelight.model.compression.compress`, and with a checksum.
    """
    path = Path(path)
    header = {"format": FORMAT, "version": FORMAT_VERSION, **notes}
    if coarseness:
        tensors = compress({name: tensor.cpu() for name, tensor in tensors.items()}, coarseness)
        header |= {"compressed": True, "checksum": checksum(tensors)}
    with replacing(path) as partial:
        save_file(
            {name: tensor.contiguous() for name, tensor in tensors.items()},
            partial,
            metadata={"facerelight": json.dumps(header)},
        )


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Read tensors, compressed or not; complete, finite and of fitting shapes, and the notes written with them.

    Raises:
        ValueError: anything else; says what was expected and what was found.
    """
    path = Path(path)
    try:
        with safe_open(path, framework="pt") as file:
            header = json.loads((file.metadata() or {}).get("facerelight", "{}"))
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (OSError, SafetensorError, ValueError) as error:
        raise ValueError(
            f"{path}: expected a statistics file (safetensors), got {error}; train one with `facerelight train`"
        ) from error
    found = (header.pop("format", None), header.pop("version", None)) if isinstance(header, dict) else (None, None)
    if found != (FORMAT, FORMAT_VERSION):
        raise ValueError(
            f"{path}: expected statistics of version {FORMAT_VERSION}, got {found[0]} {found[1]}; train anew"
        )
    if header.pop("compressed", False):
        found_checksum = header.pop("checksum", None)
        tensors = _decompressed(path, tensors, found_checksum)
        header.setdefault("key", str(found_checksum)[:KEY_LENGTH])
    sizes: dict[str, int] = {"3": 3}
    for name, shape in {**LAYOUT, **(FACE_LAYOUT if any(name.startswith("face.") for name in tensors) else {})}.items():
        letters = shape.split()
        if name not in tensors:
            raise ValueError(f"{path}: expected a tensor {name}, found none; train anew")
        got = tuple(tensors[name].shape)
        fits = len(got) == len(letters) and all(
            sizes.setdefault(letter, size) == size for letter, size in zip(letters, got, strict=True)
        )
        if not fits or not torch.is_floating_point(tensors[name]):
            wanted = ", ".join(
                f"{letter} = {sizes[letter]}" if letter in sizes and letter != "3" else letter for letter in letters
            )
            raise ValueError(
                f"{path}: expected {name} of shape ({wanted}), got {tensors[name].dtype} {got}; train anew"
            )
        # NaN and infinity outlive a sum; a sum too large is looked at twice.
        quick = torch.isfinite(tensors[name].sum())
        if not quick and not torch.isfinite(tensors[name]).all():
            raise ValueError(f"{path}: expected finite statistics, got NaN or infinity in {name}; train anew")
    return tensors, header


def _decompressed(path: Path, packed: dict[str, Tensor], expected: object) -> dict[str, Tensor]:
    found = checksum(packed)
    if found != expected:
        raise ValueError(
            f"{path}: expected statistics with checksum {expected}, got {found}; copy or install them anew"
        )
    try:
        return decompress(packed)
    except ValueError as error:
        raise ValueError(f"{path}: {error}; train anew") from error
