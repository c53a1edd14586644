"""Mixed identity and calibration: what the whole-face model adds where the input is dark, and whether its variances are true.

python scripts/evaluate_identity.py --json identity.json [--data yaleb_192x168.npz]

Input: one image lit from 70 degrees, its light known; output: the front (error, identity) and every light (calibration). On held-out rendered
heads and, with --data, on Extended Yale B in four folds with real statistics. Identity: is the relit image nearest, among the test people's
true frontal images, to its own (L2 after removing mean and scale)?
"""

import argparse
import json
from pathlib import Path

import torch
from tqdm import tqdm

from facerelight.bootstrap.dataset import load_yale, to_grid
from facerelight.config import TrainConfig
from facerelight.lights import angular_distance, even_hemisphere, light_from_angles
from facerelight.relighter import StatisticalRelighter
from facerelight.statistics import FaceStatistics, FitOptions
from facerelight.training import make_dataset

LEVELS = {"50": 0.6745, "80": 1.2816, "95": 1.96}


def rendered(heads: int, people: int, height: int, width: int):
    """Images ``(N, J, H, W)`` of rendered heads and their lights; the first two are the source and the target."""
    lights = torch.cat((torch.stack((light_from_angles(70.0, 0.0), light_from_angles(0.0, 0.0))), even_hemisphere(62)))
    dataset = make_dataset(TrainConfig(heads=heads + people, height=height, width=width, margin=0.0, supersample=1), lights)
    images = dataset.images(tqdm(range(heads + people), desc="rendering heads"))
    return images, lights


def measure(statistics: FaceStatistics, people: torch.Tensor, valid: torch.Tensor, lights: torch.Tensor, source: int, target: int) -> dict:
    """Sums over test people, by model: squared shadow errors, identities, and how many errors lie within each interval."""
    sums: dict = {}
    gallery = people[valid[:, target], target]
    names = valid[:, target].nonzero()[:, 0].tolist()
    for model in ("pixel", "face"):
        relighter = StatisticalRelighter(statistics, model)
        total = {"shadow": [], "right": [], "inside": {name: [] for name in LEVELS}}
        for person in range(len(people)):
            if not (valid[person, source] and valid[person, target]):
                continue
            posterior = relighter.condition(people[person : person + 1, source : source + 1], lights[source : source + 1])
            made = posterior.mean(lights[target : target + 1])[0, 0]
            dark = people[person, source] < 20 / 255
            total["shadow"].append(float((made.clamp(0, 1) - people[person, target])[dark].square().mean().sqrt() * 255))
            distance = (standard(made) - standard(gallery)).square().sum((-2, -1))
            total["right"].append(names[int(distance.argmin())] == person)
            others = [j for j in valid[person].nonzero()[:, 0].tolist() if j != source][::4]
            error = (posterior.mean(lights[others])[0] - people[person, others]).abs()
            spread = posterior.variance(lights[others])[0].sqrt()
            for name, width in LEVELS.items():
                total["inside"][name].append(float((error <= width * spread + 0.5 / 255).float().mean()))
        sums[model] = total
    return sums


def standard(image: torch.Tensor) -> torch.Tensor:
    return (image - image.mean((-2, -1), keepdim=True)) / image.std((-2, -1), keepdim=True)


def summary(parts: list[dict]) -> dict:
    report: dict = {}
    for model in ("pixel", "face"):

        def mean(pick, model=model) -> float:
            values = [value for part in parts for value in pick(part[model])]
            return round(sum(values) / len(values), 4)

        report[model] = {
            "shadow_rmse": mean(lambda m: m["shadow"]),
            "rank_1": mean(lambda m: m["right"]),
            "coverage": {name: mean(lambda m, name=name: m["inside"][name]) for name in LEVELS},
        }
    report["shadow_rmse_saved"] = round(1 - report["face"]["shadow_rmse"] / report["pixel"]["shadow_rmse"], 4)
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=None, help="yaleb_192x168.npz or a CroppedYale folder")
    parser.add_argument("--heads", type=int, default=100)
    parser.add_argument("--people", type=int, default=20, help="held-out rendered heads")
    parser.add_argument("--height", type=int, default=96)
    parser.add_argument("--width", type=int, default=84)
    parser.add_argument("--exposure", choices=["unit", "estimated"], default="estimated", help="the input's gain: 1, or an unknown")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    unknown_gain = args.exposure == "estimated"
    images, lights = rendered(args.heads, args.people, args.height, args.width)
    learned = FaceStatistics.fit(images[: args.heads], lights, None, FitOptions(face_rank=40, brightness=unknown_gain))
    strangers = images[args.heads :]
    everything = torch.ones(strangers.shape[:2], dtype=torch.bool)
    results = {"rendered": summary([measure(learned, strangers, everything, lights, 0, 1)])}
    if args.data:
        faces = load_yale(args.data, args.height, args.width)
        images, valid = to_grid(faces)
        source, target = (
            int(angular_distance(faces.lights, light_from_angles(*a).expand_as(faces.lights)).argmin()) for a in ((70.0, 0.0), (0.0, 0.0))
        )
        parts = []
        for fold in range(4):
            out = torch.arange(len(images)) % 4 == fold
            learned = FaceStatistics.fit(images[~out], faces.lights, valid[~out], FitOptions(face_rank=18, brightness=unknown_gain))
            parts.append(measure(learned, images[out], valid[out], faces.lights, source, target))
        results["yale"] = summary(parts)
    print(json.dumps(results, indent=2))
    if args.json:
        args.json.write_text(json.dumps(results, indent=2))


if __name__ == "__main__":
    main()
