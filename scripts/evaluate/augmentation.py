"""What RandomFaceRelight is worth beside kornia's augmentations: a small network trained under few lights, tested under
the others.

python scripts/evaluate/augmentation.py --data yaleb_192x168.npz --csv
"""

import statistics

import torch

from facerelight.augment.quick import QuickRelighter
from facerelight.evaluation.augmentation.gain import AUGMENTATIONS, OURS, TASKS, accuracies, augmentation
from facerelight.evaluation.augmentation.people import rendered_people
from facerelight.evaluation.datasets import load_yale
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.photo.face_model import load_relighter


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_size(64, 56)
    parser.add_argument("--people", type=int, default=60, help="rendered ones")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=200, help="of training")
    parser.add_argument("--copies", type=int, default=16, help="that are made of every picture")
    parser.add_argument("--faces", nargs="+", default=["yale", "rendered"], choices=("yale", "rendered"))
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_num_threads(1)
    yale = load_yale(args.data, args.height, args.width)
    sets = {"yale": lambda: yale, "rendered": lambda: rendered_people(yale, args.people, args.height, args.width)}
    relighter = QuickRelighter(load_relighter())
    rows: list[dict[str, object]] = []
    for kind in args.faces:
        faces = sets[kind]()
        for task in args.tasks:
            for name in (*AUGMENTATIONS, OURS):
                apply = augmentation(name, relighter)
                runs = [accuracies(faces, task, apply, seed, args.steps, args.copies) for seed in range(args.seeds)]
                row: dict[str, object] = {"faces": kind, "task": task, "augmentation": name}
                for what in runs[0]:
                    row[what] = round(statistics.mean(run[what] for run in runs), 1)
                    if what == "all":
                        row["spread"] = round(statistics.stdev(run[what] for run in runs), 1) if args.seeds > 1 else ""
                rows.append(row)
                print(row, flush=True)
                parser.save_rows(args.csv, rows)
    print(markdown(rows))


if __name__ == "__main__":
    main()
