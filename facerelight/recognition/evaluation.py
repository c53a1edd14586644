"""Recognition measured: one training image a person under one light, all other images as probes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.bootstrap.dataset import FaceImages, to_grid
from facerelight.recognition.baselines import OpenCVClassifier, SFaceFeatures
from facerelight.recognition.class_conditional import GaussianClassifier
from facerelight.recognition.classifiers import (
    Classifier,
    GlobalPCAClassifier,
    IndividualPCAClassifier,
    NearestNeighborClassifier,
    SumClassifier,
)
from facerelight.recognition.exemplars import exemplar_lights, synthesize
from facerelight.recognition.photometric import make_normalizer
from facerelight.relighter import StatisticalRelighter

__all__ = ["BASELINES", "CLASSIFIERS", "Tally", "evaluate_gallery", "pie_as_canonical", "training_lights"]

PIE_LANDMARKS = ((12.0, 20.0), (32.0, 20.0), (22.0, 41.5))

CLASSIFIERS = (
    "nearest_neighbor",
    "nearest_neighbor+exemplars",
    "global_pca",
    "individual_pca",
    "individual_pca_9",
    "individual_pca_9+photo",
    "gaussian_9",
    "gaussian_mixture_9",
)
BASELINES = ("eigenfaces", "fisherfaces", "lbph", "sface")


class Tally(NamedTuple):
    """Of one classifier on one gallery: ``right (M,)`` bool, ``subset (M,)``, ``seconds`` in all."""

    right: Tensor
    subset: Tensor
    seconds: float


def pie_as_canonical(faces: FaceImages, frame: CropFrame) -> FaceImages:
    """CMU PIE's 55 x 44 crops moved into the canonical one, by the landmarks that they share."""
    matrix = fit_similarity(torch.tensor(PIE_LANDMARKS, dtype=torch.float64), frame.landmarks)
    moved = warp_to_crop(faces.images[:, None], matrix.expand(len(faces.images), -1, -1), frame)[:, 0]
    return faces._replace(images=moved)


def training_lights(faces: FaceImages, people: list[int], case: str, draws: int, seed: int = 0) -> Iterator[dict[int, int]]:
    """Galleries of a protocol: which light each person's one training image has.

    Args:
        faces: the data.
        people: the gallery.
        case: "front", "side" (azimuth +70), "same" (each light in turn for everybody), "random", or "random-mild" (subsets 1 to 4).
        draws: galleries drawn in the random cases.
        seed: of the draws.
    """
    _, valid = to_grid(faces)
    subset = torch.zeros(len(faces.lights), dtype=torch.long).index_copy_(0, faces.light, faces.subset)
    if case in ("front", "side"):
        wanted = torch.tensor((0.0 if case == "front" else 70.0, 0.0))
        light = int((faces.angles - wanted).abs().sum(1).argmin())
        yield {person: light for person in people if valid[person, light]}
    elif case == "same":
        for light in range(len(faces.lights)):
            yield {person: light for person in people if valid[person, light]}
    elif case in ("random", "random-mild"):
        generator = torch.Generator().manual_seed(seed)
        allowed = (subset <= 4) if case == "random-mild" else torch.ones_like(subset, dtype=torch.bool)
        for _ in range(draws):
            order = torch.randperm(len(faces.lights), generator=generator).tolist()
            free = [light for light in order if allowed[light]]
            gallery = {}
            for person in people:
                chosen = next((x for x in free if valid[person, x]), None)
                if chosen is not None:
                    gallery[person] = chosen
                    free.remove(chosen)
            yield gallery
    else:
        raise ValueError(f"train light: expected front, side, same, random or random-mild, got {case!r}")


