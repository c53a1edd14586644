"""What others use, in this package's manner, to stand beside it in every table: OpenCV's classical recognisers and a
deep one."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor, nn

from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.recognition.classifier import Classifier
from facerelight.recognition.embedding import Embedding, srgb_bytes

__all__ = ["EmbeddingFeatures", "OpenCVClassifier"]

opencv: Any = cv2  # its stubs lack the contributed modules
RECOGNIZERS = {
    "eigenfaces": opencv.face.EigenFaceRecognizer_create,
    "fisherfaces": opencv.face.FisherFaceRecognizer_create,
    "lbph": opencv.face.LBPHFaceRecognizer_create,
}
CROPS_KEPT = 4096  # by an embedding: 2 MB of 128 numbers each


class OpenCVClassifier(Classifier):
    """``cv2.face``: "eigenfaces" (Turk and Pentland 1991), "fisherfaces" (Belhumeur et al. 1997; more than one image a
    person) or "lbph" (Ahonen et al. 2004), each with OpenCV's own settings, given the
    sRGB codes that a photograph on disk holds.

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


class EmbeddingFeatures(nn.Module):
    """An embedding as a normaliser of aligned crops in radiance: compare its vectors by cosine.

    Networks are trained on photographs as cameras write them: radiance is coded as sRGB first. Vectors of
    the last ``CROPS_KEPT`` crops are kept, for tables probe with the very photographs that they enroll, and a network
    is slow.

    Args:
        embedding: such as :class:`facerelight.recognition.sface.SFace`.
        frame: the crop that images come in.

    Shape: ``(M, H, W)`` radiance to ``(M, 1, D)``.
    """

    def __init__(self, embedding: Embedding, frame: CropFrame) -> None:
        super().__init__()
        self.embedding, self.frame = embedding, frame
        self._known: OrderedDict[bytes, Tensor] = OrderedDict()  # the longest unused first

    def forward(self, images: Tensor) -> Tensor:
        crop = self.embedding.crop
        points = torch.tensor(crop.points, dtype=torch.float64)
        target = torch.stack((points[0], points[1], points[3:].mean(0)))
        matrix = fit_similarity(self.frame.landmarks, target)
        faces = warp_to_crop(images[:, None], matrix.expand(len(images), -1, -1), CropFrame(crop.side, crop.side))
        coded = srgb_bytes(faces[:, 0])
        keys = [hashlib.sha256(one).digest() for one in coded]
        new = {key: row for row, key in enumerate(keys) if key not in self._known}
        if new:
            vectors = self.embedding(np.repeat(coded[list(new.values()), ..., None], 3, axis=3))
            self._known |= {key: vector.clone() for key, vector in zip(new, vectors, strict=True)}
        for key in keys:
            self._known.move_to_end(key)
        found = torch.stack([self._known[key] for key in keys])[:, None]
        while len(self._known) > CROPS_KEPT:
            self._known.popitem(last=False)
        return found


def _bytes(images: Tensor) -> list[np.ndarray]:
    return list(srgb_bytes(images))
