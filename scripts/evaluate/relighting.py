"""Measure relighting on Extended Yale B: protocols yale-relight and yale-relight-newlights.

python scripts/evaluate/relighting.py --data yaleb_192x168.npz --statistics real --covariance pixel --json out.json
"""

import argparse
import json
import sys
import time
from pathlib import Path

import torch

from facerelight.bootstrap.domain import Domain
from facerelight.config import TrainConfig
from facerelight.evaluation import evaluate_folds
from facerelight.evaluation.datasets import load_yale
from facerelight.evaluation.results import ScriptParser, found_domains
from facerelight.geometry.lights import angle_pairs
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.train.adapt import Person, adapt


def rendered_config(args: argparse.Namespace, lights: torch.Tensor, domain: Domain, options: FitOptions) -> TrainConfig:
    """Heads at the canonical crop under the very lights of the data, ``lights (J, 3)``."""
    angles = angle_pairs(lights)
    return TrainConfig(args.heads, args.source, angles, args.height, args.width, margin=0.0, domain=domain, fit=options)


def read_domains(path: Path | None, folds: int) -> list[Domain]:
    """The rendered world of each fold, as ``search_domain.py`` found it on other people than that fold's (every second
    of them, or more); without a file the package's own."""
    if path is None:
        return [Domain()] * folds
    found = found_domains(path)
    if folds % len(found):
        raise SystemExit(f"{path}: expected domains of {folds} folds or a divisor of it, got {len(found)}")
    return found * (folds // len(found))


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--protocol", choices=["yale-relight", "yale-relight-newlights"], default="yale-relight")
    parser.add_argument("--statistics", choices=["real", "synthetic", "adapted"], default="real")
    parser.add_argument("--covariance", choices=["pixel", "face"], default="pixel")
    parser.add_argument("--source-light", choices=["labelled", "estimated"], default="labelled")
    parser.add_argument("--folds", type=int, default=4)
    parser.add_size(96, 84)
    parser.add_argument("--rank", type=int, default=12, help="of the correlation factor")
    parser.add_argument("--face-rank", type=int, default=18)
    parser.add_argument("--temper", type=float, default=100.0)
    parser.add_argument("--kernel-width", type=float, default=None, help="in light spacings; default: cross-validation")
    parser.add_argument(
        "--exposure", choices=["unit", "estimated"], default="estimated", help="the input's gain: 1, or an unknown"
    )
    parser.add_argument(
        "--registration",
        choices=["affine", "none"],
        default=None,
        help="of people and inputs; default: affine, none with synthetic statistics",
    )
    parser.add_argument(
        "--detail",
        type=float,
        default=0.5,
        help="how much of the input's fine detail relit images keep; 0: the bare model",
    )
    parser.add_domain()
    parser.add_argument(
        "--adapt-people", type=int, default=21, help="of each fold's training people, with --statistics adapted"
    )
    parser.add_argument("--source", default="ict", help="of the rendered heads: ict, makehuman, or a path")
    parser.add_argument("--heads", type=int, default=160, help="rendered heads, with --statistics synthetic")
    parser.add_results("json")
    args = parser.parse_args()

    torch.set_grad_enabled(False)
    started = time.perf_counter()
    faces = load_yale(args.data, args.height, args.width)
    face_rank = args.face_rank if args.covariance == "face" else 0
    options = FitOptions(
        rank=args.rank,
        face_rank=face_rank,
        temper=args.temper,
        kernel_width=args.kernel_width,
        brightness=args.exposure == "estimated",
    )
    widths: list[float] = []

    domains = iter(read_domains(args.domain, args.folds))

    register = (args.registration or ("none" if args.statistics == "synthetic" else "affine")) == "affine"

    def make(images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor) -> FaceStatistics:
        if register and args.statistics != "synthetic":
            images = align_people(images, lights, valid)
        if args.statistics == "real":
            statistics = FaceStatistics.fit(images, lights, valid, options)
        else:
            from facerelight.train.run import rendered_statistics, trained_folder

            config = rendered_config(args, lights, next(domains), options)
            if args.statistics == "synthetic":
                statistics = FaceStatistics.load(trained_folder(config) / "statistics.safetensors")
            else:
                people = [
                    Person(person[there], lights[there], torch.ones(person.shape[1:]))
                    for person, there in zip(images[: args.adapt_people], valid, strict=False)
                ]
                statistics = adapt(rendered_statistics(config), people)
        widths.append(float(statistics.describe()["kernel_width"]))
        return statistics

    models = ["pixel", "face"] if args.covariance == "face" else ["pixel"]
    new_lights, estimated = args.protocol.endswith("newlights"), args.source_light == "estimated"
    scores, light_error = evaluate_folds(faces, args.folds, make, models, new_lights, estimated, register, args.detail)
    report = {
        "protocol": args.protocol,
        "covariance": args.covariance,
        "statistics": args.statistics,
        "adapted_to": args.adapt_people if args.statistics == "adapted" else 0,
        "source_light": args.source_light,
        "exposure": args.exposure,
        "registration": "affine" if register else "none",
        "detail": args.detail,
        "resolution": [args.height, args.width],
        "folds": args.folds,
        "kernel_width_deg": round(sum(widths) / len(widths), 2),
        "results": {case: by[args.covariance].summary() for case, by in scores.items()},
        "baselines": {
            name: {case: by[name].summary() for case, by in scores.items()}
            for name in ("copy", "mean_face", "ratio_image")
        },
        "light_estimator": light_error,
        "seconds": round(time.perf_counter() - started, 1),
    }
    if args.covariance == "face":
        report["pixel"] = {case: by["pixel"].summary() for case, by in scores.items()}
    print(json.dumps(report, indent=2))
    parser.save_report(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
