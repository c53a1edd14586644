"""How often the truth lies in the interval that the variance promises, on rendered heads that the statistics have not
seen.

python scripts/measure/coverage.py --csv

Percent of the face's pixels within the central 50, 80 and 95 % interval, over heads rounded to 8 bits: before an image
was seen (prior) and after one (posterior), its light known and estimated; to lights before and behind the face, and
from an input light in front and at the side.
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
BEHIND = [(100, 0), (-110, 20), (180, -60)]
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
    angles = torch.tensor(ANGLES + BEHIND, dtype=torch.float64)
    lights = light_from_angles(angles[:, 0], angles[:, 1]).float()
    config = replace(DEFAULT_CONFIG, heads=args.heads, seed=args.seed)
    images = (make_dataset(config, lights).images().clamp(0, 1) * 255).round() / 255
    face = config.frame.oval() < 1
    relighter = load_relighter()
    levels = torch.tensor(LEVELS, dtype=torch.float64) / 100
    reach = torch.special.ndtri((1 + levels) / 2)[:, None, None]
    inside: dict[tuple[str, str, str, str], list[Tensor]] = {}
    nothing = relighter.condition(images[:1, :1], torch.zeros(1, 3)).render(lights)
    for index, person in enumerate(images):
        source = SOURCES[index % len(SOURCES)]
        image, mask = person[None, source : source + 1], face[None].float()
        relit = {
            ("prior", "known"): nothing,
            ("posterior", "known"): relighter.condition(image, lights[source][None], mask=mask).render(lights),
            ("posterior", "estimated"): relighter.condition(image, None, draws=args.draws, mask=mask).render(lights),
        }
        targets = {"before": range(len(ANGLES)), "behind": range(len(ANGLES), len(lights))}
        for (state, known), (mean, variance) in relit.items():
            away = (person - mean[0])[:, face].double().abs() / variance[0][:, face].double().sqrt()
            for place, some in targets.items():
                kept = [light for light in some if light != source]
                case = (state, known, ("front", "side")[source > 0], place)
                inside.setdefault(case, []).append((away[kept] < reach).double().mean((1, 2)))
    rows = []
    for state, known, place in dict.fromkeys((s, k, p) for s, k, _, p in inside):
        parts = {side: inside[state, known, side, place] for side in ("front", "side")}
        for side, chosen in {"both": [*parts["front"], *parts["side"]], **parts}.items():
            share = 100 * torch.stack(chosen).mean(0)
            figures = {f"within_{n}": round(float(v), 1) for n, v in zip(LEVELS, share, strict=True)}
            rows.append({"state": state, "light": known, "input": side, "targets": place} | figures)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
