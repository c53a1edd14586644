"""What a folder of photographs costs: one process beside two, memory as it goes on, and an interrupted run.

python scripts/measure/folder.py --photos 200 --broken 10 --csv

The photographs are small copies of the astronaut (NASA, public domain, from scikit-image), larger and smaller,
mirrored, lighter and darker, grey and with alpha, in five formats; the broken ones are cut off, empty, texts, or show
nobody. Every process has one thread. "photos alone" is the sum of the seconds that the manifest says of each photo.
"""

import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from facerelight.evaluation.results import ScriptParser

KINDS = (".jpg", ".png", ".webp", ".bmp", ".tif")
LIGHT = ("--light", "60,20", "--light", "-50,10,size=20,power=0.3")


def write_photos(folder: Path, count: int, broken: int) -> None:
    """``count`` photos in three folders, the last ``broken`` of them broken."""
    from skimage.data import astronaut

    generator = np.random.default_rng(0)
    whole = Image.fromarray(astronaut())
    for k in range(count):
        path = folder / f"set{k % 3}" / f"{k:03d}{KINDS[k % len(KINDS)]}"
        path.parent.mkdir(parents=True, exist_ok=True)
        if k >= count - broken:
            nobody = Image.fromarray(generator.integers(0, 256, (80, 80, 3), dtype=np.uint8))
            nobody.save(path)
            kept = (path.read_bytes()[:200], b"", b"no photo", path.read_bytes())[k % 4]
            path.write_bytes(kept)
            continue
        side = int(generator.integers(180, 300))
        photo = whole.crop((100, 0, 356, 256)).resize((side, side))
        photo = photo.transpose(Image.Transpose.FLIP_LEFT_RIGHT) if k % 2 else photo
        gain = float(generator.uniform(0.7, 1.1))
        photo = Image.fromarray((np.asarray(photo) * gain).clip(0, 255).astype(np.uint8))
        photo = photo.convert("L") if k % 7 == 3 else photo.convert("RGBA") if path.suffix == ".png" else photo
        photo.save(path)


def command(photos: Path, output: Path, workers: int, *more: str) -> list[str]:
    verb = [sys.executable, "-m", "facerelight.cli", "relight", str(photos), "--output", str(output), *LIGHT]
    return [*verb, "--workers", str(workers), "--json", *more]


def resident(process: int) -> float:
    """Megabytes of a process and of those that it began."""
    pages = int(Path(f"/proc/{process}/statm").read_text().split()[1])
    children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6 + sum(map(resident, map(int, children)))


def timed(words: list[str]) -> dict[str, Any]:
    """Run, and watch memory: its median in the second and in the last quarter of the run."""
    started, memory = time.perf_counter(), []
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    with tempfile.TemporaryFile() as out, subprocess.Popen(words, stdout=out, stderr=out, env=environment) as running:
        while running.poll() is None:
            try:
                memory.append(resident(running.pid))
            except (FileNotFoundError, ProcessLookupError, IndexError):
                continue  # a process ended meanwhile
            time.sleep(0.5)
    quarter = max(1, len(memory) // 4)
    early, late = float(np.median(memory[quarter : 2 * quarter])), float(np.median(memory[-quarter:]))
    return {"code": running.returncode, "seconds": time.perf_counter() - started, "early": early, "late": late}


def interrupted(words: list[str], output: Path, after: int) -> None:
    """Run until ``after`` photos have ended, then interrupt as a terminal does."""
    quiet = subprocess.DEVNULL
    with subprocess.Popen(words, stdout=quiet, stderr=quiet, start_new_session=True) as running:
        while running.poll() is None and len(rows(output)) < after:
            time.sleep(0.2)
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGINT)


def rows(output: Path) -> list[dict[str, str]]:
    """Of the manifest, none where there is none yet."""
    path = output / "manifest.csv"
    return list(csv.DictReader(path.read_text().splitlines())) if path.exists() else []


def measured(photos: Path, output: Path, workers: int) -> dict[str, Any]:
    """A whole run."""
    run = timed(command(photos, output, workers))
    table = rows(output)
    alone = sum(float(row["seconds"]) for row in table if row["status"] == "done")
    done = sum(row["status"] == "done" for row in table)
    return {
        "run": f"{workers} process{'es' * (workers > 1)}",
        "relit": done,
        "failed": len(table) - done,
        "exit code": run["code"],
        "seconds": f"{run['seconds']:.1f}",
        "photos alone, s": f"{alone:.1f}",
        "memory, second quarter, MB": f"{run['early']:.0f}",
        "memory, last quarter, MB": f"{run['late']:.0f}",
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--photos", type=int, default=200)
    parser.add_argument("--broken", type=int, default=10)
    parser.add_results("csv")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        photos = Path(place, "photos")
        write_photos(photos, arguments.photos, arguments.broken)
        table = []
        for workers in (1, 2):
            table.append(measured(photos, Path(place, f"out{workers}"), workers))
            print(json.dumps(table[-1]), flush=True)
        output = Path(place, "resumed")
        interrupted(command(photos, output, 2), output, arguments.photos // 2)
        before = sum(row["status"] == "done" for row in rows(output))
        table.append({**measured_rest(photos, output), "run": f"2 processes, interrupted after {before} photos"})
    print(json.dumps(table[-1]))
    parser.save_rows(arguments.csv, table)


def measured_rest(photos: Path, output: Path) -> dict[str, Any]:
    """The second half of an interrupted run: every photo is relit once."""
    run = timed(command(photos, output, 2, "--resume"))
    done = [row["photo"] for row in rows(output) if row["status"] == "done"]
    return {
        "relit": len(set(done)),
        "relit twice": len(done) - len(set(done)),
        "exit code": run["code"],
        "seconds": f"{run['seconds']:.1f}",
    }


if __name__ == "__main__":
    main()
