"""Where a photo's light comes from: kernel regression, the model's own likelihood, and amounts of many lights.

python scripts/evaluate/light.py --data yaleb_192x168.npz --pie pie10_55x44.npz --json light.json

Angle between estimate and label, in degrees, and how many percent of the labels lie inside the circle about the
estimate that holds 90 % of the estimator's samples. Yale: four folds, statistics of the other 21 people. PIE:
statistics of Yale, labels are the data's own estimates. Heads: 20 held-out rendered heads under 64 lights, statistics
of 100 others. The likelihood's temper is left at its default. An estimate of amounts is judged by its middle.
"""

import json
import time
from pathlib import Path

import torch
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import load_pie, load_yale, to_grid
from facerelight.evaluation.recognition import pie_as_canonical
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import angular_distance
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.estimator import LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

DRAWS = 64


class Errors:
    """Angles, coverage and time of each estimator, over everything added."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.angle: dict[str, list[torch.Tensor]] = {}
        self.inside: dict[str, list[torch.Tensor]] = {}
        self.seconds: dict[str, float] = {}

    def add(self, name: str, estimator: LightEstimator, images: torch.Tensor, truth: torch.Tensor) -> None:
        """``images (M, H, W)`` with lights ``truth (M, 3)``."""
        images, truth = images[:: self.every], truth[:: self.every]
        started = time.perf_counter()
        found = estimator(images[:, None]).direction[:, 0]
        self.seconds[name] = (time.perf_counter() - started) / len(images)
        drawn = estimator.sample(images[:, None], DRAWS)[:, :, 0]
        angle = angular_distance(found, truth)
        radius = angular_distance(drawn, found[:, None].expand_as(drawn)).quantile(0.9, dim=1)
        self.angle.setdefault(name, []).append(angle)
        self.inside.setdefault(name, []).append((angle <= radius).float())

    def report(self) -> dict[str, dict[str, float]]:
        return {
            name: {
                "median_deg": round(float(torch.cat(angles).median()), 2),
                "mean_deg": round(float(torch.cat(angles).mean()), 2),
                "inside_90_percent": round(100 * float(torch.cat(self.inside[name]).mean()), 1),
                "milliseconds": round(1e3 * self.seconds[name], 1),
            }
            for name, angles in self.angle.items()
        }


def estimators(
    images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor | None, face_rank: int
) -> dict[str, LightEstimator]:
    """All three, learned from the same people; photographs brought into step for the likelihood."""
    aligned = images if valid is None else align_people(images, lights, valid)
    statistics = FaceStatistics.fit(aligned, lights, valid, FitOptions(face_rank=face_rank, brightness=True))
    return {
        "kernel": KernelIlluminationEstimator.fit(images, lights, valid),
        "likelihood": LikelihoodIlluminationEstimator(statistics),
        "amounts": SoftLightEstimator(statistics),
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--pie", type=Path, default=None)
    parser.add_size(96, 84)
    parser.add_argument("--every", type=int, default=1, help="take one photo in so many")
    parser.add_results("json")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    results = {}

    config = TrainConfig(heads=120, height=args.height, width=args.width, margin=0.0, supersample=1)
    heads, lights, errors = (
        make_dataset(config).images(tqdm(range(120), desc="rendering heads")),
        config.directions(),
        Errors(args.every),
    )
    for name, estimator in estimators(heads[:100], lights, None, 40).items():
        errors.add(name, estimator, heads[100:].flatten(0, 1), lights.repeat(20, 1))
    results["heads"] = errors.report()

    faces = load_yale(args.data, args.height, args.width)
    images, valid = to_grid(faces)
    errors = Errors(args.every)
    for fold in range(4):
        out = torch.arange(len(images)) % 4 == fold
        truth = faces.lights.expand(int(out.sum()), -1, -1)[valid[out]]
        for name, estimator in estimators(images[~out], faces.lights, valid[~out], 18).items():
            errors.add(name, estimator, images[out][valid[out]], truth)
    results["yale"] = errors.report()

    if args.pie:
        pie, errors = pie_as_canonical(load_pie(args.pie), CropFrame(args.height, args.width)), Errors(args.every)
        for name, estimator in estimators(images, faces.lights, valid, 18).items():
            errors.add(name, estimator, pie.images, pie.lights[pie.light])
        results["pie"] = errors.report()
    print(json.dumps(results, indent=2))
    parser.save_report(args.json, results)


if __name__ == "__main__":
    main()
