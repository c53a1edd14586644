"""What goes wrong on ordinary photographs: measures a photo and light, their medians, and contact sheets to look at.

python scripts/evaluate/photographs.py FOLDER --json photographs.json --sheet outputs/photographs.png

With --truth FOLDER_OF_THE_SCAN, the step from cheek to ear is compared with that of a ray-traced head under the same
lamp.
"""

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from facerelight.evaluation.photographs import MEASURES, photograph_measures
from facerelight.evaluation.portrait import SOURCES, PortraitTruth
from facerelight.evaluation.results import ScriptParser
from facerelight.evaluation.scan import ScannedHead
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.sources import Lamp
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter, crop_frame, load_relighter
from facerelight.photo.files.disk import SUFFIXES, read_photo, write_photo

FILL = 0.10
LIGHTS: dict[str, tuple[list[Lamp], float]] = {
    "left": ([Lamp(60)], FILL),
    "right": ([Lamp(-60)], FILL),
    "front": ([Lamp(0)], FILL),
    "top": ([Lamp(0, 35)], FILL),
    "key and fill": ([Lamp(40, 25, size=12), Lamp(-50, 10, size=20, power=0.35)], 0.15),
}
SIDES = {"left": 1, "right": -1}
COLUMNS = ("original", "left", "right", "top", "key and fill")
BUST = (3.5, 3.0, 5.0)  # eye distances to each side, above and below the eyes
TALL, A_SHEET = 400, 5  # pixels of a picture; photos on a sheet


def render(session: PhotoRelighter, lamps: Sequence[Lamp], fill: float) -> np.ndarray:
    """The photo under lamps, ``(H, W, 3)`` uint8."""
    return session.render(lamps, fill=fill)


def truth_steps(folder: Path, cache: Path | None, frame: CropFrame) -> dict[str, float]:
    """The step from cheek to ear of the ray-traced head, by light: the mean over the set-ups of its photographs."""
    truth = PortraitTruth(ScannedHead(folder, cache=cache), "fair")
    steps: dict[str, list[float]] = {name: [] for name in SIDES}
    for source in SOURCES:
        for name, side in SIDES.items():
            case = truth.case(source, LIGHTS[name][0][0], FILL)
            measures = photograph_measures(case.photo, case.truth, truth.landmarks, frame, side=side)
            steps[name].append(measures["step"])
    return {name: round(float(np.mean(values)), 3) for name, values in steps.items()}


