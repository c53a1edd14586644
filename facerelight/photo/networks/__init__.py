"""The small networks that the package carries, with their checksums; authors and licences: ``NOTICE.md`` beside it."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

__all__ = ["CHECKSUMS", "FACE_MESH", "SELFIE_SEGMENTATION", "YUNET", "network_path"]

YUNET = "face_detection_yunet_2023mar_int8bq.onnx"
FACE_MESH = "face_landmark.tflite"
SELFIE_SEGMENTATION = "selfie_segmentation.tflite"
CHECKSUMS = {
    YUNET: "49f000ec501fef24739071fc7e68267d32209045b6822c0c72dce1da25726f10",
    FACE_MESH: "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
    SELFIE_SEGMENTATION: "9ee168ec7c8f2a16c56fe8e1cfbc514974cbbb7e434051b455635f1bd1462f5c",
}
"""SHA-256 of every network, by file name."""
REMEDY = "install facerelight anew or run scripts/data/pack_networks.py"


def network_path(name: str) -> Path:
    """Where a network lies on disk; its checksum is verified once a process.

    Args:
        name: one of :data:`CHECKSUMS`.

    Raises:
        ValueError: an unknown name.
        RuntimeError: the file is missing or damaged; says how to get it back.

    Example:
        >>> network_path(YUNET).name
        'face_detection_yunet_2023mar_int8bq.onnx'
    """
    if name not in CHECKSUMS:
        raise ValueError(f"network: expected one of {', '.join(CHECKSUMS)}, got {name!r}")
    return _verified(Path(__file__).parent / name, CHECKSUMS[name])


@lru_cache(maxsize=8)
def _verified(path: Path, checksum: str) -> Path:
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        reason = error.strerror or error
        raise RuntimeError(f"{path}: expected a network of the package, got {reason}; {REMEDY}") from error
    if found != checksum:
        differs = f"expected SHA-256 {checksum[:12]}..., got {found[:12]}..."
        raise RuntimeError(f"{path}: {differs}: the file is damaged; {REMEDY}")
    return path
