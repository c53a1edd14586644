"""Measure relighting of photographs that many lights made: protocol yale-soft.

python scripts/evaluate/soft_light.py --data yaleb_192x168.npz --source-light estimated --json out.json

The inputs are sums of a person's photographs under single lights; the targets are all of those. ``results`` is the
exact posterior under the whole light, ``rows`` what else one could do, ``from_front`` the same five lights as targets.
Several kinds of source light or registration make a list of reports, and one table.
"""

import itertools
import json
import sys
import time

import torch

from facerelight.evaluation.datasets import load_yale
from facerelight.evaluation.results import ScriptParser
from facerelight.evaluation.soft_light import evaluate_soft_light
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics


def wide(by_light: dict[str, dict[str, float]]) -> dict[str, float]:
    """Cells of one row: errors under each light, and how many percent of the pixels lie within the intervals."""
    within = {f"{light}_within_95": score["coverage95"] for light, score in by_light.items() if "coverage95" in score}
    return {light: score["rmse"] for light, score in by_light.items()} | within


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--source-light", choices=["labelled", "estimated"], nargs="+", default=["labelled"])
    parser.add_argument("--folds", type=int, default=4)
    parser.add_size(96, 84)
    parser.add_argument("--rank", type=int, default=12, help="of the correlation factor")
    parser.add_argument("--face-rank", type=int, default=18)
    registration = ["affine", "none"]
    parser.add_argument(
        "--registration", choices=registration, nargs="+", default=["affine"], help="of inputs; people always are"
    )
    parser.add_argument("--draws", type=int, default=16, help="of an estimated light")
    parser.add_results("json", "csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    options = FitOptions(rank=args.rank, face_rank=args.face_rank, brightness=True)

    def make(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        return FaceStatistics.fit(align_people(images, lights, valid), lights, valid, options)

    faces = load_yale(args.data, args.height, args.width)
    reports, rows = [], []
    for light, registered in itertools.product(args.source_light, args.registration):
        started = time.perf_counter()
        scores = evaluate_soft_light(faces, args.folds, make, light == "estimated", registered == "affine", args.draws)
        found = {row: {name: score.summary() for name, score in by.items()} for row, by in scores.items()}
        setting = {"source_light": light, "registration": registered}
        reports.append(
            {
                "protocol": "yale-soft",
                "statistics": "real",
                "covariance": "face",
                **setting,
                "resolution": [args.height, args.width],
                "results": found["exact"],
                "rows": {row: by for row, by in found.items() if row not in ("exact", "from_front")},
                "from_front": found["from_front"],
                "seconds": round(time.perf_counter() - started, 1),
            }
        )
        rows += [setting | {"row": row} | wide(by) for row, by in found.items()]
    report = reports[0] if len(reports) == 1 else reports
    print(json.dumps(report, indent=2))
    parser.save_report(args.json, report)
    parser.save_rows(args.csv, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
