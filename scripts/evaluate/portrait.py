"""Protocol portrait-A: whole heads relit in colour, against a ray-traced scan of several skin tones.

python scripts/evaluate/portrait.py --data FOLDER_OF_THE_SCAN --tone fair,deep --json portrait.json
python scripts/evaluate/portrait.py --data FOLDER_OF_THE_SCAN --methods all --csv

A row a method: the package, and the package without one of its parts (``--methods all``), which says what each is
worth. The scan is Lee Perry-Smith's (CC-BY 3.0): lps_head.npz (vertices, triangles, uv) and color.jpg.
"""

import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from facerelight.evaluation.portrait import MEASURES, Make, PortraitTruth, Render, mean_scores, run_portraits
from facerelight.evaluation.results import ScriptParser, machine
from facerelight.evaluation.scan import TONES, ScannedHead
from facerelight.geometry.sources import Lamp
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.photo import PhotoRelighter, colour, load_relighter, person, ratio
from facerelight.photo import session as photo_session
from facerelight.photo.bust.frame import FINE
from facerelight.photo.bust.shading import BustShading

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
        return lambda lamps, fill: session.render(lamps, fill=fill)

    return make


# -- the package without one of its parts -----------------------------------------------------------------------------
class Part(NamedTuple):
    """What a part is switched off by: ``(owner, name, value)`` of constants or functions."""

    off: Sequence[tuple[Any, str, Any]]


def _no_highlight(scene: np.ndarray, diffuse: np.ndarray, whole: Any = colour.part_highlight) -> Any:
    amount, highlight = whole(scene, diffuse)
    return amount, np.zeros_like(highlight)


def _mean_bust(points: np.ndarray | None, down: tuple[float, float], fit: Any = photo_session.fit_bust) -> Any:
    return fit(None, down)


def _all_seen(*_: object) -> np.ndarray:
    return np.ones(FINE.size, np.float32)


PARTS: dict[str, Part] = {
    "no camera curve": Part([(colour, "SHOULDER", 0.0), (colour, "TOE", 1.0)]),
    "no highlight parting": Part([(colour, "part_highlight", _no_highlight)]),
    "no warm shade": Part([(colour, "WARM", 0.0)]),
    "no white light": Part([(colour, "MOST_TYPICAL", 0.0), (colour, "CAST", 0.0)]),
    "no rolling off": Part([(colour, "KNEE", 1e6)]),
    "no ground": Part([(person, "ground_behind", lambda scene, cover, unit: scene)]),
    "no held pigment": Part([(person, "HELD", 0.0)]),
    "no remainder": Part([(ratio, "SAME_LIGHT", 1e6)]),
    "no deepening": Part([(ratio, "LEAK", 1e-6)]),
    "no bust edges": Part([(ratio, "EDGES", 0.0)]),
    "no crisp": Part([(ratio, "SOFT", 0.0)]),
    "no cast shadows": Part([(BustShading, "sees_all", lambda *_: True), (BustShading, "fine_visibility", _all_seen)]),
    "mean bust": Part([(photo_session, "fit_bust", _mean_bust)]),
    "no join": Part([(ratio, "LEVEL", 0.0), (ratio, "NEAR_RIM", 0.0)]),
    "face only": Part([(ratio, "BUST_DARKEST", 0.0), (ratio, "BUST_BRIGHTEST", 0.0)]),
}
"""In the order in which light goes through them, last first."""


@contextmanager
def without(part: Part) -> Iterator[None]:
    """The package without a part, as long as it lasts."""
    kept = [(owner, name, getattr(owner, name)) for owner, name, _ in part.off]
    for owner, name, value in part.off:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in kept:
            setattr(owner, name, value)


def ablated(whole: Make, part: Part) -> Make:
    """``whole`` without ``part``."""

    def make(photo: np.ndarray, landmarks: np.ndarray) -> Render:
        with without(part):
            render = whole(photo, landmarks)
            render([Lamp(20, 10)], 0.1)  # stages of the photo run at their first use

        def other(lamps: Sequence[Lamp], fill: float) -> np.ndarray:
            with without(part):
                return render(lamps, fill)

        return other

    return make


