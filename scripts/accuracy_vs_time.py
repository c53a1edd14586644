"""What accuracy costs in time: every knob of relighting against error on held-out rendered heads, as a CSV, a table and a plot.

python scripts/accuracy_vs_time.py --output trade_off/          (about five minutes on two cores; --quick for a smoke test)

Each row changes one knob of the default model. Error: RMSE in grey levels over held-out people, inputs lit from the front and from 70
degrees, twelve output lights. Time: median of paired runs of condition and render, as a ratio to one product of a (96 x 84, 64) with a
(64, 64) matrix in the same process, so that it carries to another machine. Memory: bytes of the statistics' buffers.
"""

import argparse
import csv
import statistics
import time
from dataclasses import replace
from pathlib import Path

import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from facerelight.config import DEFAULT_CONFIG, TrainConfig
from facerelight.illumination import KernelIlluminationEstimator
from facerelight.lights import even_hemisphere, light_from_angles
from facerelight.relighter import StatisticalRelighter
from facerelight.statistics import FaceStatistics, FitOptions
from facerelight.training import make_dataset

FIELDS = ["knob", "value", "default", "rmse_front", "rmse_side", "milliseconds", "ratio", "megabytes"]


class Bench:
    """Rendered people, split into bootstrap and strangers, and the reference operation."""

    def __init__(self, heads: int, people: int, height: int, width: int) -> None:
        self.inputs = torch.stack((light_from_angles(0.0, 0.0), light_from_angles(70.0, 0.0)))
        self.targets = even_hemisphere(12)
        self.lights = even_hemisphere(DEFAULT_CONFIG.directions().shape[0])
        every = torch.cat((self.inputs, self.targets, self.lights))
        dataset = make_dataset(TrainConfig(heads=heads + people, height=height, width=width, margin=0.0, supersample=1), every)
        images = dataset.images(tqdm(range(heads + people), desc="rendering heads"))
        self.bootstrap, self.strangers = images[:heads, 14:], images[heads:, :14]
        a, b = torch.rand(height * width, 64), torch.rand(64, 64)
        self.reference = lambda: a @ b

    def fit(self, options: FitOptions, heads: int | None = None, every: int = 1) -> FaceStatistics:
        return FaceStatistics.fit(self.bootstrap[:heads, ::every], self.lights[::every], options=options)

    def row(self, knob: str, value: object, default: bool, learned: FaceStatistics, model: str, repeats: int, **options) -> dict:
        """Error and time of one setting."""
        dtype = options.pop("dtype", torch.float32)
        variance, known = options.pop("variance", False), "draws" not in options
        relighter = StatisticalRelighter(learned, model, options.pop("estimator", None)).to(dtype)
        people, targets = self.strangers.to(dtype), self.targets.to(dtype)

        def relight(person: torch.Tensor, k: int) -> torch.Tensor:
            posterior = relighter.condition(person[None, k : k + 1], self.inputs[k : k + 1].to(dtype) if known else None, **options)
            if variance:
                posterior.variance(targets)
            return posterior.mean(targets)[0]

        errors = [
            [float((relight(p, k).clamp(0, 1) - p[2:].clamp(0, 1)).square().mean((1, 2)).sqrt().mean() * 255) for p in people] for k in (0, 1)
        ]
        times = []
        for _ in range(repeats):
            started = time.perf_counter()
            relight(people[0], 1)
            middle = time.perf_counter()
            for _ in range(20):
                self.reference()
            times.append((middle - started, (time.perf_counter() - middle) / 20))
        size = sum(buffer.numel() * buffer.element_size() for buffer in learned.buffers())
        row = {
            "knob": knob,
            "value": value,
            "default": "yes" if default else "",
            "rmse_front": round(statistics.mean(errors[0]), 2),
            "rmse_side": round(statistics.mean(errors[1]), 2),
            "milliseconds": round(1e3 * statistics.median(t for t, _ in times), 1),
            "ratio": round(statistics.median(t / r for t, r in times), 1),
            "megabytes": round(size / 1e6, 1),
        }
        print(row, flush=True)
        return row


