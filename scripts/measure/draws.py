"""Monte Carlo: error against the number of draws, for the expected image (Algorithm 2) and the most probable one
(Algorithm 1).

python scripts/measure/draws.py --json draws.json

Light samples are independent, as in the thesis, or quasi-random. Errors are RMS grey levels against a converged run,
over held-out rendered heads under unknown lights; the model is that of configs/tiny.yaml.
"""

from dataclasses import replace
from pathlib import Path

import torch

from facerelight.cli import read_config
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.numerics.mixture import draw_mixture, histogram_mode, mixture_mode
from facerelight.train.dataset import make_dataset
from facerelight.train.run import trained_folder

COUNTS = (25, 50, 100, 200, 500, 1000)
REFERENCE = 8192


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--config", default=str(Path(__file__).parents[2] / "configs" / "tiny.yaml"))
    parser.add_argument("--people", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=4, help="sets of draws that are averaged")
    parser.add_results("json")
    args = parser.parse_args()
    config = read_config(args.config)
    relighter = StatisticalRelighter.from_pretrained(trained_folder(config), "pixel")
    dataset = make_dataset(replace(config, heads=config.heads + args.people))
    people = torch.stack([dataset[config.heads + index].images for index in range(args.people)])
    target = light_from_angles(35.0, 10.0)[None]
    estimator = relighter.estimator
    rows = []
    for inputs in (1, 2, 5):
        images = people[:, torch.linspace(2, people.shape[1] - 2, inputs).long()]

        def expected(count: int, seed: int, independent: bool, images=images) -> torch.Tensor:
            drawn = estimator.sample(images, count, torch.Generator().manual_seed(seed), independent)
            return relighter.condition(images, drawn).mean(target)

        converged = expected(REFERENCE, 99, False)
        for count in COUNTS:
            row = {"inputs": inputs, "draws": count}
            for name, independent in (("independent", True), ("quasi_random", False)):
                errors = [
                    (expected(count, seed, independent) - converged).square().mean() for seed in range(args.repeats)
                ]
                row[name] = float(torch.stack(errors).mean().sqrt() * 255)
            rows.append(row)
            print(row, flush=True)
    histogram = []
    images = people[:1, 2:3]
    components = relighter.condition(images, estimator.sample(images, 64)).people[0].components(target[0])
    exact = mixture_mode(*components)
    for draws in (1, 4, 16, 64, 256, 1024):
        generator = torch.Generator().manual_seed(0)
        counts = draw_mixture(components.mean, components.variance, draws, generator)
        error = (histogram_mode(counts) - exact).abs() * 255
        histogram.append(
            {"draws_a_pixel": 64 * draws, "mean_error": float(error.mean()), "p95_error": float(error.quantile(0.95))}
        )
        print(histogram[-1], flush=True)
    parser.save_report(args.json, {"expected": rows, "histogram": histogram})


if __name__ == "__main__":
    main()