def registry(statistics: Path | None) -> dict[str, Make]:
    """All methods, by name; ``statistics`` are loaded when a method first asks for them."""

    @cache
    def load() -> StatisticalRelighter:
        return StatisticalRelighter.from_pretrained(statistics) if statistics else load_relighter()

    whole = facerelight(load)
    return {"copy": copy, "facerelight": ablated(whole, Part([]))} | {
        name: ablated(whole, part) for name, part in PARTS.items()
    }


def timed(make: Make, seconds: list[float]) -> Make:
    """``make``, whose renders put their seconds into a list; what is done for the photo is not counted."""

    def wrapped(photo: np.ndarray, landmarks: np.ndarray) -> Render:
        render = make(photo, landmarks)

        def clocked(lamps: Sequence[Lamp], fill: float) -> np.ndarray:
            started = time.perf_counter()
            output = render(lamps, fill)
            seconds.append(time.perf_counter() - started)
            return output

        return clocked

    return wrapped


# -- report -----------------------------------------------------------------------------------------------------------
def table(results: Mapping[str, Mapping[str, float]]) -> str:
    """One row a method."""
    columns = (*MEASURES, "ms a light")
    rows = [("", [f"{name:>10s}" for name in columns])]
    rows += [(name, [f"{means[column]:10.3f}" for column in columns]) for name, means in results.items()]
    return "\n".join(f"{name:22s}" + " ".join(cells) for name, cells in rows)


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
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with lps_head.npz and color.jpg")
    parser.add_argument("--tone", default="fair,deep", help=f"of {', '.join(TONES)}: several with commas")
    parser.add_argument("--yaw", type=float, default=0.0, help="degrees by which the head turns")
    parser.add_argument("--methods", default="copy,facerelight", help="several with commas, or all")
    parser.add_argument("--statistics", type=Path, default=None, help="a trained folder; default: the packaged one")
    parser.add_argument("--cache", type=Path, default=None, help="of ray-traced light; default: the user's")
    parser.add_argument("--output", type=Path, default=None, help="folder for pictures")
    parser.add_argument("--threads", type=int, default=2, help="default: 2")
    parser.add_results("csv", "json")
    args = parser.parse_args()

    torch.set_grad_enabled(False)
    torch.set_num_threads(args.threads)
    cv2.setNumThreads(args.threads)
    started = time.perf_counter()
    known, tones = registry(args.statistics), args.tone.split(",")
    names = list(known) if args.methods == "all" else args.methods.split(",")
    for wanted, among, option in ((names, known, "--methods"), (tones, TONES, "--tone")):
        if unknown := [name for name in wanted if name not in among]:
            parser.error(f"{option}: expected some of {', '.join(among)}, got {unknown[0]!r}")
    head = ScannedHead(args.data, args.yaw, args.cache)
    images: dict[tuple[str, str], np.ndarray] = {}

    def keep(case: str, method: str, image: np.ndarray) -> None:
        if args.output:
            images[case, method] = image

    seconds: dict[str, list[float]] = {name: [] for name in names}
    methods = {name: timed(known[name], seconds[name]) for name in names}
    cases = run_portraits((PortraitTruth(head, tone) for tone in tones), methods, keep)
    results = {name: mean_scores(by_case) for name, by_case in cases.items()}
    for name, taken in seconds.items():
        results[name]["ms a light"] = round(1000 * statistics.median(taken), 1)
    print(table(results))
    print(f"machine: {machine()}")
    parser.save_rows(args.csv, [{"method": name, **means} for name, means in results.items()])
    report = {
        "protocol": "portrait-A",
        "tones": tones,
        "yaw_deg": args.yaw,
        "statistics": str(args.statistics or "default"),
        "machine": machine(),
        "results": results,
        "cases": cases,
        "seconds": round(time.perf_counter() - started, 1),
    }
    parser.save_report(args.json, report)
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
