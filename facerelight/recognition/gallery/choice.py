"""Which recogniser: the deep network where its weights are installed, and the thesis's where it is asked for."""

from __future__ import annotations

from collections.abc import Callable

from facerelight.inference.relighter import StatisticalRelighter
from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer
from facerelight.recognition.gallery.individual import IndividualRecognizer
from facerelight.recognition.gallery.recognizer import Recognizer
from facerelight.recognition.sface import SFace, sface_weights

__all__ = ["RECOGNIZERS", "default_recognizer", "make_recognizer"]

RECOGNIZERS = ("sface", "individual_pca")


def default_recognizer() -> str:
    """ "sface" where its weights are installed, else "individual_pca"."""
    return "individual_pca" if sface_weights() is None else "sface"


def make_recognizer(name: str, relighter: Callable[[], StatisticalRelighter]) -> Recognizer:
    """One of :data:`RECOGNIZERS`; the ``relighter`` is asked for where it is needed.

    Raises:
        ValueError: an unknown name.
        RuntimeError: the network's weights are not installed.
    """
    if name not in RECOGNIZERS:
        raise ValueError(f"classifier: expected one of {', '.join(RECOGNIZERS)}, got {name!r}")
    return EmbeddingRecognizer(SFace()) if name == "sface" else IndividualRecognizer(relighter())
