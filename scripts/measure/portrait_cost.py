"""What relighting a photograph costs: a portrait by stage, what is skipped, 24 megapixels, and the command.

python scripts/measure/portrait_cost.py --json portrait_cost.json

The portrait is the astronaut (NASA, public domain, from scikit-image), 560 x 700 with 98 pixels between the eyes.
Medians of runs that alternate; a busy machine makes them larger, so its load is said too.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.sources import Lamp
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter, load_relighter
from facerelight.photo.faces.landmarks import Face, find_faces

UNIT, WIDTH, HEIGHT = 98.0, 560, 700  # pixels between the eyes, and of the portrait
WARM_UP, LAMP, OTHER = Lamp(20, 10), Lamp(60, 20), Lamp(-50, 30)
FILL = 0.1
LARGE = (4000, 6000)  # height and width of 24 megapixels
FACE_SHARE = 0.04  # of the picture, the box around the face
SCENES = {"a lamp at the camera": Lamp(0, 0), "a soft lamp": Lamp(60, 20, size=40), "a bulb": Lamp(60, 20, size=1)}
GOALS = {"condition": 0.8, "light": 0.15, "24 megapixels": 3.0, "24 megapixels, MB": 1000.0, "command": 1.5}


def clocked(work: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds, and what came of it."""
    started = time.perf_counter()
    result = work()
    return time.perf_counter() - started, result


