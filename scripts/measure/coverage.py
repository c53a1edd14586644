"""How often the truth lies in the interval that the variance promises, on rendered heads that the statistics have not
seen.

python scripts/measure/coverage.py --csv

Percent of the face's pixels within the central 50, 80 and 95 % interval, over heads rounded to 8 bits: before an image
was seen (prior) and after one (posterior), its light known and estimated.
"""

from dataclasses import replace

import torch
from torch import Tensor

from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import light_from_angles
from facerelight.photo.face_model import load_relighter
from facerelight.train.dataset import make_dataset

ANGLES = [(10, 5), (0, 0), (70, 0), (-35, 15), (35, -20), (0, 45), (-60, -20), (-70, 45)]
SOURCES = (0, 2)  # the input's light, in turn over people
LEVELS = (50, 80, 95)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=100)
    parser.add_argument("--seed", type=int, default=7919)
    parser.add_argument("--draws", type=int, default=16, help="of an estimated light")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    angles = torch.tensor(ANGLES, dtype=torch.float64)
    lights = light_from_angles(angles[:, 0], angles[:, 1]).float()
    config = replace(DEFAULT_CONFIG, heads=args.heads, seed=args.seed)
    images = (make_dataset(config, lights).images().clamp(0, 1) * 255).round() / 255
    face = config.frame.oval() < 1
    relighter = load_relighter()
    levels = torch.tensor(LEVELS, dtype=torch.float64) / 100
    reach = torch.special.ndtri((1 + levels) / 2)[:, None, None]
    inside: dict[tuple[str, str], list[Tensor]] = {}
    nothing = relighter.condition(images[:1, :1], torch.zeros(1, 3)).render(lights)
    for index, person in enumerate(images):
        source = SOURCES[index % len(SOURCES)]
        others = [light for light in range(len(lights)) if light != source]
        truth = person[others][:, face].double()
        for light, known in (("known", lights[source][None]), ("estimated", None)):
            seen = relighter.condition(
                person[None, source : source + 1], known, draws=args.draws, mask=face[None].float()
            ).render(lights[others])
            prior = (nothing.mean[:, others], nothing.variance[:, others])
            for state, (mean, variance) in (("prior", prior), ("posterior", seen)):
                away = (truth - mean[0][:, face]).abs() / variance[0][:, face].double().sqrt()
                inside.setdefault((state, light), []).append((away < reach).double().mean((1, 2)))
    rows = [
        {"state": state, "light": light}
        | {f"within_{n}": round(100 * float(v), 1) for n, v in zip(LEVELS, torch.stack(parts).mean(0), strict=True)}
        for (state, light), parts in inside.items()
    ]
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
