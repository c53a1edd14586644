"""Measure relighting of photographs that many lights made: protocol yale-soft.

python scripts/evaluate/soft_light.py --data yaleb_192x168.npz --source-light estimated --json out.json

The inputs are sums of a person's photographs under single lights; the targets are all of those. ``results`` is the
exact posterior under the whole light, ``rows`` what else one could do, ``from_front`` the same five lights as targets.
"""

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


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--source-light", choices=["labelled", "estimated"], default="labelled")
    parser.add_argument("--folds", type=int, default=4)
    parser.add_size(96, 84)
    parser.add_argument("--rank", type=int, default=12, help="of the correlation factor")
    parser.add_argument("--face-rank", type=int, default=18)
    parser.add_argument(
        "--registration", choices=["affine", "none"], default="affine", help="of inputs; people always are"
    )
    parser.add_argument("--draws", type=int, default=16, help="of an estimated light")
    parser.add_results("json", "csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    started = time.perf_counter()
    options = FitOptions(rank=args.rank, face_rank=args.face_rank, brightness=True)

    def make(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        return FaceStatistics.fit(align_people(images, lights, valid), lights, valid, options)

    estimated, register = args.source_light == "estimated", args.registration == "affine"
    faces = load_yale(args.data, args.height, args.width)
    scores = evaluate_soft_light(faces, args.folds, make, estimated, register, args.draws)
    found = {row: {light: score.summary() for light, score in by.items()} for row, by in scores.items()}
    setting = {"source_light": args.source_light, "registration": args.registration}
    report = {
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
    print(json.dumps(report, indent=2))
    parser.save_report(args.json, report)
    rows = [
        {**setting, "row": row, "light": light, **score} for row, by in found.items() for light, score in by.items()
    ]
    parser.save_rows(args.csv, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