def portrait() -> np.ndarray:
    """``(700, 560, 3)`` uint8: head and shoulders, the eyes 98 pixels apart."""
    from skimage.data import astronaut

    photo = astronaut()
    marks = find_faces(photo)[0].landmarks
    (right, down), (x, y) = marks[1] - marks[0], marks[:2].mean(0)
    turn = UNIT / (right**2 + down**2) * np.array([[right, down], [-down, right]])  # the eyes level
    matrix = np.column_stack((turn, np.array([WIDTH / 2, HEIGHT * 0.38]) - turn @ (x, y)))
    return cv2.warpAffine(photo, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def close_up(photo: np.ndarray, face: Face) -> tuple[np.ndarray, np.ndarray]:
    """The middle of the face alone, from eye to eye and down to the mouth, and the landmarks in it."""
    (left, top), (right, bottom) = np.floor(face.landmarks.min(0)), np.ceil(face.landmarks.max(0))
    left, top, right, bottom = int(left), int(top) - 8, int(right) + 1, int(bottom) + 1
    return np.ascontiguousarray(photo[top:bottom, left:right]), face.landmarks - (left, top)


def condition_and_lights(photo: np.ndarray, relighter: StatisticalRelighter, repeats: int) -> dict[str, Any]:
    """Seconds to condition, a first and a further light; and of each stage, medians over fresh sessions."""
    taken: dict[str, list[float]] = {"constructor": [], "first light": [], "light": []}
    stages: dict[str, list[float]] = {}
    for index in range(repeats + 1):
        built, session = clocked(lambda: PhotoRelighter(photo, None, relighter))
        first = clocked(lambda s=session: s.render(LAMP, fill=FILL))[0]
        ran = list(session.stages)
        later = clocked(lambda s=session: s.render(OTHER, fill=FILL))[0]
        if index == 0:
            continue  # networks are read at their first use
        for name, value in (("constructor", built), ("first light", first), ("light", later)):
            taken[name].append(value)
        for stage in ran:
            stages.setdefault(stage.name, []).append(stage.seconds)
        for stage in [stage for stage in session.stages if stage not in ran]:
            stages.setdefault(f"further light: {stage.name}", []).append(stage.seconds)
    report: dict[str, Any] = {name: statistics.median(values) for name, values in taken.items()}
    rows = zip(taken["constructor"], taken["first light"], taken["light"], strict=True)
    report["condition"] = statistics.median(built + first - later for built, first, later in rows)
    return report | {"stages": {name: statistics.median(values) for name, values in stages.items()}}


def auto_and_all(
    photo: np.ndarray, relighter: StatisticalRelighter, lamp: Lamp, landmarks: np.ndarray | None, repeats: int
) -> dict[str, Any]:
    """Seconds of a session and of a light new to it, stages as planned and all of them; the largest difference in grey
    levels."""
    face = None if landmarks is not None else find_faces(photo)[0]
    taken: dict[str, list[tuple[float, float]]] = {"auto": [], "all": []}
    pictures, skipped = {}, []
    for _ in range(repeats):
        for name, rows in taken.items():

            def run(name: str = name) -> PhotoRelighter:
                session = PhotoRelighter(photo, landmarks, relighter, face=face, stages=name)  # type: ignore[arg-type]
                session.render(WARM_UP, fill=FILL)
                return session

            before, session = clocked(run)
            light, pictures[name] = clocked(lambda s=session: s.render(lamp, fill=FILL))
            rows.append((before, light))
            if name == "auto":
                skipped = sorted({stage.name for stage in session.stages if not stage.ran})
    difference = int(np.abs(pictures["auto"].astype(int) - pictures["all"].astype(int)).max())
    medians = {name: [statistics.median(row[k] for row in rows) for k in (0, 1)] for name, rows in taken.items()}
    report = {f"{name} {what}": medians[name][k] for name in taken for k, what in enumerate(("session", "light"))}
    return report | {"largest difference": difference, "skipped": skipped}


# -- 24 megapixels, in a process of its own ---------------------------------------------------------------------------
def large_photo(small: np.ndarray, face: Face, fills: bool) -> np.ndarray:
    """``(4000, 6000, 3)``: the portrait in front of a wall, or the bust from border to border."""
    height, width = LARGE
    if fills:
        rows = round(WIDTH * height / width)
        top = max(0, round(float(face.landmarks[:2, 1].mean()) - 0.45 * rows))
        return cv2.resize(small[top : top + rows], (width, height), interpolation=cv2.INTER_LINEAR)
    x0, y0, x1, y1 = face.box
    scale = float(np.sqrt(FACE_SHARE * height * width / ((x1 - x0) * (y1 - y0))))
    y, x = np.mgrid[:height, :width].astype(np.float32) / height
    wall = (110 + 40 * np.sin(3 * x) * np.cos(2 * y))[..., None] * np.array([0.95, 1, 1.05], np.float32)
    photo = wall.astype(np.uint8)
    large = cv2.resize(small, None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)[-height:]
    left = (width - large.shape[1]) // 2
    photo[height - len(large) :, left : left + large.shape[1]] = large
    return photo


def held(name: str) -> float:
    """Megabytes of this process: "VmRSS" now, "VmHWM" at most. (getrusage's peak counts the process that started
    it.)"""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 / 1e6 for line in lines if line.startswith(name + ":"))


def run_large(path: Path, repeats: int) -> dict[str, float]:
    """Seconds and peak memory of a photograph (.npy) above what was held when it had been read."""
    relighter, photo = load_relighter(), np.load(path)
    before = held("VmRSS")
    built, session = clocked(lambda: PhotoRelighter(photo, None, relighter))
    first = clocked(lambda: session.render(LAMP, fill=FILL))[0]
    later, pixels = [], []
    for k in range(repeats):
        later.append(clocked(lambda k=k: session.render(Lamp(-50 + 10 * k, 30), fill=FILL))[0])
        pixels += [stage.seconds for stage in session.stages if stage.name == "pixels"]
    peak = held("VmHWM")
    x0, y0, x1, y1 = session.face.box
    values = {
        "held before MB": before,
        "constructor": built,
        "first light": first,
        "light": statistics.median(later),
        "of it, pixels": statistics.median(pixels),
    }
    return values | {"peak MB": peak - before, "face share": (x1 - x0) * (y1 - y0) / photo[..., 0].size}


