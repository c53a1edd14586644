"""Measure recognition from one image a person: protocols yale-recognize and pie-recognize.

    python scripts/evaluate/recognition.py --protocol yale-recognize --data yaleb_192x168.npz --train-light side
    python scripts/evaluate/recognition.py --protocol pie-recognize --data pie10_55x44.npz --statistics real \\
        --bootstrap-data yaleb_192x168.npz --train-light random --source-light estimated

Nothing is relit, and no heads are rendered, where every classifier and baseline compares photographs alone, as
nearest_neighbor, eigenfaces, lbph and sface do. OpenCV's Fisherfaces take seconds to minutes a gallery.
"""

import argparse
import json
import sys
from itertools import chain, islice
from pathlib import Path

import torch

from facerelight.config import PACKAGED, TrainConfig
from facerelight.evaluation.datasets import load_pie, load_yale, to_grid
from facerelight.evaluation.recognition import Enrolment, Tally, evaluate_galleries, pie_as_canonical, training_lights
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.alignment import CropFrame
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.estimator import LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.photometric import NORMALIZERS
from facerelight.recognition.registry import baseline_names, needs_exemplars, table_names


def learn(
    images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor, args: argparse.Namespace
) -> StatisticalRelighter:
    options = FitOptions(face_rank=18 if args.covariance == "face" else 0, brightness=True)
    if args.registration == "affine":
        images = align_people(images, lights, valid)
    statistics = FaceStatistics.fit(images, lights, valid, options)
    estimator: LightEstimator = KernelIlluminationEstimator.fit(images, lights, valid)
    if args.estimator == "likelihood":
        estimator = LikelihoodIlluminationEstimator(statistics)
    return StatisticalRelighter(statistics, args.covariance, estimator)


def rendered(args: argparse.Namespace, names: list[str]) -> StatisticalRelighter:
    from facerelight.train.run import trained_folder

    if not any(map(needs_exemplars, names)):  # nothing will be relit
        return StatisticalRelighter.from_pretrained(PACKAGED)

    fit = FitOptions(face_rank=40, brightness=True)
    config = TrainConfig(
        heads=args.heads, source=args.source, height=args.height, width=args.width, margin=0.0, fit=fit
    )
    relighter = StatisticalRelighter.from_pretrained(trained_folder(config), args.covariance)
    if args.estimator == "likelihood":
        relighter.estimator = LikelihoodIlluminationEstimator(relighter.statistics)
    return relighter


def summary(runs: list[Tally]) -> dict[str, object]:
    """Accuracy in percent over all probes of all galleries, its spread over galleries, by subset, and seconds a
    probe."""
    right, subset = torch.cat([t.right for t in runs]).float(), torch.cat([t.subset for t in runs])
    each = torch.tensor([float(t.right.float().mean()) for t in runs])
    return {
        "accuracy": round(100 * float(right.mean()), 2),
        "std": round(100 * float(each.std(correction=0)), 2),
        "by_subset": {str(s): round(100 * float(right[subset == s].mean()), 2) for s in sorted(set(subset.tolist()))},
        "seconds_per_probe": round(sum(t.seconds for t in runs) / len(right), 6),
    }


