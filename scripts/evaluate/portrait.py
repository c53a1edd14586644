"""Protocol portrait-A: whole heads relit in colour, against a ray-traced scan of several skin tones.

python scripts/evaluate/portrait.py --data FOLDER_OF_THE_SCAN --tone fair,deep --json portrait.json

The scan is Lee Perry-Smith's (CC-BY 3.0): lps_head.npz (vertices, triangles, uv) and color.jpg.
"""

import argparse
import inspect
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch

from facerelight.evaluation.portrait import MEASURES, Make, PortraitTruth, Render, mean_scores, run_portraits
from facerelight.evaluation.scan import TONES, ScannedHead
from facerelight.photo import PhotoRelighter, load_relighter
from facerelight.relighter import StatisticalRelighter

SHEET = ((0, "front", "left"), (0, "front", "top"), (-1, "window", "left"), (-1, "window", "top"))
TILE = (224, 244)  # width and height, pixels


# -- methods: what is conditioned on a photo and its landmarks, and renders lamps with a fill -------------------------
def copy(photo: np.ndarray, landmarks: np.ndarray) -> Render:
    """The photo as it is."""
    return lambda lamps, fill: photo


def facerelight(load: Callable[[], StatisticalRelighter], **options: object) -> Make:
    """This package, with keyword options of its PhotoRelighter."""

    def make(photo: np.ndarray, landmarks: np.ndarray) -> Render:
        session = PhotoRelighter(photo, landmarks, load(), **options)
        if "fill" in inspect.signature(session.render).parameters:
            return lambda lamps, fill: session.render(lamps, fill=fill)
        return lambda lamps, fill: session.render(lamps[0].azimuth, lamps[0].elevation)

    return make


def registry(statistics: Path | None) -> dict[str, Make]:
    """All methods, by name; ``statistics`` are loaded when a method first asks for them."""

    @cache
    def load() -> StatisticalRelighter:
        return StatisticalRelighter.from_pretrained(statistics) if statistics else load_relighter()

    return {"copy": copy, "facerelight": facerelight(load)}


# -- report -----------------------------------------------------------------------------------------------------------
def table(results: dict[str, dict[str, float]]) -> str:
    """One row a method."""
    rows = [("", [f"{name:>10s}" for name in MEASURES])]
    rows += [(name, [f"{means[measure]:10.3f}" for measure in MEASURES]) for name, means in results.items()]
    return "\n".join(f"{name:16s}" + " ".join(cells) for name, cells in rows)


def sheet(images: dict[tuple[str, str], np.ndarray], tones: Sequence[str], columns: Sequence[str]) -> np.ndarray:
    """Photo, truth and methods side by side, for four cases; ``(H, W, 3)`` uint8."""
    rows = []
    for tone, source, target in SHEET:
        case = f"{tones[tone]}/{source}/{target}"
        tiles = [cv2.resize(images[case, name], TILE, interpolation=cv2.INTER_AREA) for name in columns]
        cv2.putText(tiles[0], case, (4, TILE[1] - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(np.hstack(tiles))
    header = np.full((18, TILE[0] * len(columns), 3), 255, np.uint8)
    for index, name in enumerate(columns):
        cv2.putText(header, name, (index * TILE[0] + 3, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([header, *rows])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with lps_head.npz and color.jpg")
    parser.add_argument("--tone", default="fair,deep", help=f"of {', '.join(TONES)}: several with commas")
    parser.add_argument("--yaw", type=float, default=0.0, help="degrees by which the head turns")
    parser.add_argument("--methods", default="copy,facerelight", help="several with commas")
    parser.add_argument("--statistics", type=Path, default=None, help="a trained folder; default: the cached one")
    parser.add_argument("--cache", type=Path, default=None, help="of ray-traced light; default: the user's")
    parser.add_argument("--output", type=Path, default=None, help="folder for pictures")
    parser.add_argument("--json", type=Path, default=None)
    args = parser.parse_args()

    torch.set_grad_enabled(False)
    started = time.perf_counter()
    known, names, tones = registry(args.statistics), args.methods.split(","), args.tone.split(",")
    for wanted, among, option in ((names, known, "--methods"), (tones, TONES, "--tone")):
        if unknown := [name for name in wanted if name not in among]:
            parser.error(f"{option}: expected some of {', '.join(among)}, got {unknown[0]!r}")
    head = ScannedHead(args.data, args.yaw, args.cache)
    images: dict[tuple[str, str], np.ndarray] = {}

    def keep(case: str, method: str, image: np.ndarray) -> None:
        images[case, method] = image

    cases = run_portraits((PortraitTruth(head, tone) for tone in tones), {name: known[name] for name in names}, keep)
    results = {name: mean_scores(by_case) for name, by_case in cases.items()}
    print(table(results))
    if args.json:
        report = {
            "protocol": "portrait-A",
            "tones": tones,
            "yaw_deg": args.yaw,
            "statistics": str(args.statistics or "default"),
            "results": results,
            "cases": cases,
            "seconds": round(time.perf_counter() - started, 1),
        }
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps(report, indent=1))
    if args.output:
        args.output.mkdir(parents=True, exist_ok=True)
        for (case, method), image in images.items():
            path = args.output / f"{case.replace('/', '_').replace(' ', '-')}_{method}.png"
            cv2.imwrite(str(path), image[..., ::-1])
        columns = ["photo", "truth", *(name for name in names if name != "copy")]
        cv2.imwrite(str(args.output / "sheet.png"), sheet(images, tones, columns)[..., ::-1])
    return 0


if __name__ == "__main__":
    sys.exit(main())
