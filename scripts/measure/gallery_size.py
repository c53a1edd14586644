"""A gallery of a million people: memory, milliseconds a probe, and what the compressed index misses.

    python scripts/measure/gallery_size.py --csv

Embeddings are synthetic: identities are random directions of 128 numbers, and photographs of one person lie around
theirs at the cosine that SFace's have on photographs (`--similarity`). Probes are other photographs of people enrolled
("recall": the best match is the one of an exact search) and of strangers. Networks and photographs take no part.
"""

import resource
import time

import numpy as np
import torch

from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.photo.faces.landmarks import Face
from facerelight.recognition.embedding import CropPoints
from facerelight.recognition.gallery.embeddings import EmbeddingRecognizer, ExactIndex
from facerelight.recognition.gallery.gallery import Gallery
from facerelight.recognition.sface import SFACE_CROP

DIMENSION = 128
POINTS = np.array(SFACE_CROP.points)
FACE = Face(np.vstack((POINTS[:2], POINTS[3:].mean(0))), None, (0.0, 0.0, 224.0, 224.0), 1.0, None, True, 1.0)


class Prepared:
    """An embedding that answers with ``vector``, whatever it is shown."""

    name = "prepared"
    crop: CropPoints = SFACE_CROP

    def __init__(self) -> None:
        self.vector = torch.zeros(DIMENSION)

    def __call__(self, crops: np.ndarray) -> torch.Tensor:
        return self.vector.expand(len(crops), -1)


def photographs(centres: torch.Tensor, similarity: float, generator: torch.Generator) -> torch.Tensor:
    """One photograph of each identity ``(N, D)``; two of one have about the cosine ``similarity``."""
    noise = torch.randn(centres.shape, generator=generator)
    noise -= (noise * centres).sum(1, keepdim=True) * centres
    noise = torch.nn.functional.normalize(noise, dim=1, out=noise)
    return noise.mul_((1 - similarity) ** 0.5).add_(centres, alpha=similarity**0.5)


def measure(people: int, probes: int, similarity: float) -> dict[str, object]:
    generator = torch.Generator().manual_seed(people)
    centres = torch.nn.functional.normalize(torch.randn(people, DIMENSION, generator=generator), dim=1)
    embedding = Prepared()
    gallery = Gallery(EmbeddingRecognizer(embedding))
    gallery.add_templates([str(i) for i in range(people)], {"probe": photographs(centres, similarity, generator)})
    again = photographs(centres[:: max(1, people // probes)][:probes], similarity, generator)
    strangers = torch.nn.functional.normalize(torch.randn(probes, DIMENSION, generator=generator), dim=1)
    del centres
    photo = np.zeros((224, 224, 3), np.uint8)

    def named(vector: torch.Tensor) -> tuple[str, bool]:
        embedding.vector = vector
        found = gallery.compare(photo, FACE)
        return found.matches[0].name, found.name is not None

    started = time.perf_counter()
    named(again[0])
    building = time.perf_counter() - started
    started = time.perf_counter()
    answers = [named(vector) for vector in again]
    each = (time.perf_counter() - started) / probes
    let_in = sum(known for _, known in map(named, strangers))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    exact = ExactIndex(gallery.templates["probe"])
    started = time.perf_counter()
    best = [str(int(exact.search(vector, 1)[1])) for vector in again]
    by_all = (time.perf_counter() - started) / probes
    return {
        "people": people,
        "ms a probe": round(1000 * each, 2),
        "exact search, ms": round(1000 * by_all, 2),
        "recall, %": round(100 * sum(a == b for (a, _), b in zip(answers, best, strict=True)) / probes, 2),
        "strangers let in, %": round(100 * let_in / probes, 2),
        "first probe, s": round(building, 1),
        "peak memory, GB": round(memory, 2),
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--people", type=int, nargs="+", default=[1_000, 10_000, 100_000, 1_000_000])
    parser.add_argument("--probes", type=int, default=500)
    parser.add_argument("--similarity", type=float, default=0.6, help="cosine of two photographs of one person")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    rows = []
    for people in args.people:
        rows.append(measure(people, args.probes, args.similarity))
        print(rows[-1], flush=True)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
