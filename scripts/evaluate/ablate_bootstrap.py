"""What each cause of realism is worth: rendered statistics measured on real faces while one cause after another is
added.

For every row: RMSE in grey levels from a frontal and from a side-lit photograph to all other lights (yale-relight,
whole-face model), and rank-1 accuracy with all people enrolled from a frontal photograph (yale-recognize, Weber faces,
individual PCA of 9 dimensions).

python scripts/evaluate/ablate_bootstrap.py --data yaleb_192x168.npz --markdown ablation.md
"""

import multiprocessing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.look.hair import BALD
from facerelight.bootstrap.look.skin import Look
from facerelight.config import TrainConfig
from facerelight.evaluation import relighting_errors
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.recognition import evaluate_galleries, training_lights
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import angle_pairs
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

PAINT = {
    "brows, eyes, lips": ("brows", "lips", "sockets", "iris"),
    "stubble and hair": ("stubble", "style"),
    "pigment and grain": ("pigment", "grain"),
}
BARE: dict[str, Any] = {name: 0.0 for names in PAINT.values() for name in names} | {"style": BALD}
NOISE = 2 / 255  # of the sensor, standard deviation
MOTION = 0.3  # pixels by which a head moves between lights, standard deviation


def worlds(found: Domain) -> list[tuple[str, Domain, dict[str, Any]]]:
    """Rows: what is added, the domain, and the paint that is still left out."""
    plain = replace(
        found, tone_low=0.5, tone_high=0.5, specular=0.0, fill=0.0, side_light=0.0, pitch=0.0, turn=0.0, misalign=0.0
    )
    rows, bare = [("flat skin, black shadows", plain, dict(BARE))], dict(BARE)

    def add(name: str, **settings: float) -> None:
        rows.append((name, replace(rows[-1][1], **settings), dict(bare)))

    add("skin tones", tone_low=found.tone_low, tone_high=found.tone_high)
    for name, parts in PAINT.items():
        for part in parts:
            del bare[part]
        add(name)
    add("fill light", fill=found.fill)
    add("highlights of a rough surface", specular=found.specular)
    add("heads that look up", pitch=found.pitch)
    add("heads turned a little", turn=found.turn)
    add("landmarks a little off", misalign=found.misalign)
    add("lamps brighter at the side", side_light=found.side_light)
    return rows


class BareHeads(BootstrapDataset):
    """Heads without some of their paint."""

    def __init__(self, *arguments: Any, bare: dict[str, Any]) -> None:
        super().__init__(*arguments)
        self.bare = bare

    def look(self, index: int) -> Look:
        """Person ``index``'s paint, what is left of it."""
        return replace(super().look(index), **self.bare)


def render(config: TrainConfig, bare: dict[str, Any], part: int, *, parts: int) -> torch.Tensor:
    """Every ``parts``-th head of a config from number ``part`` on, without some of its paint, ``(N, J, H, W)``."""
    torch.set_num_threads(1)
    whole = make_dataset(config)
    dataset = BareHeads(
        whole.source,
        whole.count,
        whole.lights,
        whole.frame,
        whole.domain,
        whole.seed,
        whole.effects,
        whole.supersample,
        bare=bare,
    )
    return dataset.images(range(part, config.heads, parts))


def shaken(images: torch.Tensor) -> torch.Tensor:
    """Images of heads that move a little between lights."""
    count, lights, height, width = images.shape
    generator = torch.Generator().manual_seed(0)
    shift = MOTION * torch.randn(count * lights, 2, generator=generator) * torch.tensor((2 / width, 2 / height))
    matrix = torch.cat((torch.eye(2).expand(len(shift), 2, 2), shift[..., None]), -1)
    grid = torch.nn.functional.affine_grid(matrix, [len(shift), 1, height, width], align_corners=False)
    moved = torch.nn.functional.grid_sample(
        images.flatten(0, 1)[:, None], grid, padding_mode="border", align_corners=False
    )
    return moved[:, 0].view_as(images)


def noisy(images: torch.Tensor) -> torch.Tensor:
    """Images of a sensor with noise that saturates at 1."""
    return (images + NOISE * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))).clamp(0, 1)


def measure(images: torch.Tensor, faces: FaceImages, rank: int, detail: float) -> tuple[float, float, float]:
    """RMSE front, RMSE side, rank-1 accuracy in percent."""
    statistics = FaceStatistics.fit(images, faces.lights, None, face_rank=rank, brightness=True)
    front, side = (float(relighting_errors(statistics, faces, case, detail).nanmean()) for case in ("front", "side"))
    gallery = next(training_lights(faces, list(range(len(faces.names))), "front", 1))
    relighter = StatisticalRelighter(statistics, "face")
    name = "individual_pca_9+detail+cosine+weber" if detail else "individual_pca_9+weber"
    right = evaluate_galleries(faces, [gallery], relighter, [name])[name][0].right
    return front, side, 100 * float(right.float().mean())


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--ict", type=Path, default=None, help="ict_heads.npz, for the rows with scanned heads")
    parser.add_argument("--heads", type=int, default=80)
    parser.add_size(48, 42)
    parser.add_argument("--markdown", type=Path, default=None, help="the table as Markdown")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    angles = angle_pairs(faces.lights)
    config = TrainConfig(args.heads, lights=angles, height=args.height, width=args.width, margin=0.0)
    rows: list[dict[str, object]] = []

    def row(name: str, images: torch.Tensor, detail: float = 0.0) -> None:
        front, side, accuracy = measure(images, faces, min(40, len(images) // 2), detail)
        figures: dict[str, object] = {"RMSE front": round(front, 2), "RMSE side": round(side, 2)}
        rows.append({"added": name, **figures, "rank-1": round(accuracy, 1)})
        print(rows[-1], flush=True)

    with multiprocessing.get_context("spawn").Pool(2) as pool:

        def rendered(config: TrainConfig, bare: dict[str, Any]) -> torch.Tensor:
            return torch.cat(pool.map(partial(render, config, bare, parts=2), range(2)))

        for name, domain, bare in worlds(Domain()):
            images = rendered(replace(config, domain=domain), bare)
            row(name, images)
        row("the photograph's fine detail kept", images, 0.5)
        row("(not kept) sensor noise, saturation", noisy(images))
        row("(not kept) motion between lights", shaken(images))
        row("half as many heads", images[::2])
        row("twice as many heads", rendered(replace(config, heads=2 * args.heads), {}))
        if args.ict:
            upright = replace(Domain(), pitch=0.0)  # the scans hold their heads as people do
            scans = rendered(replace(config, source=str(args.ict), domain=upright), {})
            row("scanned heads instead (ICT-FaceKit)", scans)
            row("both kinds of heads, half of each", torch.cat((images[::2], scans[::2])))
    parser.print_rows(rows, args.markdown)
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