def measure(bench: Bench, quick: bool) -> list[dict]:
    repeats = 3 if quick else 7
    default = DEFAULT_CONFIG.fit
    learned = bench.fit(default)
    rows = []

    def add(knob: str, value: object, is_default: bool, learned: FaceStatistics = learned, model: str = "face", **options) -> None:
        rows.append(bench.row(knob, value, is_default, learned, model, repeats, **options))

    add("model", "whole-face", True)
    add("model", "per-pixel", False, model="pixel")
    add("variance", "with the means", False, variance=True)
    if quick:
        return rows
    for rank in (5, 10, 20, 40, 80):
        add("whole-face rank", rank, rank == default.face_rank, bench.fit(replace(default, face_rank=rank)))
    for rank in (4, 8, 12, 24):
        add("correlation rank", rank, rank == default.rank, bench.fit(replace(default, rank=rank)))
    for basis in (8, 16, 24, 48):
        add("functions over lights", basis, basis == default.basis, bench.fit(replace(default, basis=basis)))
    for temper in (1.0, 10.0, 100.0, 1000.0):
        add("temper", temper, temper == default.temper, bench.fit(replace(default, temper=temper)))
    for heads in (20, 40, 80, len(bench.bootstrap)):
        add("heads", heads, heads == DEFAULT_CONFIG.heads, bench.fit(default, heads))
    for every in (4, 2, 1):
        add("lights", len(bench.lights[::every]), every == 1, bench.fit(default, None, every))
    add("unknown gain", "no", False, bench.fit(replace(default, brightness=False)))
    add("dtype", "float64", False, bench.fit(default), dtype=torch.float64)
    estimator = KernelIlluminationEstimator.fit(bench.bootstrap[:60], bench.lights)
    learned = bench.fit(default)
    for draws in (1, 8, 32, 128):
        add("light unknown, draws", draws, draws == 32, learned, estimator=estimator, draws=draws)
    return rows


def write(rows: list[dict], folder: Path) -> None:
    """The CSV, the Markdown table and the plot with its Pareto frontier."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "trade_off.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        writer.writeheader()
        writer.writerows(rows)
    lines = ["| knob | value | RMSE front | RMSE side | ms | ratio | MB |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        value = f"**{row['value']}**" if row["default"] else row["value"]
        cells = (row["rmse_front"], row["rmse_side"], row["milliseconds"], row["ratio"], row["megabytes"])
        lines.append(f"| {row['knob']} | {value} | " + " | ".join(str(cell) for cell in cells) + " |")
    (folder / "trade_off.md").write_text("\n".join(lines) + "\n")
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for index, knob in enumerate(dict.fromkeys(row["knob"] for row in rows)):
        points = [row for row in rows if row["knob"] == knob]
        axis.plot([p["milliseconds"] for p in points], [p["rmse_side"] for p in points], ".-", color=f"C{index % 10}", label=knob, linewidth=0.7)
    best, frontier = float("inf"), []
    for row in sorted(rows, key=lambda row: row["milliseconds"]):
        if row["rmse_side"] < best:
            best = row["rmse_side"]
            frontier.append(row)
    axis.step([f["milliseconds"] for f in frontier], [f["rmse_side"] for f in frontier], "k", where="post", linewidth=0.8, label="frontier")
    chosen = rows[0]
    axis.plot(chosen["milliseconds"], chosen["rmse_side"], "k*", markersize=12, label="default")
    axis.set_xscale("log")
    axis.set_xlabel("milliseconds to condition on one image and render twelve lights")
    axis.set_ylabel("RMSE, input lit from 70 degrees, grey levels")
    axis.legend(fontsize=6, ncols=2)
    figure.savefig(folder / "trade_off.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--quick", action="store_true")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    bench = Bench(10, 2, 24, 21) if args.quick else Bench(160, 10, 96, 84)
    write(measure(bench, args.quick), args.output)


if __name__ == "__main__":
    main()