def megapixels(small: np.ndarray, face: Face, threads: int, repeats: int) -> dict[str, Any]:
    """:func:`run_large` for both photographs, in new processes."""
    report = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, fills in (("face 4 %", False), ("bust fills it", True)):
            path = Path(folder) / "photo.npy"
            np.save(path, large_photo(small, face, fills))
            own = [sys.executable, __file__, "--threads", str(threads), "--large", str(path), "--repeats", str(repeats)]
            report[name] = json.loads(subprocess.run(own, check=True, capture_output=True, text=True).stdout)
    return report


def command(threads: int, repeats: int = 5) -> dict[str, float]:
    """Seconds of ``facerelight relight`` of a 512 x 512 photo, and of ``import torch``, in turn."""
    from skimage.data import astronaut

    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    taken: dict[str, list[float]] = {"command": [], "import torch": []}
    with tempfile.TemporaryDirectory() as folder:
        photo, output = Path(folder) / "photo.png", Path(folder) / "relit.png"
        cv2.imwrite(str(photo), astronaut()[..., ::-1])
        relight = [
            "-m",
            "facerelight.cli",
            "relight",
            str(photo),
            "--light",
            "60,20",
            "--output",
            str(output),
            "--force",
        ]
        for _ in range(repeats + 1):
            for name, words in (("command", relight), ("import torch", ["-c", "import torch"])):
                run = [sys.executable, *words]
                taken[name].append(
                    clocked(lambda r=run: subprocess.run(r, check=True, capture_output=True, env=environment))[0]
                )
    report = {name: statistics.median(values[1:]) for name, values in taken.items()}
    return report | {"above it": report["command"] - report["import torch"]}


# -- report -----------------------------------------------------------------------------------------------------------
def lines(report: dict[str, Any], goals: dict[str, float]) -> str:
    """The report as a table, a line a figure, and goals beside those that have one."""
    rows = []

    def add(values: dict[str, Any], indent: str = "") -> None:
        for name, value in values.items():
            if isinstance(value, dict):
                rows.append(f"{indent}{name}")
                add(value, indent + "  ")
            else:
                shown = f"{value:9.3f}" if isinstance(value, float) else f" {value}"
                rows.append(f"{indent}{name:<{40 - len(indent)}} {shown}")

    add(report)
    return "\n".join([*rows, "goals", *(f"  {name:<38} {goal:9.3f}" for name, goal in goals.items())])


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--threads", type=int, default=2, help="default: 2")
    parser.add_argument("--repeats", type=int, default=7, help="of the portrait; fewer of what takes long (default: 7)")
    parser.add_argument("--parts", default="portrait,stages,megapixels,command", help="several with commas")
    parser.add_argument("--large", type=Path, help=argparse.SUPPRESS)
    parser.add_results("json")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    if args.large:
        print(json.dumps(run_large(args.large, args.repeats)))
        return
    relighter, small = load_relighter(), portrait()
    face = find_faces(small)[0]
    where = f"{os.cpu_count()} cores, threads used: {args.threads}"
    report: dict[str, Any] = {"machine": where, "load before": os.getloadavg()[0]}
    parts = args.parts.split(",")
    if "portrait" in parts:
        report["portrait"] = condition_and_lights(small, relighter, args.repeats)
    if "stages" in parts:
        few = max(3, args.repeats // 2)
        report["stages"] = {name: auto_and_all(small, relighter, lamp, None, few) for name, lamp in SCENES.items()}
        filled, landmarks = close_up(small, face)
        report["stages"]["a face that fills it"] = auto_and_all(filled, relighter, LAMP, landmarks, few)
    if "megapixels" in parts:
        report["24 megapixels"] = megapixels(small, face, args.threads, max(3, args.repeats // 2))
    if "command" in parts:
        report["command"] = command(args.threads)
    report["load after"] = os.getloadavg()[0]
    print(lines(report, GOALS))
    parser.save_report(args.json, report)


if __name__ == "__main__":
    main()