def table(reports: list[dict]) -> list[dict[str, object]]:
    """A row a classifier; of each case its accuracy, and the spread over galleries where there are several."""
    rows: list[dict[str, object]] = []
    for name in reports[0]["results"]:
        row: dict[str, object] = {"classifier": name}
        for report in reports:
            found, case = report["results"][name], report["train_light"]
            row[case] = found["accuracy"]
            if case not in ("front", "side"):
                row[f"{case}_std"] = found["std"]
        rows.append(row)
    return rows


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--protocol", choices=["yale-recognize", "pie-recognize"], default="yale-recognize")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--bootstrap-data", type=Path, default=None, help="Extended Yale B, for pie-recognize with real statistics"
    )
    parser.add_argument(
        "--train-light",
        nargs="+",
        choices=["front", "side", "same", "random", "random-mild"],
        default=["front"],
        help="several share the work",
    )
    parser.add_argument("--source-light", choices=["labelled", "estimated"], default="labelled")
    parser.add_argument("--statistics", choices=["real", "synthetic"], default="real")
    parser.add_argument(
        "--source", default="ict", help="of rendered heads: ict, makehuman, ict_heads.npz or a folder of meshes"
    )
    parser.add_argument("--heads", type=int, default=160, help="rendered heads, with --statistics synthetic")
    parser.add_argument("--covariance", choices=["pixel", "face"], default="pixel")
    parser.add_argument(
        "--classifier",
        nargs="+",
        default=list(table_names()),
        help="names of facerelight.recognition.registry, without normalisation",
    )
    parser.add_argument(
        "--baseline", nargs="*", default=list(baseline_names()[:3]), help=f"of {', '.join(baseline_names())}"
    )
    parser.add_argument("--photometric", nargs="+", choices=list(NORMALIZERS), default=["none", "tan_triggs", "weber"])
    parser.add_argument("--exemplars", choices=["grid", "hemisphere", "dome", "cap"], default="dome")
    parser.add_argument(
        "--registration",
        choices=["affine", "none"],
        default="affine",
        help="of the people of real statistics, and of training images",
    )
    parser.add_argument(
        "--estimator", choices=["likelihood", "kernel"], default="likelihood", help="of lights that are not labelled"
    )
    parser.add_argument(
        "--shift", type=int, default=0, help="pixels by which probes may lie off, tried by every classifier"
    )
    parser.add_argument(
        "--draws", type=int, default=None, help="galleries in the random cases (default 20 for Yale, 100 for PIE)"
    )
    parser.add_size(96, 84)
    parser.add_results("csv", "json")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    names = [c if p == "none" else f"{c}+{p}" for p in args.photometric for c in args.classifier] + args.baseline
    tallies: dict[str, dict[str, list[Tally]]] = {case: {name: [] for name in names} for case in args.train_light}
    pie = args.protocol == "pie-recognize"
    draws = args.draws or (100 if pie else 20)

    frame = CropFrame(args.height, args.width)
    faces = pie_as_canonical(load_pie(args.data), frame) if pie else load_yale(args.data, args.height, args.width)
    if pie:
        if args.statistics == "real":
            if args.bootstrap_data is None:
                parser.error("--statistics real needs --bootstrap-data for pie-recognize")
            bootstrap = load_yale(args.bootstrap_data, args.height, args.width)
            relighter = learn(*(lambda grid: (grid[0], bootstrap.lights, grid[1]))(to_grid(bootstrap)), args)
        else:
            relighter = rendered(args, names)
        groups = [(list(range(len(faces.names))), relighter)]
    elif args.statistics == "synthetic":
        groups = [(list(range(len(faces.names))), rendered(args, names))]
    else:
        images, valid = to_grid(faces)
        groups = []
        for fold in range(4):
            train = [i for i in range(len(images)) if i % 4 != fold]
            groups.append(
                (
                    [i for i in range(len(images)) if i % 4 == fold],
                    learn(images[train], faces.lights, valid[train], args),
                )
            )
    enrolment = Enrolment(args.source_light == "estimated", args.exemplars, args.shift, args.registration == "affine")
    for people, relighter in groups:
        galleries = {case: list(training_lights(faces, people, case, draws)) for case in args.train_light}
        found = evaluate_galleries(faces, list(chain(*galleries.values())), relighter, names, enrolment)
        for name, runs in found.items():
            left = iter(runs)
            for case in args.train_light:
                tallies[case][name] += islice(left, len(galleries[case]))
    reports = [
        {
            "protocol": args.protocol,
            "train_light": case,
            "statistics": args.statistics,
            "covariance": args.covariance,
            "source_light": args.source_light,
            "resolution": [args.height, args.width],
            "exemplars": args.exemplars,
            "registration": args.registration,
            "estimator": args.estimator,
            "shift": args.shift,
            "results": {name: summary(runs) for name, runs in tallies[case].items()},
        }
        for case in args.train_light
    ]
    report = reports[0] if len(reports) == 1 else reports
    print(json.dumps(report, indent=2))
    parser.save_rows(args.csv, table(reports))
    parser.save_report(args.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
