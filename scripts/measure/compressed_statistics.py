"""What compressing the default statistics costs: megabytes, load time, and what it changes in relit faces.

python scripts/measure/compressed_statistics.py --yale yaleb_192x168.npz --scan SCAN --csv

A row a coarseness, 0 for statistics as they are trained. Changes are root mean squares in grey levels against those,
over the face of crops relit from one light to seven others: held-out rendered heads, and Extended Yale B. Errors are
against the truth. *person* is that of portrait-A (fair and deep, see scripts/evaluate/portrait.py).
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from facerelight.config import DEFAULT_CONFIG, default_statistics_folder
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.alignment import CANONICAL_SIZE, CropFrame, fit_similarity, warp_to_crop
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter

ANGLES = [(0, 0), (70, 0), (-35, 15), (35, -20), (0, 45), (-60, -20), (-70, 45), (-10, -20)]  # all of Yale B
SOURCES = 3  # the first of them light the input
HELD_OUT = replace(DEFAULT_CONFIG, heads=10, seed=7919)
SCRIPTS = Path(__file__).parent.parent


class Crops(NamedTuple):
    """``images (N, L, h, w)`` of people under ``lights (L, 3)``, NaN where there is none; ``face (h, w)``, 0 or 1."""

    images: Tensor
    lights: Tensor
    face: Tensor


def rendered_crops() -> Crops:
    """Heads that the statistics have not seen."""
    from facerelight.train.dataset import make_dataset

    angles = torch.tensor(ANGLES, dtype=torch.float64)
    lights = light_from_angles(angles[:, 0], angles[:, 1]).float()
    return Crops(make_dataset(HELD_OUT, lights).images(), lights, (HELD_OUT.frame.oval() < 1).float())


def yale_crops(path: Path) -> Crops:
    """Every third person; the face ends where the photographs do."""
    frame = DEFAULT_CONFIG.frame
    faces = load_yale(path, *CANONICAL_SIZE)
    images, valid = to_grid(faces)
    images[~valid] = torch.nan
    chosen = [int((faces.angles - torch.tensor(pair)).abs().amax(1).argmin()) for pair in ANGLES]
    crops = images[::3, chosen]
    matrix = fit_similarity(CropFrame(*CANONICAL_SIZE).landmarks, frame.landmarks)[None]
    inner = torch.nn.functional.pad(torch.ones(1, 1, *(length - 2 for length in CANONICAL_SIZE)), (1, 1, 1, 1))
    inside = warp_to_crop(inner, matrix, frame)[0, 0] > 0.99
    warped = warp_to_crop(crops.flatten(0, 1)[:, None], matrix.expand(crops[..., 0, 0].numel(), -1, -1), frame)
    face = (inside & (frame.oval() < 1)).float()
    return Crops(warped[:, 0].unflatten(0, crops.shape[:2]), faces.lights[chosen], face)


def relit(relighter: StatisticalRelighter, crops: Crops) -> Iterator[tuple[Tensor, Tensor]]:
    """Every person from every source to the other lights, and the truth, grey levels on the face ``(L - 1, P)``."""
    on = crops.face > 0
    for person in crops.images:
        for source in range(SOURCES):
            if person[source].isnan().any():
                continue
            posterior = relighter.condition(
                person[source][None, None], crops.lights[source][None], mask=crops.face[None]
            )
            others = [light for light in range(len(crops.lights)) if light != source]
            image = posterior.mean(crops.lights[others])[0].clamp(0, 1)
            yield image[:, on] * 255, person[others][:, on] * 255


def change_and_error(outputs: list[Tensor], full: list[Tensor], truths: list[Tensor]) -> tuple[float, float]:
    """Root mean squares of what differs from ``full`` and from the truth, over all pixels that have one."""

    def rms(others: list[Tensor]) -> float:
        squared = torch.cat([(a - b).square().flatten() for a, b in zip(outputs, others, strict=True)])
        return float(squared.nanmean().sqrt())

    return rms(full), rms(truths)


def seconds_to_load(folder: Path) -> float:
    """The least of three."""
    taken = []
    for _ in range(3):
        started = time.perf_counter()
        StatisticalRelighter.from_pretrained(folder)
        taken.append(time.perf_counter() - started)
    return min(taken)


def person_error(folder: Path, scan: Path) -> float:
    """CIEDE2000 of portrait-A."""
    with tempfile.TemporaryDirectory() as place:
        report = Path(place) / "portrait.json"
        options = ["--data", scan, "--statistics", folder, "--methods", "facerelight", "--json", report]
        subprocess.run(
            [sys.executable, SCRIPTS / "evaluate" / "portrait.py", *options], check=True, stdout=subprocess.DEVNULL
        )
        return float(json.loads(report.read_text())["results"]["facerelight"]["person"])


def measure(folder: Path, sets: dict[str, Crops], full: dict[str, list[Tensor]], scan: Path | None) -> dict[str, float]:
    """One row; ``full`` holds the images of the full statistics, and is filled by the first call."""
    row = {"MB": sum(path.stat().st_size for path in folder.glob("*.safetensors")) / 1e6}
    row["load s"] = seconds_to_load(folder)
    relighter = StatisticalRelighter.from_pretrained(folder)
    for name, crops in sets.items():
        for model in ("face", "pixel"):
            pairs = list(relit(StatisticalRelighter(relighter.statistics, model), crops))  # type: ignore[arg-type]
            outputs, truths = [output for output, _ in pairs], [truth for _, truth in pairs]
            change, error = change_and_error(outputs, full.setdefault(f"{name} {model}", outputs), truths)
            row |= {f"{name} {model} change": change, f"{name} {model} error": error}
    if scan:
        row["person"] = person_error(folder, scan)
    return row


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--statistics", type=Path, help="full ones of the default config (default: the user's cache)")
    parser.add_argument("--coarseness", default="0.5,1,2,4", help="several with commas (default: 0.5,1,2,4)")
    parser.add_argument("--yale", type=Path, default=None, help="yaleb_192x168.npz")
    parser.add_argument("--scan", type=Path, default=None, help="folder with lps_head.npz and color.jpg")
    parser.add_argument("--threads", type=int, default=1, help="default: 1")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.set_grad_enabled(False)
    trained = args.statistics or default_statistics_folder(DEFAULT_CONFIG)
    sets = {"rendered": rendered_crops()} | ({"yale": yale_crops(args.yale)} if args.yale else {})
    full: dict[str, list[Tensor]] = {}
    rows = []
    for coarseness in (0.0, *map(float, args.coarseness.split(","))):
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place) if coarseness else trained
            if coarseness:
                StatisticalRelighter.from_pretrained(trained).save_pretrained(folder, compress=coarseness)
            row = {name: round(value, 3) for name, value in measure(folder, sets, full, args.scan).items()}
        rows.append({"coarseness": coarseness, **row})
        print(rows[-1], flush=True)
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
