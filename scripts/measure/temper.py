"""How much one pixel's evidence about the whole face should count at several sizes of the same heads.

python scripts/measure/temper.py --csv

For each size and temper the error of held-out heads, and how many percent of their pixels lie in the 95 % interval: one
image of known light, brightness an unknown, eleven lights as targets. The smaller images are means over the pixels
of the largest.
"""

from dataclasses import replace

import torch

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import light_from_angles, nearest_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

SOURCES = [(0.0, 0.0), (70.0, 0.0)]
TEMPERS = (1.0, 6.25, 25.0, 100.0, 400.0, 1600.0)
REACH = 1.96


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=60)
    parser.add_argument("--people", type=int, default=16, help="held-out heads")
    parser.add_size(96, 84)
    parser.add_argument("--scales", type=float, nargs="+", default=[0.25, 0.5, 1.0], help="of the size")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    config = replace(
        DEFAULT_CONFIG,
        heads=args.heads + args.people,
        height=args.height,
        width=args.width,
        margin=0.0,
        supersample=1,
    )
    largest, lights = make_dataset(config).images(), config.directions()
    largest = ((largest.clamp(0, 1) * 255).round()) / 255
    sources = nearest_lights(torch.stack([light_from_angles(*angles) for angles in SOURCES]), lights).tolist()
    rows = []
    for scale in args.scales:
        size = (round(args.height * scale), round(args.width * scale))
        images = torch.nn.functional.interpolate(largest, size, mode="area")
        statistics = FaceStatistics.fit(images[: args.heads], lights, None, config.fit)
        relighter = StatisticalRelighter(statistics, "face")
        assert statistics.face is not None
        for temper in TEMPERS:
            statistics.face.temper.fill_(temper)
            row: dict[str, object] = {"size": f"{size[0]} x {size[1]}", "temper": temper}
            for source, name in zip(sources, ("front", "side"), strict=True):
                others = [light for light in range(0, len(lights), 6) if light != source]
                made = relighter.condition(images[args.heads :, source : source + 1], lights[source][None])
                mean, variance = made.render(lights[others])
                away = mean - images[args.heads :, others]
                row[f"{name}_rmse"] = round(255 * float(away.square().mean((2, 3)).sqrt().mean()), 2)
                inside = away.abs() < REACH * variance.sqrt()
                row[f"{name}_within_95"] = round(100 * float(inside.float().mean()), 1)
            rows.append(row)
            print(row, flush=True)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
