"""What each cause of realism is worth: rendered statistics measured on real faces while one cause after another is
added.

For every row: RMSE in grey levels from a frontal and from a side-lit photograph to all other lights (yale-relight,
whole-face model), and rank-1 accuracy with all people enrolled from a frontal photograph (yale-recognize, Weber faces,
individual PCA of 9 dimensions), and what rendering an image costs, processor time of all threads.

python scripts/evaluate/ablate_bootstrap.py --data yaleb_192x168.npz --domain domain.json --csv
"""

import multiprocessing
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.domain import Domain
from facerelight.bootstrap.heads import Head, IctHeads
from facerelight.bootstrap.look.hair import BALD
from facerelight.bootstrap.look.skin import Look
from facerelight.config import TrainConfig
from facerelight.evaluation import relighting_errors
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.recognition import evaluate_galleries, training_lights
from facerelight.evaluation.results import ScriptParser, found_domain
from facerelight.geometry.lights import angle_pairs
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

PAINT = {
    "brows, eyes, lips": ("brows", "lips", "line", "sockets", "under", "iris"),
    "stubble": ("stubble",),
    "pigment, blotches and grain": ("pigment", "blotches", "grain"),
    "hair, beards and brows in volume": ("style",),
}
BARE: dict[str, Any] = {name: 0.0 for names in PAINT.values() for name in names} | {"style": BALD}
NOISE = 2 / 255  # of the sensor, standard deviation
MOTION = 0.3  # pixels by which a head moves between lights, standard deviation
STRENGTH = 0.1  # by which lamps differ from what the domain says, standard deviation of the logarithm


class World(NamedTuple):
    """A row: what is ``added``, the ``domain``, the paint that is left out (fields of a look and what they are
    instead), and whether people are ``awake``, as for a scan."""

    added: str
    domain: Domain
    bare: dict[str, Any]
    awake: bool = False


def worlds(found: Domain) -> Iterator[World]:
    """Rows, from the plainest world to the ``found`` one."""
    lamps = {"side_light": 0.0, "top_light": 0.0}
    domain = replace(
        found, tone_low=0.5, tone_high=0.5, specular=0.0, fill=0.0, pitch=0.0, turn=0.0, misalign=0.0, **lamps
    )
    bare = dict(BARE)
    yield World("flat skin, black shadows, eyes wide open", domain, dict(bare), awake=True)
    yield World("lids and mouths at ease", domain, dict(bare))
    domain = replace(domain, tone_low=found.tone_low, tone_high=found.tone_high)
    yield World("skin tones", domain, dict(bare))
    for name, parts in PAINT.items():
        for part in parts:
            del bare[part]
        yield World(name, domain, dict(bare))
    steps = {
        "fill light": ("fill",),
        "highlights of a rough surface": ("specular",),
        "heads that look up": ("pitch",),
        "heads turned a little": ("turn",),
        "landmarks a little off": ("misalign",),
        "lamps brighter at the side": ("side_light",),
        "lamps brighter above": ("top_light",),
    }
    for name, settings in steps.items():
        changed = replace(domain, **{setting: getattr(found, setting) for setting in settings})
        if changed != domain:
            domain = changed
            yield World(name, domain, {})


class BareHeads(BootstrapDataset):
    """Heads without some of their paint."""

    def __init__(self, *arguments: Any, bare: dict[str, Any]) -> None:
        super().__init__(*arguments)
        self.bare = bare

    def look(self, index: int) -> Look:
        """Person ``index``'s paint, what is left of it."""
        return replace(super().look(index), **self.bare)


class Awake(NamedTuple):
    """Scanned heads as they were scanned."""

    source: IctHeads

    def head(self, index: int) -> Head:
        """Identity ``index``, eyes wide open."""
        return self.source.awake(index)


def render(config: TrainConfig, world: World, part: int, *, parts: int) -> tuple[torch.Tensor, float]:
    """Every ``parts``-th head of a config from number ``part`` on, without some of its paint, ``(N, J, H, W)``, and
    seconds of processor time."""
    torch.set_num_threads(1)
    whole = make_dataset(replace(config, domain=world.domain))
    source = Awake(whole.source) if world.awake and isinstance(whole.source, IctHeads) else whole.source
    dataset = BareHeads(
        source,
        whole.count,
        whole.lights,
        whole.frame,
        whole.domain,
        whole.seed,
        whole.effects,
        whole.supersample,
        bare=world.bare,
    )
    _ = dataset.renderer
    started = time.process_time()
    images = dataset.images(range(part, config.heads, parts))
    return images, time.process_time() - started


def uneven(images: torch.Tensor) -> torch.Tensor:
    """Images under lamps whose strength nobody knows exactly."""
    strength = STRENGTH * torch.randn(*images.shape[:2], 1, 1, generator=torch.Generator().manual_seed(0))
    return images * strength.exp()


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
    parser.add_domain()
    parser.add_argument("--heads", type=int, default=80)
    parser.add_size(48, 42)
    parser.add_argument("--markdown", type=Path, default=None, help="the table as Markdown")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    angles = angle_pairs(faces.lights)
    found = found_domain(args.domain)
    config = TrainConfig(args.heads, lights=angles, height=args.height, width=args.width, margin=0.0)
    rows: list[dict[str, object]] = []

    def row(name: str, images: torch.Tensor, cost: float | None = None, detail: float = 0.0) -> None:
        front, side, accuracy = measure(images, faces, min(40, len(images) // 2), detail)
        figures: dict[str, object] = {"RMSE front": f"{front:.2f}", "RMSE side": f"{side:.2f}"}
        spent = "" if cost is None else f"{cost:.1f}"
        rows.append({"added": name, **figures, "rank-1": f"{accuracy:.1f}", "ms an image": spent})
        print(rows[-1], flush=True)

    with multiprocessing.get_context("spawn").Pool(2) as pool:

        def rendered(config: TrainConfig, world: World) -> tuple[torch.Tensor, float]:
            (even, spent), (odd, more) = pool.map(partial(render, config, world, parts=2), range(2))
            images = torch.cat((even, odd))
            return images, 1e3 * (spent + more) / (images.shape[0] * images.shape[1])

        for world in worlds(found):
            images, cost = rendered(config, world)
            row(world.added, images, cost)
        row("the photograph's fine detail kept", images, detail=0.5)
        row("(not kept) sensor noise, saturation", noisy(images))
        row("(not kept) motion between lights", shaken(images))
        row("(not kept) lamps that vary by 10 %", uneven(images))
        whole = World("", found, {})
        row("half as many heads", images[::2])
        row("twice as many heads", *rendered(replace(config, heads=2 * args.heads), whole))
        others, cost = rendered(replace(config, source="makehuman"), whole)
        row("MakeHuman's people instead", others, cost)
        row("both kinds of heads, half of each", torch.cat((images[::2], others[::2])))
    parser.print_rows(rows, args.markdown)
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