def evaluate_gallery(
    faces: FaceImages,
    gallery: dict[int, int],
    relighter: StatisticalRelighter,
    classifiers: list[str],
    estimated: bool = False,
    exemplars: str = "dome",
    shift: int = 0,
    register: bool = False,
) -> dict[str, Tally]:
    """Fit every classifier to one gallery and count right answers over all other images of its people.

    Args:
        faces: the data.
        gallery: person to light of the training image.
        relighter: synthesises exemplars.
        classifiers: names of :data:`CLASSIFIERS`, each with "+tan_triggs", "+weber" or "+unit" where wanted, and of :data:`BASELINES`.
        estimated: estimate the training images' lights instead of taking the labels.
        exemplars: lights to synthesise under, see :func:`exemplar_lights`.
        shift: pixels by which probes may lie off, for all classifiers.
        register: find where each training image's face lies beside the model's before it is relit (and relit there).
    """
    images, valid = to_grid(faces)
    subset = torch.zeros(len(faces.lights), dtype=torch.long).index_copy_(0, faces.light, faces.subset)
    people = list(gallery)
    training = torch.stack([images[person, light] for person, light in gallery.items()])
    probes, labels, parts = [], [], []
    for person, light in gallery.items():
        others = [x for x in valid[person].nonzero()[:, 0].tolist() if x != light]
        probes.append(images[person, others])
        labels += [person] * len(others)
        parts.append(subset[others])
    stack = torch.cat(probes)
    given = None if estimated else torch.stack([faces.lights[light][None] for light in gallery.values()])
    posterior = relighter.condition(training[:, None], given, draws=8, register=register)
    lights, _ = exemplar_lights(exemplars)
    relit = synthesize(posterior, lights)
    rows = torch.cat((relit, training[:, None]), 1).flatten(0, 1)
    owners = [person for person in people for _ in range(relit.shape[1] + 1)]
    data = _Gallery(training, people, rows, owners, (faces.images.shape[1], faces.images.shape[2]), shift)
    tallies = {}
    for name in classifiers:
        started = time.perf_counter()
        found = _fitted(name, data).predict(stack)
        right = torch.tensor([a == b for a, b in zip(found, labels, strict=True)])
        tallies[name] = Tally(right, torch.cat(parts), time.perf_counter() - started)
    return tallies


class _Gallery(NamedTuple):
    """``photos`` of ``people``; ``rows``, these and their exemplars, of ``owners``; the images' ``size`` and the probes' ``shift``."""

    photos: Tensor
    people: list[int]
    rows: Tensor
    owners: list[int]
    size: tuple[int, int]
    shift: int


def _fitted(name: str, data: _Gallery) -> Classifier:
    """The classifier ``name``, fitted."""
    if name in BASELINES:
        if name == "sface":
            return NearestNeighborClassifier("cosine", normalizer=SFaceFeatures(CropFrame(*data.size))).fit(data.photos, data.people)
        many = name == "fisherfaces"  # needs more than one image a person
        return OpenCVClassifier(name).fit(data.rows if many else data.photos, data.owners if many else data.people)
    base, photometric = _split_name(name)
    normalizer, shift = make_normalizer(photometric), data.shift
    photo = NearestNeighborClassifier("cosine" if photometric else "l2", normalizer=normalizer, shift=shift)
    if base == "nearest_neighbor":
        return photo.fit(data.photos, data.people)
    if base == "nearest_neighbor+exemplars":
        return NearestNeighborClassifier(normalizer=normalizer, shift=shift).fit(data.rows, data.owners)
    if base == "global_pca":
        return GlobalPCAClassifier(40, normalizer=normalizer, shift=shift).fit(data.rows, data.owners)
    if base.startswith("gaussian"):
        components = 3 if base == "gaussian_mixture_9" else 1
        return GaussianClassifier(components, 9, normalizer=normalizer, shift=shift).fit(data.rows, data.owners)
    subspaces = IndividualPCAClassifier(None if base == "individual_pca" else 9, normalizer=normalizer, shift=shift)
    subspaces.fit(data.rows, data.owners)
    return SumClassifier([photo.fit(data.photos, data.people), subspaces]) if base.endswith("+photo") else subspaces


def _split_name(name: str) -> tuple[str, str | None]:
    for suffix in ("tan_triggs", "weber", "unit"):
        if name.endswith("+" + suffix):
            name = name.removesuffix("+" + suffix)
            break
    else:
        suffix = ""
    if name not in CLASSIFIERS:
        raise ValueError(f"classifier: expected one of {', '.join(CLASSIFIERS)} (+tan_triggs, +weber, +unit), got {name!r}")
    return name, suffix or None