# -- contact sheets -------------------------------------------------------------------------------------------------
def bust(image: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """The photo around head and shoulders, 400 pixels tall."""
    (x, y), unit = landmarks[:2].mean(0), float(np.linalg.norm(landmarks[1] - landmarks[0]))
    side, above, below = (reach * unit for reach in BUST)
    rows = slice(max(0, round(y - above)), round(y + below))
    return tile(image[rows, max(0, round(x - side)) : round(x + side)])


def tile(image: np.ndarray) -> np.ndarray:
    """A picture as large as fits a place on the sheet, grey around it."""
    width = round(TALL * 2 * BUST[0] / (BUST[1] + BUST[2]))
    scale = min(width / image.shape[1], TALL / image.shape[0])
    size = (min(width, round(scale * image.shape[1])), min(TALL, round(scale * image.shape[0])))
    scaled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    place = np.full((TALL, width, 3), 128, np.uint8)
    place[: size[1], : size[0]] = scaled
    return place


def write_sheets(path: Path, rows: list[tuple[str, list[np.ndarray]]]) -> None:
    """Sheets of five photos: PATH with -1, -2 and so on before its suffix."""
    for number, start in enumerate(range(0, len(rows), A_SHEET), 1):
        lines = []
        for label, tiles in rows[start : start + A_SHEET]:
            tiles = tiles + [np.full_like(tiles[0], 255)] * (len(COLUMNS) - len(tiles))
            line = np.hstack(tiles)
            cv2.putText(line, label, (5, TALL - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
            cv2.putText(line, label, (5, TALL - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
            lines.append(line)
        header = np.full((22, lines[0].shape[1], 3), 255, np.uint8)
        for index, name in enumerate(COLUMNS):
            at = (index * lines[0].shape[1] // len(COLUMNS) + 4, 16)
            cv2.putText(header, name, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        write_photo(path.with_stem(f"{path.stem}-{number}"), np.vstack([header, *lines]))


# -- measuring ------------------------------------------------------------------------------------------------------
def measure(path: Path, relighter: StatisticalRelighter, output: Path | None) -> tuple[dict, list[np.ndarray]]:
    """Everything about one photo, and its pictures for the sheet."""
    rgb = np.asarray(read_photo(path).rgb)
    photo = rgb if rgb.dtype == np.uint8 else (rgb * 255).round().astype(np.uint8)
    started = time.perf_counter()
    try:
        session = PhotoRelighter(photo, None, relighter)
    except (ValueError, RuntimeError) as error:
        return {"found": False, "why": str(error)}, [tile(photo)]
    conditioned = time.perf_counter() - started
    landmarks = np.asarray(session.landmarks, dtype=float)
    matte = getattr(session, "matte", None)
    tiles, lights, seconds = {"original": bust(photo, landmarks)}, {}, []
    for name, (lamps, fill) in LIGHTS.items():
        started = time.perf_counter()
        relit = render(session, lamps, fill)
        seconds.append(time.perf_counter() - started)
        matte = None if matte is None else np.asarray(matte)
        lights[name] = photograph_measures(photo, relit, landmarks, crop_frame(relighter), matte, SIDES.get(name, 0))
        tiles[name] = bust(relit, landmarks)
        if output:
            write_photo(output / f"{path.stem}_{name.replace(' ', '-')}.png", relit)
    times = {"condition": round(conditioned, 2), "first_light": round(seconds[0], 2)}
    times["next_light"] = round(float(np.median(seconds[1:])), 2)
    report = {"found": True, "size": [*photo.shape[:2]], "seconds": times, "lights": lights}
    return report, [tiles[name] for name in COLUMNS]


def over(values: list[float], summary: object) -> float:
    """``np.median`` or another summary of the finite values."""
    finite = np.array([value for value in values if np.isfinite(value)])
    return round(float(summary(finite)), 4) if len(finite) else float("nan")  # type: ignore[operator]


def main() -> int:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("folder", type=Path, help="of photographs")
    parser.add_argument("--statistics", type=Path, default=None, help="a trained folder; default: the packaged one")
    parser.add_argument("--truth", type=Path, default=None, help="folder with lps_head.npz and color.jpg")
    parser.add_argument("--cache", type=Path, default=None, help="of ray-traced light; default: the user's")
    parser.add_argument("--output", type=Path, default=None, help="folder for the relit photographs")
    parser.add_argument("--sheet", type=Path, default=None, help="contact sheets: FILE-1, FILE-2 and so on")
    parser.add_argument("--only", default="", help="names of photographs, without suffix, several with commas")
    parser.add_results("json")
    args = parser.parse_args()

    torch.set_grad_enabled(False)
    wanted = set(filter(None, args.only.split(",")))
    paths = [path for path in sorted(args.folder.glob("*")) if path.suffix.lower() in SUFFIXES]
    paths = [path for path in paths if not wanted or path.stem in wanted]
    if not paths:
        parser.error(f"{args.folder}: expected photographs, got none")
    relighter = StatisticalRelighter.from_pretrained(args.statistics) if args.statistics else load_relighter()
    photos, rows = {}, []
    for path in paths:
        report, tiles = measure(path, relighter, args.output)
        photos[path.name] = report
        rows.append((path.name, tiles))
        print(path.name, report["seconds"] if report["found"] else report["why"], flush=True)
    found = [report for report in photos.values() if report["found"]]
    columns: dict[str, dict[str, list[float]]] = {}
    for name in LIGHTS:
        columns[name] = {key: [report["lights"][name][key] for report in found] for key in MEASURES}
    medians = {name: {key: over(values, np.median) for key, values in by.items()} for name, by in columns.items()}
    largest = {name: {key: over(values, np.max) for key, values in by.items()} for name, by in columns.items()}
    truth = truth_steps(args.truth, args.cache, crop_frame(relighter)) if args.truth else {}
    for title, summary in (("median", medians), ("largest", largest)):
        print(f"{title:14s}" + " ".join(f"{measure:>9s}" for measure in MEASURES))
        for name, values in summary.items():
            print(f"{name:14s}" + " ".join(f"{values[measure]:9.3f}" for measure in MEASURES))
    beyond = {name: sum(step > truth[name] + 0.3 for step in columns[name]["step"]) for name in truth}
    print(f"found {len(found)} of {len(paths)}; truth's step {truth}; photographs over it by 0.3 stops: {beyond}")
    report = {"found": len(found), "of": len(paths), "truth_step": truth, "step_beyond_truth": beyond}
    parser.save_report(args.json, report | {"medians": medians, "largest": largest, "photos": photos})
    if args.sheet:
        write_sheets(args.sheet, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
