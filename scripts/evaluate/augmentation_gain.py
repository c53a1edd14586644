"""What RandomFaceRelight is worth beside kornia's augmentations: a small network trained under few lights, tested under
the others.

python scripts/evaluate/augmentation_gain.py --data yaleb_192x168.npz --csv
"""

import json
import statistics
from itertools import product
from pathlib import Path

import torch

from facerelight.augment.quick import QuickRelighter
from facerelight.evaluation.augmentation.gain import AUGMENTATIONS, OURS, TASKS, accuracies, augmentation
from facerelight.evaluation.augmentation.people import rendered_people
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.photo.face_model import load_relighter


class Runs:
    """Accuracies of single runs, in a file if one is named: a script that was interrupted goes on."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.done: dict[str, dict[str, float]] = {}
        if path is not None and path.exists():
            self.done = dict(json.loads(line) for line in path.read_text().splitlines())

    def add(self, key: str, found: dict[str, float]) -> None:
        self.done[key] = found
        if self.path is not None:
            with self.path.open("a") as file:
                file.write(json.dumps([key, found]) + "\n")


def row_of(kind: str, task: str, name: str, runs: list[dict[str, float]]) -> dict[str, object]:
    """Means over seeds, and the standard deviation of the accuracy over all lights."""
    row: dict[str, object] = {"faces": kind, "task": task, "augmentation": name, "seeds": len(runs)}
    for what in runs[0]:
        row[what] = round(statistics.mean(run[what] for run in runs), 1)
        if what == "all":
            row["spread"] = round(statistics.stdev(run[what] for run in runs), 1) if len(runs) > 1 else ""
    return row


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_size(64, 56)
    parser.add_argument("--people", type=int, default=28, help="rendered ones")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=120, help="of training")
    parser.add_argument("--copies", type=int, default=10, help="that are made of every picture")
    parser.add_argument("--faces", nargs="+", default=["yale", "rendered"], choices=("yale", "rendered"))
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    every = [*AUGMENTATIONS, OURS]
    parser.add_argument("--augmentations", nargs="+", default=every, choices=every)
    parser.add_argument("--runs", type=Path, default=None, help="file of runs that are done, and not done again")
    parser.add_argument("--at-most", type=int, default=None, help="runs; the rest is left for another call")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_num_threads(1)
    yale = load_yale(args.data, args.height, args.width)
    sets: dict[str, FaceImages] = {"yale": yale}
    runs, left = Runs(args.runs), args.at_most
    relighter: QuickRelighter | None = None
    rows: list[dict[str, object]] = []
    for kind, task, name in product(args.faces, args.tasks, args.augmentations):
        keys = {seed: json.dumps([kind, task, name, seed, args.steps, args.copies]) for seed in range(args.seeds)}
        for seed, key in keys.items():
            if key in runs.done or left == 0:
                continue
            left = None if left is None else left - 1
            relighter = relighter or QuickRelighter(load_relighter())
            if kind not in sets:
                sets[kind] = rendered_people(yale, args.people, args.height, args.width)
            apply = augmentation(name, relighter)
            runs.add(key, accuracies(sets[kind], task, apply, seed, args.steps, args.copies))
        done = [runs.done[key] for key in keys.values() if key in runs.done]
        if done:
            rows.append(row_of(kind, task, name, done))
            print(rows[-1], flush=True)
            parser.save_rows(args.csv, rows)
    print(markdown(rows))


if __name__ == "__main__":
    main()
