"""The classifiers that recognition tables compare, by name; each is registered once, here or by its user.

A name is a method and what is added to it, joined by "+": ``individual_pca_9+detail+cosine+weber_fine``. Added may be
"exemplars" (nearest neighbour over relit images too), "detail" (exemplars keep the photograph's fine detail), "cosine"
(the metric of individual subspaces), "photo" (the sum with the photograph's own score) and one of the photometric
normalisations. To add a method, write a function from a gallery to a fitted classifier, and :func:`register` it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from torch import Tensor

from facerelight.geometry.alignment import CropFrame
from facerelight.inference.detail import keep_detail
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifier import Classifier, SumClassifier
from facerelight.recognition.nearest import NearestNeighborClassifier
from facerelight.recognition.opencv import EmbeddingFeatures, OpenCVClassifier
from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
from facerelight.recognition.photometric import NORMALIZERS, make_normalizer
from facerelight.recognition.sface import SFace

__all__ = [
    "GalleryImages",
    "Recipe",
    "baseline_names",
    "fit_classifier",
    "is_pairwise",
    "needs_exemplars",
    "register",
    "table_names",
]

FISHER_STEP = 4  # every so many exemplars: OpenCV solves for eigenvectors in a time that grows with their cube
ADDED = ("exemplars", "detail", "cosine", "photo")


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


class Recipe(NamedTuple):
    """A classifier's name taken apart: the ``method``, what is ``added`` to it, and the photometric ``normalizer``."""

    method: str
    added: frozenset[str]
    normalizer: str


Make = Callable[[GalleryImages, Recipe], Classifier]


class _Method(NamedTuple):
    make: Make
    relit: bool
    pairwise: bool
    baseline: bool
    table: tuple[str, ...]


_METHODS: dict[str, _Method] = {}


def register(
    name: str,
    pairwise: bool = False,
    baseline: bool = False,
    table: tuple[str, ...] | None = None,
    relit: bool = True,
) -> Callable[[Make], Make]:
    """Make a classifier known by ``name``: a decorator of a function that fits it to a gallery.

    Args:
        name: without "+"; a name that is taken already is an error.
        pairwise: whether a person's score depends on nobody else who is enrolled; such scores are shared by galleries.
        baseline: somebody else's method, with a normalisation of its own.
        table: the forms that tables show by default; None: the plain one, or none for a baseline.
        relit: whether it is fitted to relit pictures too; False: the photographs alone, and nothing is relit for it.
    """
    if name in _METHODS or "+" in name:
        raise ValueError(f"name: expected a new one without '+', got {name!r}; taken are {', '.join(_METHODS)}")

    def keep(make: Make) -> Make:
        shown = (() if baseline else (name,)) if table is None else table
        _METHODS[name] = _Method(make, relit, pairwise, baseline, shown)
        return make

    return keep


def table_names() -> tuple[str, ...]:
    """What tables compare by default, without normalisation."""
    return tuple(form for method in _METHODS.values() for form in method.table)


def baseline_names() -> tuple[str, ...]:
    """What others use."""
    return tuple(name for name, method in _METHODS.items() if method.baseline)


def is_pairwise(name: str) -> bool:
    """Whether a person's score depends on nobody else who is enrolled."""
    return _METHODS[_parse(name).method].pairwise


def needs_exemplars(name: str) -> bool:
    """Whether a classifier is fitted to relit pictures, and not to the photographs alone."""
    recipe = _parse(name)
    return _METHODS[recipe.method].relit or "exemplars" in recipe.added


def fit_classifier(name: str, gallery: GalleryImages) -> Classifier:
    """The classifier ``name``, fitted to ``gallery``.

    Raises:
        ValueError: an unknown name; says which there are.
    """
    recipe = _parse(name)
    return _METHODS[recipe.method].make(gallery, recipe)


