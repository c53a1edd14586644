"""Faces compared by an embedding: cosines, exact up to ten thousand templates, by a compressed index beyond."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from facerelight.photo.faces.landmarks import Face
from facerelight.recognition.embedding import Embedding, aligned_crop
from facerelight.recognition.gallery.recognizer import Index, Levels, Template

__all__ = ["CompressedIndex", "EmbeddingRecognizer", "ExactIndex"]

VERSION = 1
EXACT = 10_000  # templates: more are searched by FAISS where it is installed
CANDIDATES = 200  # that are compared exactly
TRAINED_ON = 100_000
SFACE_LEVELS = Levels(0.148, 0.089, 2.13, -8.23)


class EmbeddingRecognizer:
    """Cosine between embeddings.

    Args:
        embedding: such as :class:`facerelight.recognition.sface.SFace`.
        levels: of its cosines, see :class:`Levels`; default: SFace's.
        name: as the command line calls it.
    """

    personal = False

    def __init__(self, embedding: Embedding, levels: Levels = SFACE_LEVELS, name: str = "sface") -> None:
        self.embedding, self.levels, self.name = embedding, levels, name

    def key(self) -> dict[str, object]:
        """See :class:`facerelight.recognition.gallery.recognizer.Recognizer`."""
        crop = self.embedding.crop
        points = [list(point) for point in crop.points]
        return {"model": self.embedding.name, "crop": [crop.side, points], "version": VERSION}

    def describe(self, photo: np.ndarray, face: Face) -> Tensor:
        """The embedding, ``(D,)``."""
        return self.embedding(aligned_crop(photo, face, self.embedding.crop)[None])[0]

    def enroll(self, photo: np.ndarray, face: Face) -> Template:
        """The same as "probe"."""
        return {"probe": self.describe(photo, face)[None]}

    def index(self, templates: Template, owners: Tensor) -> Index:
        """Exact for up to ten thousand templates, and where FAISS is not installed."""
        vectors = templates["probe"]
        return CompressedIndex(vectors) if len(vectors) > EXACT and find_spec("faiss") else ExactIndex(vectors)


class ExactIndex:
    """Every cosine with ``vectors (M, D)`` of unit length.

    Example:
        >>> ExactIndex(torch.eye(3)).search(torch.tensor([0.0, 1.0, 0.0]), 1)[1].tolist()
        [1]
    """

    def __init__(self, vectors: Tensor) -> None:
        self.vectors = vectors

    def search(self, probe: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """See :class:`facerelight.recognition.gallery.recognizer.Index`."""
        best = (self.vectors @ probe).topk(min(count, len(self.vectors)))
        return best.values, best.indices


class CompressedIndex:
    """FAISS: product quantisation at four bits for every two numbers finds candidates (Andre et al. 2015), which are
    then compared exactly.

    Args:
        vectors: ``(M, D)`` float32 of unit length, D even, M at least 16.

    Raises:
        ValueError: vectors of another shape.
    """

    def __init__(self, vectors: Tensor) -> None:
        if vectors.dim() != 2 or vectors.shape[1] % 2 or len(vectors) < 16:
            raise ValueError(f"vectors: expected (M, D), M >= 16 and D even, got {tuple(vectors.shape)}")
        import faiss

        self.vectors = vectors.float().contiguous()
        size = vectors.shape[1]
        self._codes: Any = faiss.IndexPQFastScan(size, size // 2, 4, faiss.METRIC_INNER_PRODUCT)
        step = max(1, len(vectors) // TRAINED_ON)
        self._codes.train(self.vectors[::step].numpy())
        self._codes.add(self.vectors.numpy())

    def search(self, probe: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """See :class:`facerelight.recognition.gallery.recognizer.Index`; the candidates are at least 200."""
        wanted = min(max(CANDIDATES, count), len(self.vectors))
        _, found = self._codes.search(probe.float()[None].numpy(), wanted)
        rows = torch.from_numpy(found[0][found[0] >= 0])
        best = (self.vectors[rows] @ probe.float()).topk(min(count, len(rows)))
        return best.values, rows[best.indices]
