"""Measure relighting of rendered heads that twenty surroundings lit: protocol rendered-surroundings.

python scripts/evaluate/environments.py --csv
python scripts/evaluate/environments.py --statistics FOLDER --people 2 --seed 1 --csv part.csv
python scripts/evaluate/environments.py --join part.csv other_part.csv --csv

Skies, windows, rooms, streets as environment maps; each lights a picture of every held-out head. Asked for are single
lights, and the other surroundings. ``labelled`` is the exact posterior under the surrounding as the package reads its
map, ``estimated`` under amounts it estimates itself, ``quotient`` the picture brought to one lamp by the quotient of
average faces, ``one lamp`` its light taken for one lamp in its true middle. One gain for all targets of a picture.
"""

import sys
from dataclasses import replace
from pathlib import Path

import torch

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.rendered.environments import environments
from facerelight.evaluation.rendered.surroundings import ROWS, measure_head, render_heads, surroundings
from facerelight.evaluation.results import ScriptParser, joined_rows, markdown
from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.amounts import SoftLightEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=40, help="to learn from")
    parser.add_argument("--people", type=int, default=4, help="held-out heads")
    parser.add_argument("--seed", type=int, default=7919, help="of the held-out heads")
    parser.add_argument("--targets", type=int, default=12, help="single lights asked for")
    parser.add_argument("--draws", type=int, default=16, help="of an estimated light")
    parser.add_size(48, 42)
    parser.add_argument("--statistics", type=Path, help="folder of trained ones, of the same size, instead of --heads")
    parser.add_argument("--join", type=Path, nargs="+", metavar="CSV", help="make the table of several runs' files")
    parser.add_results("csv")
    args = parser.parse_args()
    if args.join:
        rows = joined_rows(args.join, ("surrounding", "targets", "row"), "pictures")
        print(markdown(rows))
        parser.save_rows(args.csv, rows)
        return 0
    torch.set_grad_enabled(False)
    size = {"height": args.height, "width": args.width, "margin": 0.0, "supersample": 1}
    config = replace(DEFAULT_CONFIG, heads=args.heads, **size)
    lights = config.directions()
    if args.statistics:
        statistics = FaceStatistics.load(args.statistics / "statistics.safetensors")
    else:
        statistics = FaceStatistics.fit(make_dataset(config).images(), lights, None, config.fit)
    relighter = StatisticalRelighter(statistics, "face", SoftLightEstimator(statistics))
    targets = even_hemisphere(args.targets)
    heads = render_heads(replace(config, heads=args.people, seed=args.seed), targets)
    places = surroundings(environments())
    found: dict[tuple[str, str, str], list[dict[str, float]]] = {}
    for index in range(args.people):
        for (name, row, what), scores in measure_head(relighter, heads, index, targets, places, args.draws).items():
            for place in ("all", name):
                found.setdefault((place, row, what), []).append(scores)
        print(f"head {index + 1} of {args.people}", file=sys.stderr, flush=True)
    rows = []
    for place in ("all", *places):
        for what in ("single", "surroundings"):
            for row in ROWS:
                scores = found[place, row, what]
                means = {name: sum(one[name] for one in scores) / len(scores) for name in scores[0]}
                digits = {"rmse": 2, "ssim": 4, "coverage95": 1}
                shown = {name: round(value, digits[name]) for name, value in means.items()}
                rows.append({"surrounding": place, "targets": what, "row": row, "pictures": len(scores), **shown})
    print(markdown(rows))
    parser.save_rows(args.csv, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
