"""Recognition measured: one training image a person under one light, all other images as probes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.evaluation.datasets import FaceImages, to_grid
from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.recognition.exemplars import exemplar_lights, synthesize
from facerelight.recognition.registry import GalleryImages, fit_classifier, is_pairwise, needs_exemplars

__all__ = ["Enrolment", "Tally", "evaluate_galleries", "pie_as_canonical", "training_lights"]

PIE_LANDMARKS = ((12.0, 20.0), (32.0, 20.0), (22.0, 41.5))


@dataclass(frozen=True)
class Enrolment:
    """How training images become exemplars, and probes are compared.

    Args:
        estimated: estimate the training images' lights instead of taking the labels.
        exemplars: lights to synthesise under, see :func:`exemplar_lights`.
        shift: pixels by which probes may lie off, for all classifiers.
        register: find where each training image's face lies beside the model's before it is relit (and relit there).
    """

    estimated: bool = False
    exemplars: str = "dome"
    shift: int = 0
    register: bool = False


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


def training_lights(
    faces: FaceImages, people: list[int], case: str, draws: int, seed: int = 0
) -> Iterator[dict[int, int]]:
    """Galleries of a protocol: which light each person's one training image has.

    Args:
        faces: the data.
        people: the gallery.
        case: "front", "side" (azimuth +70), "same" (each light in turn for everybody), "random", or "random-mild"
            (subsets 1 to 4).
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


def evaluate_galleries(
    faces: FaceImages,
    galleries: list[dict[int, int]],
    relighter: StatisticalRelighter,
    classifiers: list[str],
    enrolment: Enrolment | None = None,
) -> dict[str, list[Tally]]:
    """Fit every classifier to every gallery and count right answers over all other images of its people.

    Where a person's score depends on nobody else, each training image is enrolled and compared with all images once,
    however many galleries it is in.

    Args:
        faces: the data.
        galleries: person to light of the training image.
        relighter: synthesises exemplars.
        classifiers: names, see :mod:`facerelight.recognition.registry`.
        enrolment: how; default: known lights, no shifts, no registration.
    """
    how = enrolment or Enrolment()
    grid, _ = to_grid(faces)
    tables = _score_tables(faces, grid, galleries, relighter, [name for name in classifiers if is_pairwise(name)], how)
    tallies: dict[str, list[Tally]] = {name: [] for name in classifiers}
    for gallery in galleries:
        people, lights = torch.tensor(list(gallery)), torch.tensor(list(gallery.values()))
        light_of = torch.full((len(faces.names),), -1).index_copy_(0, people, lights)
        probes = (light_of[faces.subject] >= 0) & (light_of[faces.subject] != faces.light)
        fitted = [name for name in classifiers if name not in tables]
        images = _enroll(faces, grid, list(gallery.items()), relighter, how, fitted) if fitted else None
        for name in classifiers:
            started = time.perf_counter()
            if name in tables:
                scores, rate = tables[name]
                found = people[scores[:, people, lights][probes].argmax(1)]
                seconds = rate * len(people) * int(probes.sum())
            else:
                assert images is not None
                found = people[torch.tensor(fit_classifier(name, images).predict(faces.images[probes]))]
                seconds = time.perf_counter() - started
            tallies[name].append(Tally(found == faces.subject[probes], faces.subset[probes], seconds))
    return tallies


def _score_tables(
    faces: FaceImages,
    grid: Tensor,
    galleries: list[dict[int, int]],
    relighter: StatisticalRelighter,
    classifiers: list[str],
    how: Enrolment,
) -> dict[str, tuple[Tensor, float]]:
    """Scores of all M images for every training image in ``galleries``, ``(M, people, lights)``, and seconds a
    comparison, by name."""
    wanted: dict[int, set[int]] = defaultdict(set)
    for gallery in galleries:
        for person, light in gallery.items():
            wanted[light].add(person)
    pairs = {light: [(person, light) for person in sorted(people)] for light, people in wanted.items()}
    everybody = list(chain(*pairs.values()))
    relit = [name for name in classifiers if needs_exemplars(name)]
    plain = [name for name in classifiers if name not in relit]
    # Of photographs alone all are enrolled at once; relit pictures are too many for that.
    batches = [(everybody, plain)] * bool(plain) + [(part, relit) for part in pairs.values()] * bool(relit)
    shape = len(faces.images), len(faces.names), len(faces.lights)
    tables = {name: torch.full(shape, -torch.inf) for name in classifiers}
    seconds: dict[str, float] = defaultdict(float)
    views: dict[Hashable, list[Tensor]] = {}
    for part, names in batches:
        images = _enroll(faces, grid, part, relighter, how, names)
        for name in names:
            classifier = fit_classifier(name, images)
            key = classifier.view_key()
            if key not in views:
                views[key] = list(classifier.views(faces.images))
            started = time.perf_counter()
            scores = classifier.compare(views[key])
            seconds[name] += time.perf_counter() - started
            people, lights = torch.tensor(part)[torch.tensor(classifier.classes_)].T
            tables[name][:, people, lights] = scores
    compared = shape[0] * max(len(everybody), 1)
    return {name: (table, seconds[name] / compared) for name, table in tables.items()}


def _enroll(
    faces: FaceImages,
    grid: Tensor,
    pairs: list[tuple[int, int]],
    relighter: StatisticalRelighter,
    how: Enrolment,
    classifiers: list[str],
) -> GalleryImages:
    """Training images, by person and light of all ``grid (people, lights, H, W)``, numbered in order, and their
    exemplars; none where no classifier asks for them."""
    photos, numbers = torch.stack([grid[pair] for pair in pairs]), list(range(len(pairs)))
    if not any(map(needs_exemplars, classifiers)):
        return GalleryImages(photos, numbers, photos[:, None][:, :0], how.shift)
    given = None if how.estimated else torch.stack([faces.lights[light][None] for _, light in pairs])
    posterior = relighter.condition(photos[:, None], given, draws=8, register=how.register)
    lights, _ = exemplar_lights(how.exemplars)
    relit = synthesize(posterior, lights)
    return GalleryImages(photos, numbers, relit, how.shift)
