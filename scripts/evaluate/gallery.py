"""`facerelight recognize` end to end: a gallery of one photograph a person, each under another light, lights estimated,
landmarks as given.

Extended Yale B as a person would photograph it: sRGB, in a larger picture. Everybody is enrolled from one of five mild
lights; probes are six other lights, up to 70 degrees to the side. Landmarks are found by the package, or are the crop's
own with Gaussian noise.

python scripts/evaluate/gallery.py --data yaleb_192x168.npz
"""

import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.datasets import FaceImages, load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.alignment import CANONICAL_LANDMARKS
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter
from facerelight.recognition.gallery import Gallery
from facerelight.train.run import trained_folder

BORDER = 60  # pixels around the crop of 192 x 168
ENROLLED = ((0, 0), (-35, 15), (60, 20), (0, 45), (-25, 0))
PROBES = ((10, 0), (35, 15), (-50, 0), (-20, -40), (50, -40), (70, 0))


def as_photo(radiance: torch.Tensor) -> np.ndarray:
    """Linear ``(H, W)`` to sRGB ``(H', W', 3)`` uint8 with a border of repeated pixels."""
    coded = linear_rgb_to_rgb(radiance.clamp(0, 1).expand(3, -1, -1)).permute(1, 2, 0)
    return np.pad((coded * 255).round().byte().numpy(), ((BORDER, BORDER), (BORDER, BORDER), (0, 0)), mode="edge")


def rank_one(
    faces: FaceImages, relighter: StatisticalRelighter, photometric: str, noise: float | None
) -> tuple[float, int, int]:
    """Rank-1 accuracy in percent, probes, and photographs in which no face was found."""
    images, valid = to_grid(faces)
    generator = np.random.default_rng(0)
    true = np.array(CANONICAL_LANDMARKS) + BORDER
    missed = 0

    def opened(person: int, angles: tuple[int, int]) -> PhotoRelighter | None:
        nonlocal missed
        light = int((faces.angles - torch.tensor(angles)).abs().sum(1).argmin())
        if not valid[person, light]:
            return None
        marked = None if noise is None else true + noise * generator.standard_normal((3, 2))
        try:
            return PhotoRelighter(as_photo(images[person, light]), marked, relighter)
        except RuntimeError:
            missed += 1
            return None

    gallery = Gallery(relighter, photometric)
    people = range(len(faces.names))
    enrolled = {person: opened(person, ENROLLED[person % len(ENROLLED)]) for person in people}
    for person, photo in enrolled.items():
        if photo is not None:
            gallery.add(str(person), [photo])
    probes = [(person, opened(person, angles)) for person in people if enrolled[person] for angles in PROBES]
    right = [gallery.compare(photo).name == str(person) for person, photo in probes if photo is not None]
    return 100 * sum(right) / len(right), len(right), missed


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--photometric", nargs="+", default=["weber_fine", "weber"])
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, 192, 168)
    relighter = StatisticalRelighter.from_pretrained(trained_folder(DEFAULT_CONFIG))
    rows: list[dict[str, object]] = []
    for name, noise in (("exact", 0.0), ("2 pixels off", 2.0), ("found", None)):
        for photometric in args.photometric:
            accuracy, probes, missed = rank_one(faces, relighter, photometric, noise)
            row: dict[str, object] = {"landmarks": name, "normalisation": photometric, "rank-1": round(accuracy)}
            rows.append(row | {"probes": probes, "no face found": missed})
            print(rows[-1], flush=True)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