def _parse(name: str) -> Recipe:
    method, *rest = name.split("+")
    normalizer = [part for part in rest if part in NORMALIZERS]
    added = frozenset(rest) - set(NORMALIZERS)
    if method not in _METHODS or added - set(ADDED) or len(normalizer) > 1:
        methods, additions = ", ".join(_METHODS), ", ".join((*ADDED, *NORMALIZERS))
        raise ValueError(f"classifier: expected one of {methods}, with + and {additions} where wanted, got {name!r}")
    return Recipe(method, added, normalizer[0] if normalizer else "none")


def _exemplars(gallery: GalleryImages, recipe: Recipe) -> tuple[Tensor, list[int]]:
    """Everybody's exemplars and photographs ``(M, H, W)``, and whose they are."""
    detailed = "detail" in recipe.added
    return gallery.rows(keep_detail(gallery.relit, gallery.photos, 1.0).clamp_max(1) if detailed else gallery.relit)


def _nearest_photo(gallery: GalleryImages, recipe: Recipe) -> Classifier:
    metric = "cosine" if recipe.normalizer != "none" else "l2"
    classifier = NearestNeighborClassifier(metric, normalizer=make_normalizer(recipe.normalizer), shift=gallery.shift)
    return classifier.fit(gallery.photos, gallery.people)


@register("nearest_neighbor", pairwise=True, relit=False, table=("nearest_neighbor", "nearest_neighbor+exemplars"))
def _nearest(gallery: GalleryImages, recipe: Recipe) -> Classifier:
    if "exemplars" not in recipe.added:
        return _nearest_photo(gallery, recipe)
    classifier = NearestNeighborClassifier(normalizer=make_normalizer(recipe.normalizer), shift=gallery.shift)
    return classifier.fit(*_exemplars(gallery, recipe))


@register("global_pca")
def _global_pca(gallery: GalleryImages, recipe: Recipe) -> Classifier:
    classifier = GlobalPCAClassifier(40, normalizer=make_normalizer(recipe.normalizer), shift=gallery.shift)
    return classifier.fit(*_exemplars(gallery, recipe))


def _individual_pca(gallery: GalleryImages, recipe: Recipe, dimension: int | None) -> Classifier:
    subspaces = IndividualPCAClassifier(
        dimension,
        normalizer=make_normalizer(recipe.normalizer),
        shift=gallery.shift,
        metric="cosine" if "cosine" in recipe.added else "error",
    ).fit(*_exemplars(gallery, recipe))
    return SumClassifier([_nearest_photo(gallery, recipe), subspaces]) if "photo" in recipe.added else subspaces


register("individual_pca", pairwise=True)(partial(_individual_pca, dimension=None))
register(
    "individual_pca_9",
    pairwise=True,
    table=("individual_pca_9", "individual_pca_9+photo", "individual_pca_9+detail+cosine"),
)(partial(_individual_pca, dimension=9))


def _gaussian(gallery: GalleryImages, recipe: Recipe, components: int) -> Classifier:
    classifier = GaussianClassifier(components, 9, normalizer=make_normalizer(recipe.normalizer), shift=gallery.shift)
    return classifier.fit(*_exemplars(gallery, recipe))


register("gaussian_9")(partial(_gaussian, components=1))
register("gaussian_mixture_9")(partial(_gaussian, components=3))


def _opencv(gallery: GalleryImages, recipe: Recipe) -> Classifier:
    several = recipe.method == "fisherfaces"  # needs more than one image a person; all would take it minutes
    images = gallery.rows(gallery.relit[:, ::FISHER_STEP]) if several else (gallery.photos, gallery.people)
    return OpenCVClassifier(recipe.method).fit(*images)


register("eigenfaces", baseline=True, relit=False)(_opencv)
register("fisherfaces", baseline=True)(_opencv)
register("lbph", baseline=True, pairwise=True, relit=False)(_opencv)


@register("sface", baseline=True, pairwise=True, relit=False)
def _sface(gallery: GalleryImages, recipe: Recipe) -> Classifier:
    normalizer = EmbeddingFeatures(SFace(), CropFrame(*gallery.photos.shape[1:]))
    return NearestNeighborClassifier("cosine", normalizer=normalizer).fit(gallery.photos, gallery.people)
