"""What training costs: by pass for each head and light, and in time and memory from 50 to 400 heads, with a plan for a
million.

python scripts/measure/training.py --picture scaling.png
python scripts/measure/training.py --processes
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import matplotlib
import torch
from torch import Tensor

from facerelight.bootstrap.effects import EFFECTS, CastShadow, LampLight, Scene
from facerelight.bootstrap.renderer import MeshRenderer
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

matplotlib.use("Agg")
import matplotlib.pyplot as plt

COUNTS = (50, 100, 200, 400)
MILLION = 1_000_000


class TimedShadow(CastShadow):
    """The cast shadow, its seconds put into a list."""

    def __init__(self, seconds: list[float]) -> None:
        self.seconds = seconds

    def attenuate(self, scene: Scene, where: Tensor, light: LampLight, renderer: MeshRenderer) -> None:
        """What stands in the way of the light."""
        started = time.perf_counter()
        super().attenuate(scene, where, light, renderer)
        self.seconds.append(time.perf_counter() - started)


def breakdown(config: TrainConfig, heads: int) -> dict[str, float]:
    """Mean milliseconds, single process: a head's mesh and geometry once; for each light planning, shadow pass, the
    rest of shading."""
    torch.set_num_threads(1)
    dataset = make_dataset(config)
    dataset.surface(0)  # opens the renderer
    times: dict[str, list[float]] = defaultdict(list)
    cast = EFFECTS["cast"]
    EFFECTS["cast"] = TimedShadow(times["shadow"])
    for index in range(heads):
        started = time.perf_counter()
        surface, material = dataset.surface(index)
        times["head"].append(time.perf_counter() - started)
        for light in dataset.lights:
            started = time.perf_counter()
            plan = plan_effects(surface, light, material)
            planned = time.perf_counter()
            shade(surface, light, material, plan, dataset.renderer)
            times["plan"].append(planned - started)
            times["light"].append(time.perf_counter() - planned)
    EFFECTS["cast"] = cast
    dataset.close()
    total = {name: 1e3 * sum(values) for name, values in times.items()}
    lights = heads * len(dataset.lights)
    return {
        "geometry of a head": total["head"] / heads,
        "planning a light": total["plan"] / lights,
        "shadow pass of a light": total["shadow"] / lights,
        "rest of a light": (total["light"] - total["shadow"]) / lights,
    }


def trained(heads: int, options: list[str]) -> dict[str, float]:
    """The report of a training run in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "facerelight.cli",
            "train",
            "--heads",
            str(heads),
            "--output",
            folder,
            "--workers",
            "0",
            "--json",
        ]
        return json.loads(
            subprocess.run([*command, *options], check=True, capture_output=True, text=True).stdout.splitlines()[-1]
        )


def shared(processes: int, folder: Path) -> tuple[float, float]:
    """Seconds of rendering and solving ``configs/tiny.yaml`` under torchrun, and of the whole command; every process
    held to one thread."""
    config = Path(__file__).parents[2] / "configs" / "tiny.yaml"
    launcher = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc-per-node",
        str(processes),
        "-m",
        "facerelight.cli",
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "1"}
    started = time.perf_counter()
    command = [*launcher, "train", "--config", str(config), "--output", str(folder), "--workers", "0"]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    report = json.loads((folder / "report.json").read_text())
    return report["render_seconds"] + report["solve_seconds"], time.perf_counter() - started


def two_processes(repeats: int) -> None:
    """One process against two: time, and the largest difference of any statistic."""
    with tempfile.TemporaryDirectory() as temporary:
        runs = [
            (shared(1, Path(temporary) / f"one{i}"), shared(2, Path(temporary) / f"two{i}")) for i in range(repeats)
        ]
        one, two = (
            FaceStatistics.load(Path(temporary) / name / "statistics.safetensors").state_dict()
            for name in ("one0", "two0")
        )
    largest = max(float((one[name] - two[name]).abs().max()) for name in one)
    training, whole = (statistics.median(a[k] / b[k] for a, b in runs) for k in (0, 1))
    print(
        f"two processes under torchrun, configs/tiny.yaml, medians of {repeats} pairs:"
        f" rendering and solving {training:.2f} times as fast as"
    )
    print(f"one, the whole command {whole:.2f} times; largest difference of a statistic {largest:.1e}")


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=5, help="for the costs by pass, at the default config's size")
    parser.add_argument("--height", type=int, default=48, help="of the runs of 50 to 400 heads")
    parser.add_argument("--width", type=int, default=42)
    parser.add_argument("--lights", type=int, default=32)
    parser.add_argument("--picture", type=Path, default=None)
    parser.add_argument("--processes", action="store_true", help="measure one process against two, and nothing else")
    parser.add_results("json")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    if args.processes:
        two_processes(5)
        return
    costs = breakdown(TrainConfig(heads=args.heads), args.heads)
    print(markdown([{"pass": name, "ms": round(milliseconds, 1)} for name, milliseconds in costs.items()]))
    options = [
        "--height",
        str(args.height),
        "--width",
        str(args.width),
        "--lights",
        str(args.lights),
        "--supersample",
        "1",
    ]
    runs = {count: trained(count, options) for count in COUNTS}
    rows = [
        {"heads": count, "rendering s": run["render_seconds"], "solving s": run["solve_seconds"]}
        | {"peak memory MB": run["peak_memory_mb"]}
        for count, run in runs.items()
    ]
    print(f"\n{markdown(rows)}")
    parser.save_report(args.json, {"milliseconds": costs, "runs": rows})
    config = TrainConfig()
    a_head = costs["geometry of a head"] + len(config.directions()) * (
        sum(costs.values()) - costs["geometry of a head"]
    )
    images = MILLION * len(config.directions()) * config.height * config.width * 4
    print(
        f"\na head of the default config: {a_head / 1e3:.2f} s of one core;"
        f" a million: {MILLION * a_head / 3.6e6:,.0f} core hours,"
    )
    print(f"{images / 1e12:.1f} TB of images; {86.4e6 / a_head:,.0f} heads a core and day")
    if args.picture:
        figure, axes = plt.subplots(1, 2, figsize=(9, 3.2))
        counts = list(runs)
        axes[0].plot(counts, [run["render_seconds"] for run in runs.values()], "o-", label="rendering")
        axes[0].plot(counts, [run["solve_seconds"] for run in runs.values()], "s-", label="solving")
        axes[1].plot(counts, [run["peak_memory_mb"] for run in runs.values()], "o-")
        for axis, label in zip(axes, ("seconds, one process", "peak memory, MB"), strict=True):
            axis.set_xlabel("heads")
            axis.set_ylabel(label)
            axis.set_ylim(0)
            axis.grid(alpha=0.3)
        axes[0].legend()
        figure.tight_layout()
        figure.savefig(args.picture, dpi=90)


if __name__ == "__main__":
    main()
