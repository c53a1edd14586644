"""Mixed identity and calibration: what the whole-face model adds where the input is dark, and whether its variances are
true.

python scripts/evaluate/identity.py --json identity.json [--data yaleb_192x168.npz] [--plot reliability.png]

Input: one image lit from 70 degrees, its light known; output: the front (error, identity) and every light
(calibration). On held-out rendered heads and, with --data, on Extended Yale B in four folds with real statistics.
Identity: is the relit image nearest, among the test people's true frontal images, to its own (L2 after removing mean
and scale)? The plot is a reliability diagram: pixels sorted by predicted standard deviation, its mean against the root
mean square error. Photographed people and inputs are registered; rendered heads are marked exactly.
"""

import json
from pathlib import Path

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import even_hemisphere, light_from_angles, nearest_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.luminance import SHADOW
from facerelight.train.dataset import make_dataset

LEVELS = {"50": 0.6745, "80": 1.2816, "95": 1.96}


def rendered(heads: int, people: int, height: int, width: int):
    """Images ``(N, J, H, W)`` of rendered heads and their lights; the first two are the source and the target."""
    lights = torch.cat((torch.stack((light_from_angles(70.0, 0.0), light_from_angles(0.0, 0.0))), even_hemisphere(62)))
    dataset = make_dataset(
        TrainConfig(heads=heads + people, height=height, width=width, margin=0.0, supersample=1), lights
    )
    images = dataset.images(tqdm(range(heads + people), desc="rendering heads"))
    return images, lights


def measure(
    statistics: FaceStatistics,
    people: torch.Tensor,
    valid: torch.Tensor,
    lights: torch.Tensor,
    source: int,
    target: int,
    register: bool,
) -> dict:
    """Sums over test people, by model: squared shadow errors, identities, and how many errors lie within each
    interval."""
    sums: dict = {}
    gallery = people[valid[:, target], target]
    names = valid[:, target].nonzero()[:, 0].tolist()
    for model in ("pixel", "face"):
        relighter = StatisticalRelighter(statistics, model)
        total = {"shadow": [], "right": [], "inside": {name: [] for name in LEVELS}, "spread": [], "error": []}
        for person in range(len(people)):
            if not (valid[person, source] and valid[person, target]):
                continue
            posterior = relighter.condition(
                people[person : person + 1, source : source + 1], lights[source : source + 1], register=register
            )
            made = posterior.mean(lights[target : target + 1])[0, 0]
            dark = people[person, source] < SHADOW
            total["shadow"].append(
                float((made.clamp(0, 1) - people[person, target])[dark].square().mean().sqrt() * 255)
            )
            distance = (standard(made) - standard(gallery)).square().sum((-2, -1))
            total["right"].append(names[int(distance.argmin())] == person)
            others = [j for j in valid[person].nonzero()[:, 0].tolist() if j != source][::4]
            error = (posterior.mean(lights[others])[0] - people[person, others]).abs()
            spread = posterior.variance(lights[others])[0].sqrt()
            total["spread"].append(spread.flatten()[::7])
            total["error"].append(error.flatten()[::7])
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


def reliability(parts: list[dict], model: str, bins: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    """Predicted standard deviation and root mean square error of pixels, by twentieths of the predicted, in grey
    levels."""
    spread, error = (torch.cat([x for part in parts for x in part[model][what]]) for what in ("spread", "error"))
    order = spread.argsort()
    groups = zip(spread[order].tensor_split(bins), error[order].tensor_split(bins), strict=True)
    predicted, found = zip(*[(s.square().mean().sqrt(), e.square().mean().sqrt()) for s, e in groups], strict=True)
    return 255 * torch.stack(predicted), 255 * torch.stack(found)


def draw(curves: dict[str, tuple[torch.Tensor, torch.Tensor]], path: Path) -> None:
    figure = Figure(figsize=(4.5, 4), layout="constrained")
    axis = figure.subplots()
    for index, (name, (predicted, found)) in enumerate(curves.items()):
        axis.plot(predicted, found, ".-" if name.endswith("whole-face") else ".:", color=f"C{index // 2}", label=name)
    limit = max(float(torch.cat(curve).max()) for curve in curves.values())
    axis.plot((0, limit), (0, limit), "k", linewidth=0.6)
    axis.set_xlabel("predicted standard deviation, grey levels")
    axis.set_ylabel("root mean square error, grey levels")
    axis.legend(fontsize=7)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces(required=False)
    parser.add_argument("--heads", type=int, default=100)
    parser.add_argument("--people", type=int, default=20, help="held-out rendered heads")
    parser.add_size(96, 84)
    parser.add_argument(
        "--exposure", choices=["unit", "estimated"], default="estimated", help="the input's gain: 1, or an unknown"
    )
    parser.add_results("json")
    parser.add_argument("--plot", type=Path, default=None, help="reliability diagram")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    unknown_gain = args.exposure == "estimated"
    images, lights = rendered(args.heads, args.people, args.height, args.width)
    learned = FaceStatistics.fit(images[: args.heads], lights, None, FitOptions(face_rank=40, brightness=unknown_gain))
    strangers = images[args.heads :]
    everything = torch.ones(strangers.shape[:2], dtype=torch.bool)
    sums = {"rendered": [measure(learned, strangers, everything, lights, 0, 1, register=False)]}
    if args.data:
        faces = load_yale(args.data, args.height, args.width)
        images, valid = to_grid(faces)
        source, target = (
            int(nearest_lights(light_from_angles(*a)[None], faces.lights)) for a in ((70.0, 0.0), (0.0, 0.0))
        )
        parts = []
        for fold in range(4):
            out = torch.arange(len(images)) % 4 == fold
            aligned = align_people(images[~out], faces.lights, valid[~out])
            learned = FaceStatistics.fit(
                aligned, faces.lights, valid[~out], FitOptions(face_rank=18, brightness=unknown_gain)
            )
            parts.append(measure(learned, images[out], valid[out], faces.lights, source, target, register=True))
        sums["yale"] = parts
    if args.plot:
        models = {"pixel": "per-pixel", "face": "whole-face"}
        draw(
            {f"{name}, {models[model]}": reliability(parts, model) for name, parts in sums.items() for model in models},
            args.plot,
        )
    results = {name: summary(parts) for name, parts in sums.items()}
    print(json.dumps(results, indent=2))
    parser.save_report(args.json, results)


if __name__ == "__main__":
    main()
