"""The classifiers that recognition tables compare, by name.

A name is a method and what is added to it, joined by "+": ``individual_pca_9+detail+cosine+weber_fine``. Methods are
:data:`METHODS` and :data:`BASELINES`; added may be "exemplars" (nearest neighbour over relit images too), "detail"
(exemplars keep the photograph's fine detail), "cosine" (the metric of individual subspaces), "photo" (the sum with the
photograph's own score) and one of the photometric normalisations.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from facerelight.geometry.alignment import CropFrame
from facerelight.inference.detail import keep_detail
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifiers import (
    Classifier,
    GlobalPCAClassifier,
    IndividualPCAClassifier,
    NearestNeighborClassifier,
    SumClassifier,
)
from facerelight.recognition.opencv import OpenCVClassifier, SFaceFeatures
from facerelight.recognition.photometric import NORMALIZERS, make_normalizer

__all__ = ["BASELINES", "CLASSIFIERS", "METHODS", "GalleryImages", "fit_classifier", "is_pairwise", "photometric"]

METHODS = ("nearest_neighbor", "global_pca", "individual_pca", "individual_pca_9", "gaussian_9", "gaussian_mixture_9")
ADDED = ("exemplars", "detail", "cosine", "photo")
BASELINES = ("eigenfaces", "fisherfaces", "lbph", "sface")
CLASSIFIERS = (
    "nearest_neighbor",
    "nearest_neighbor+exemplars",
    "global_pca",
    "individual_pca",
    "individual_pca_9",
    "individual_pca_9+photo",
    "individual_pca_9+detail+cosine",
    "gaussian_9",
    "gaussian_mixture_9",
)
PAIRWISE = ("nearest_neighbor", "individual_pca", "individual_pca_9", "lbph", "sface")


class GalleryImages(NamedTuple):
    """What a gallery is made of: Q exemplars of each of N people.

    ``photos (N, H, W)`` of ``people``; ``relit (N, Q, H, W)``, exemplars; ``shift`` in pixels by which probes may lie
    off.
    """

    photos: Tensor
    people: list[int]
    relit: Tensor
    shift: int

    def rows(self, exemplars: Tensor) -> tuple[Tensor, list[int]]:
        """Each person's ``exemplars (N, Q, H, W)`` and photograph, ``(N (Q + 1), H, W)``, and whose they are."""
        count = exemplars.shape[1] + 1
        images = exemplars.new_empty(len(self.people), count, *exemplars.shape[2:])
        images[:, :-1], images[:, -1] = exemplars, self.photos
        return images.flatten(0, 1), [person for person in self.people for _ in range(count)]


def is_pairwise(name: str) -> bool:
    """Whether a person's score depends on nobody else who is enrolled."""
    return _parse(name)[0] in PAIRWISE


def photometric(name: str) -> str:
    """The normalisation in a classifier's name; baselines have their own."""
    base, _, normalizer = _parse(name)
    return base if base in BASELINES else normalizer


def fit_classifier(name: str, gallery: GalleryImages) -> Classifier:
    """The classifier ``name``, fitted to ``gallery``.

    Raises:
        ValueError: an unknown name; says which there are.
    """
    base, added, normalizer_name = _parse(name)
    photos, people, shift = gallery.photos, gallery.people, gallery.shift
    if base == "sface":
        frame = CropFrame(photos.shape[1], photos.shape[2])
        return NearestNeighborClassifier("cosine", normalizer=SFaceFeatures(frame)).fit(photos, people)
    if base in BASELINES:
        many = base == "fisherfaces"  # needs more than one image a person
        return OpenCVClassifier(base).fit(*(gallery.rows(gallery.relit) if many else (photos, people)))
    normalizer = make_normalizer(normalizer_name)
    nearest = NearestNeighborClassifier(
        "cosine" if normalizer_name != "none" else "l2", normalizer=normalizer, shift=shift
    )
    if base == "nearest_neighbor" and "exemplars" not in added:
        return nearest.fit(photos, people)
    exemplars = keep_detail(gallery.relit, photos, 1.0).clamp_max(1) if "detail" in added else gallery.relit
    rows, owners = gallery.rows(exemplars)
    if base == "nearest_neighbor":
        return NearestNeighborClassifier(normalizer=normalizer, shift=shift).fit(rows, owners)
    if base == "global_pca":
        return GlobalPCAClassifier(40, normalizer=normalizer, shift=shift).fit(rows, owners)
    if base.startswith("gaussian"):
        components = 3 if base == "gaussian_mixture_9" else 1
        return GaussianClassifier(components, 9, normalizer=normalizer, shift=shift).fit(rows, owners)
    subspaces = IndividualPCAClassifier(
        None if base == "individual_pca" else 9,
        normalizer=normalizer,
        shift=shift,
        metric="cosine" if "cosine" in added else "error",
    ).fit(rows, owners)
    return SumClassifier([nearest.fit(photos, people), subspaces]) if "photo" in added else subspaces


def _parse(name: str) -> tuple[str, set[str], str]:
    """Method, what is added, and normalisation."""
    base, *rest = name.split("+")
    normalizer = [part for part in rest if part in NORMALIZERS]
    added = {part for part in rest if part not in NORMALIZERS}
    if base not in (*METHODS, *BASELINES) or added - set(ADDED) or len(normalizer) > 1:
        methods, additions = ", ".join((*METHODS, *BASELINES)), ", ".join((*ADDED, *NORMALIZERS))
        raise ValueError(f"classifier: expected one of {methods}, with + and {additions} where wanted, got {name!r}")
    return base, added, normalizer[0] if normalizer else "none"
