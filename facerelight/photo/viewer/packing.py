"""Arrays in one block of bytes: whole numbers of 8 or 16 bits, each less what its neighbours foretell, deflated."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Packed", "pack", "unpack"]


class Packed(NamedTuple):
    """``values``, any number of dimensions, the last two a map's rows and columns; kept to within half a ``step``.

    A step of 1/255 with all values in 0..1 takes one byte a value, any other takes two.
    """

    values: np.ndarray
    step: float


def pack(arrays: Mapping[str, Packed], facts: Mapping[str, Any]) -> str:
    """Base64 of: the header's length as four bytes, little-endian; the header, JSON; the arrays, deflated together.

    Args:
        arrays: by name.
        facts: what goes into the header as it is, beside ``arrays``.

    Raises:
        ValueError: values that 16 bits do not hold at their step.

    Example:
        >>> text = pack({"ramp": Packed(np.arange(6).reshape(2, 3) / 4, 2**-8)}, {"name": "a"})
        >>> arrays, facts = unpack(text)
        >>> facts["name"], arrays["ramp"].tolist()
        ('a', [[0.0, 0.25, 0.5], [0.75, 1.0, 1.25]])
    """
    blocks, entries = [], {}
    for name, (values, step) in arrays.items():
        whole = np.round(np.asarray(values, np.float64) / step)
        kind = np.uint8 if step == 1 / 255 and whole.min() >= 0 and whole.max() <= 255 else np.int16
        if not (np.isfinite(whole).all() and np.abs(whole).max() <= 32767):
            raise ValueError(
                f"{name}: expected finite values within {32767 * step:g}, got up to {np.abs(values).max()}"
            )
        bits = 8 * np.dtype(kind).itemsize
        foretold = _differences(whole.astype(np.int64)) % 2**bits
        blocks.append(foretold.astype(f"<u{bits // 8}").tobytes())
        entries[name] = {"shape": list(whole.shape), "step": step, "bits": bits, "signed": kind is np.int16}
    header = json.dumps({**facts, "arrays": entries}).encode()
    header += b" " * (-len(header) % 4)
    body = zlib.compress(b"".join(blocks), 9)
    return base64.b64encode(len(header).to_bytes(4, "little") + header + body).decode()


def unpack(text: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the facts of :func:`pack`."""
    raw = base64.b64decode(text)
    end = 4 + int.from_bytes(raw[:4], "little")
    facts = json.loads(raw[4:end])
    body, place, arrays = zlib.decompress(raw[end:]), 0, {}
    for name, entry in facts.pop("arrays").items():
        count = int(np.prod(entry["shape"]))
        coded = np.frombuffer(body, f"<u{entry['bits'] // 8}", count, place).astype(np.int64).reshape(entry["shape"])
        place += count * entry["bits"] // 8
        summed = coded
        for axis in range(-min(coded.ndim, 2), 0):
            summed = summed.cumsum(axis)
        whole = summed % 2 ** entry["bits"]
        if entry["signed"]:
            whole = np.where(whole >= 2 ** (entry["bits"] - 1), whole - 2 ** entry["bits"], whole)
        arrays[name] = (whole * entry["step"]).astype(np.float32)
    return arrays, facts


def _differences(whole: np.ndarray) -> np.ndarray:
    """Each value less what left, above and above left of it foretell, ``left + above - above left``."""
    for axis in range(-min(whole.ndim, 2), 0):
        whole = np.diff(whole, axis=axis, prepend=0)
    return whole
