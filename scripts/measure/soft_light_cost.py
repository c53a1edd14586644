"""What each setting of the estimate of many lights buys, and what it costs: error and time beside the default's.

python scripts/measure/soft_light_cost.py --csv
python scripts/measure/soft_light_cost.py --statistics FOLDER --knobs pixels --csv part.csv
python scripts/measure/soft_light_cost.py --join part.csv other_part.csv --csv

Held-out rendered heads under made-up surroundings; single lights are asked for, their means alone. Changed one at a
time: how many pixels the estimator looks at, its most steps, how many samples of the light the picture is integrated
over, and how many of the estimated lights, the brightest, make the sum that the model is conditioned on. Milliseconds
are the median over the pictures.
"""

import statistics as averages
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.rendered.environments import environments
from facerelight.evaluation.rendered.surroundings import (
    SurroundedHeads,
    one_gain,
    render_heads,
    surroundings,
)
from facerelight.evaluation.results import ScriptParser, markdown, read_rows
from facerelight.geometry.lights import even_hemisphere
from facerelight.geometry.sums import LightSum
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light import amounts as light_amounts
from facerelight.light.amounts import SoftLightEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

EVERY = 4  # of the surroundings one is taken
KNOBS = {
    "pixels": (60, 125, 250, 500, 1000, 2000),
    "steps": (1, 2, 4, 8, 30),
    "samples": (1, 4, 8, 16, 32),
    "lights": (1, 2, 4, 8, 16, 32, 64),
}


class Setting(NamedTuple):
    """``pixels`` the estimator looks at, its most ``steps``, ``samples`` of the light and ``lights`` of the sum; one
    sample is the most probable light itself."""

    pixels: int = 500
    steps: int = 30
    samples: int = 16
    lights: int = 64


def relit(relighter: StatisticalRelighter, photo: Tensor, targets: Tensor, setting: Setting) -> Tensor:
    """``photo (H, W)`` under ``targets (Q, 3)``, ``(Q, H, W)``."""
    belief = relighter.estimator.locate(photo[None, None])
    if setting.samples == 1:
        light = belief.light.amounts[None]  # (1, 1, 1, n)
    else:
        light = belief.draw_sums(setting.samples, None, False).amounts
    directions = belief.light.directions
    if setting.lights < len(directions):
        kept = belief.light.amounts[0, 0].topk(setting.lights).indices
        most = light[..., kept]
        most = most * light.sum(-1, keepdim=True) / most.sum(-1, keepdim=True).clamp_min(1e-12)
        directions, light = directions[kept], most
    return relighter.condition(photo[None, None], LightSum(directions, light)).mean(targets)[0]


def measure(
    statistics: FaceStatistics, heads: SurroundedHeads, targets: Tensor, truths: list[Tensor], setting: Setting
) -> tuple[float, float]:
    """Mean error in grey levels, and the median of milliseconds a picture."""
    most, light_amounts.STEPS = light_amounts.STEPS, setting.steps
    relighter = StatisticalRelighter(statistics, "face", SoftLightEstimator(statistics, setting.pixels))
    errors, times = [], []
    try:
        for single, sphere in zip(heads.single, heads.sphere, strict=True):
            for truth in truths:
                picture = torch.tensordot(truth, sphere, 1)
                photo = ((picture / picture.quantile(0.995)).clamp(0, 1) * 255).round() / 255
                started = time.perf_counter()
                image = relit(relighter, photo, targets, setting)
                times.append(1000 * (time.perf_counter() - started))
                errors.append(one_gain(image, single)["rmse"])
    finally:
        light_amounts.STEPS = most
    return sum(errors) / len(errors), averages.median(times)


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=40, help="to learn from")
    parser.add_argument("--people", type=int, default=2, help="held-out heads")
    parser.add_argument("--seed", type=int, default=7919, help="of the held-out heads")
    parser.add_argument("--targets", type=int, default=12, help="single lights asked for")
    parser.add_size(48, 42)
    parser.add_argument("--knobs", nargs="+", choices=list(KNOBS), default=list(KNOBS))
    parser.add_argument("--statistics", type=Path, help="folder of trained ones, of the same size, instead of --heads")
    parser.add_argument("--join", type=Path, nargs="+", metavar="CSV", help="make the table of several runs' files")
    parser.add_results("csv")
    args = parser.parse_args()
    if args.join:
        rows = [row for path in args.join for row in read_rows(path)]
        print(markdown(rows))
        parser.save_rows(args.csv, rows)
        return 0
    torch.set_grad_enabled(False)
    size = {"height": args.height, "width": args.width, "margin": 0.0, "supersample": 1}
    config = replace(DEFAULT_CONFIG, heads=args.heads, **size)
    if args.statistics:
        statistics = FaceStatistics.load(args.statistics / "statistics.safetensors")
    else:
        statistics = FaceStatistics.fit(make_dataset(config).images(), config.directions(), None, config.fit)
    targets = even_hemisphere(args.targets)
    heads = render_heads(replace(config, heads=args.people, seed=args.seed), targets)
    truths = [place.truth for place in list(surroundings(environments()).values())[::EVERY]]
    measure(statistics, heads, targets, truths[:1], Setting())  # what is made once is made before the clock runs
    base_error, base_time = measure(statistics, heads, targets, truths, Setting())
    rows = []
    for knob in args.knobs:
        for value in KNOBS[knob]:
            setting = Setting()._replace(**{knob: value})
            default = setting == Setting()
            error, took = (base_error, base_time) if default else measure(statistics, heads, targets, truths, setting)
            rows.append(
                {
                    "knob": knob,
                    "value": value,
                    "rmse": round(error, 2),
                    "error_ratio": round(error / base_error, 3),
                    "ms": round(took),
                    "time_ratio": round(took / base_time, 2),
                    "default": int(default),
                }
            )
            print(rows[-1], file=sys.stderr, flush=True)
    print(markdown(rows, "value"))
    parser.save_rows(args.csv, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
