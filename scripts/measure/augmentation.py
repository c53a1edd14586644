"""What RandomFaceRelight costs beside kornia's augmentations, how far its fast path is from the exact one, and what
several people at once save.

python scripts/measure/augmentation.py --data yaleb_192x168.npz --csv
"""

import kornia.augmentation as kornia
import torch

from facerelight.augment.exact import ExactRelighter
from facerelight.augment.quick import QuickRelighter
from facerelight.augment.random_face_relight import RandomFaceRelight
from facerelight.evaluation.augmentation.error import batch_seconds, relit_apart
from facerelight.evaluation.augmentation.people import rendered_people
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.people import PeoplePosterior
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo.face_model import load_relighter

FAST = ((4, 64), (2, 64), (2, 128))
DEFAULT = (2, 128)
EVERY_FRONT = 0.4  # sine of the elevation above the image plane: lights of the core's batch


def some(faces: FaceImages, count: int) -> torch.Tensor:
    """``count`` images of random people and lights, ``(count, 1, H, W)``."""
    chosen = torch.randperm(len(faces.images), generator=torch.Generator().manual_seed(0))[:count]
    return faces.images[chosen][:, None]


def core_rows(relighter: StatisticalRelighter, people: int, rounds: int) -> list[dict[str, object]]:
    """Conditioning and one light each: a loop over people beside all at once."""
    generator = torch.Generator().manual_seed(0)
    statistics = relighter.statistics
    lights = even_hemisphere(3 * people)
    lights = lights[lights[:, 2] > EVERY_FRONT][torch.randperm(people, generator=generator)]
    images = statistics.mean_images().mean(0) + 0.05 * torch.rand(people, 1, *statistics.size, generator=generator)
    targets = lights.roll(1, 0)[:, None]
    together = relighter.condition(images, lights[:, None])
    assert isinstance(together, PeoplePosterior)

    def loop() -> torch.Tensor:
        return together.separately().mean(targets)

    calls = {"a loop": loop, "at once": lambda: relighter.condition(images, lights[:, None]).mean(targets)}
    seconds = batch_seconds(calls, rounds)
    apart = float((calls["a loop"]() - calls["at once"]()).abs().max())
    return [
        {
            "what": f"condition and one light, {people} people, {name}",
            "ms a face": round(1e3 * seconds[name] / people, 1),
            "times as fast": round(seconds["a loop"] / seconds[name], 1),
            "largest difference": f"{apart:.0e}",
        }
        for name in calls
    ]


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--batch", type=int, default=64)
    parser.add_argument("--side", type=int, default=112)
    parser.add_argument("--images", type=int, default=40, help="on which errors are measured")
    parser.add_argument("--heads", type=int, default=4, help="rendered people")
    parser.add_argument("--people", type=int, default=24, help="conditioned at once")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    relighter = load_relighter()
    yale = load_yale(args.data, 128, 112)
    faces = {
        "Yale B": some(yale, args.images),
        "rendered": some(rendered_people(yale, args.heads, 128, 112), args.images),
    }
    exact = ExactRelighter(relighter)
    crops = torch.nn.functional.interpolate(faces["Yale B"], (args.side, args.side)).expand(-1, 3, -1, -1)
    crops = crops.repeat(-(-args.batch // len(crops)), 1, 1, 1)[: args.batch] ** (1 / 2.2)
    fast = {f"RandomFaceRelight, block {block}, {cells} cells": (block, cells) for block, cells in FAST}
    augmentations: dict[str, torch.nn.Module] = {
        "RandomPlasmaShadow": kornia.RandomPlasmaShadow(p=1.0),
        "ColorJitter": kornia.ColorJitter(0.5, 0.5, 0.5, 0.1, p=1.0),
        "RandomLinearIllumination": kornia.RandomLinearIllumination(p=1.0),
    }
    models = {name: QuickRelighter(relighter, *setting) for name, setting in fast.items()}
    augmentations |= {name: RandomFaceRelight("yale", relighter=model, p=1.0) for name, model in models.items()}
    seconds = batch_seconds({name: lambda a=a: a(crops) for name, a in augmentations.items()}, args.rounds)
    apart = {kind: relit_apart(images, models, exact) for kind, images in faces.items()}
    rows: list[dict[str, object]] = []
    for name in augmentations:
        row: dict[str, object] = {
            "what": name + (", the default" if fast.get(name) == DEFAULT else ""),
            "ms a face": round(1e3 * seconds[name] / args.batch, 2),
            "times RandomPlasmaShadow": round(seconds[name] / seconds["RandomPlasmaShadow"], 2),
        }
        if name in models:
            row["MB"] = round(sum(b.numel() * b.element_size() for b in models[name].buffers()) / 1e6)
            for kind in faces:
                row[f"RMS {kind}"] = round(float(apart[kind][name].square().mean().sqrt()), 2)
        rows.append(row)
        print(row, flush=True)
    rows += core_rows(relighter, args.people, args.rounds)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
