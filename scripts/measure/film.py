"""How steady a relit film is, and what it costs.

python scripts/measure/film.py --csv

Three short films without compression: the astronaut (NASA, public domain, from scikit-image) as a still picture under
fresh noise in every frame; the same picture panned by parts of a pixel; a rendered head that turns and speaks under
fixed lamps, of which the truth under the new lamp is rendered too. Flicker is the root mean square of the second
difference over time at the person's pixels, over the square root of 6: of pure noise its standard deviation, of even
movement nothing. It is told of pixels, and of areas (blurred by 4 pixels), where the eye sees it. A panned film is
moved back first. With --long SECONDS also a film of 1280 x 720 through the command line: frames a second, and memory.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.sources import Lamp
from facerelight.photo import PhotoRelighter, load_relighter
from facerelight.photo.files.profiles import encode_srgb
from facerelight.photo.film.relighter import FilmRelighter, Lighting
from facerelight.photo.film.track import Picture

LAMP = Lamp(60, 20)
NOISE, AREA = 3.0, 4.0  # grey levels of a frame's own noise; pixels of an area
RATE = 25
TURN, NOD, OPEN = 10.0, 3.0, 0.4  # degrees to both sides and up and down; the mouth's most
EXPRESSION = "jawOpen"
SKIN, WALL = np.array((1.3, 0.92, 0.72)), np.array((0.25, 0.28, 0.33))


def noisy(picture: np.ndarray, rng: np.random.Generator, noise: float = NOISE) -> np.ndarray:
    return (picture + rng.normal(0, noise, picture.shape)).round().clip(0, 255).astype(np.uint8)


def still_film(count: int) -> list[np.ndarray]:
    """One picture, noise anew in every frame."""
    from skimage.data import astronaut

    rng, photo = np.random.default_rng(0), astronaut()
    return [noisy(photo, rng) for _ in range(count)]


def pan(k: int) -> np.ndarray:
    """Where frame ``k`` of the panned film lies in the picture, ``(2, 3)``."""
    return np.array([[1.0, 0, 9 * np.sin(k / 8) - 96], [0, 1.0, 4 * np.sin(k / 5) - 8]])


def panned_film(count: int) -> list[np.ndarray]:
    from skimage.data import astronaut

    rng, photo = np.random.default_rng(1), astronaut()
    return [noisy(cv2.warpAffine(photo, pan(k), (320, 400), flags=cv2.INTER_CUBIC), rng) for k in range(count)]


def rendered_films(count: int) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
    """A head that turns and speaks, with noise, and the truth under the new lamp without; where all frames show it."""
    from facerelight.bootstrap.dataset import open_renderer
    from facerelight.bootstrap.domain import Domain
    from facerelight.bootstrap.heads import MakeHumanHeads
    from facerelight.bootstrap.look.hair import SHORN
    from facerelight.bootstrap.look.skin import Look
    from facerelight.bootstrap.posture import place_in_frame, rotate
    from facerelight.bootstrap.shading import plan_effects, shade
    from facerelight.bootstrap.surface import view_surface
    from facerelight.geometry.alignment import CropFrame
    from facerelight.geometry.lights import light_from_angles

    frame, domain = CropFrame(400, 360, 0.55), Domain(fill=0.1)
    rng, renderer = np.random.default_rng(2), open_renderer(frame)
    look = replace(Look.random(np.random.default_rng(7), domain), style=SHORN)
    films: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    level, always = None, np.ones((frame.height, frame.width), bool)
    for k in range(count):
        head = MakeHumanHeads(11, expression={EXPRESSION: OPEN * (0.5 - 0.5 * np.cos(k / 2.5))}).head(0)
        turned = rotate(head, TURN * np.sin(k / 9), NOD * np.sin(k / 13) - 8.0)
        surface = view_surface(renderer, place_in_frame(turned, frame, head.landmarks), look)
        inside = np.zeros(frame.height * frame.width, np.float32)
        inside[surface.pixel.numpy()] = 1
        share = cv2.GaussianBlur(inside.reshape(frame.height, frame.width), (0, 0), 0.7)[..., None]
        always &= share[..., 0] > 0.99
        lamps = (((-25, 15, 1.0), (40, 20, 0.35)), ((LAMP.azimuth, LAMP.elevation, 1.0),))
        for film, lit in zip(films, lamps, strict=True):
            image = np.zeros((frame.height, frame.width), np.float32)
            for azimuth, elevation, power in lit:
                light = light_from_angles(float(azimuth), float(elevation))
                plan = plan_effects(surface, light, look.material)
                image += power * shade(surface, light, look.material, plan, renderer).numpy()
            level = level or float(np.percentile(image[share[..., 0] > 0.9], 90))
            linear = np.clip(image[..., None] / level * 0.5 * SKIN * share + WALL * (1 - share), 0, 1)
            coded = 255 * encode_srgb(linear)
            film.append(noisy(coded, rng, 2.0) if film is films[0] else coded.round().astype(np.uint8))
    renderer.close()
    return *films, always


def as_bright(truth: np.ndarray, like: np.ndarray, head: np.ndarray) -> np.ndarray:
    """``truth (T, H, W, 3)`` times one gain of radiance for all of it: a relit picture is exposed as it was."""
    radiance = [((film / 255 + 0.055) / 1.055) ** 2.4 for film in (truth, like)]
    gain = float((radiance[0] * radiance[1])[:, head].sum() / np.square(radiance[0][:, head]).sum())
    return 255 * (1.055 * np.minimum(gain * radiance[0], 1) ** (1 / 2.4) - 0.055).astype(np.float32)


def flicker(film: np.ndarray, person: np.ndarray) -> float:
    """Of a film ``(T, H, W, 3)`` at pixels ``person (H, W)``."""
    second = film[2:] - 2 * film[1:-1] + film[:-2]
    return float(np.sqrt(np.square(second[:, person]).mean() / 6))


def areas(film: np.ndarray) -> np.ndarray:
    return np.stack([cv2.GaussianBlur(frame, (0, 0), AREA) for frame in film])


def relit(film: Sequence[np.ndarray]) -> tuple[list[np.ndarray], FilmRelighter]:
    relighter = FilmRelighter(Lighting([LAMP]), load_relighter())
    pictures: Iterator[Picture] = (Picture(frame, k / RATE) for k, frame in enumerate(film))
    return [picture.pixels for picture in relighter.frames(pictures)], relighter


def measured(
    name: str, film: Sequence[np.ndarray], truth: Sequence[np.ndarray] | None = None, head: np.ndarray | None = None
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """What is told of a film, and the film relit."""
    started, used = time.perf_counter(), time.process_time()
    out, relighter = relit(film)
    seconds, used = time.perf_counter() - started, time.process_time() - used
    first = PhotoRelighter(film[0], relighter=relighter.relighter).render([LAMP]).astype(float)
    before, after = np.stack(film).astype(np.float32), np.stack(out).astype(np.float32)
    beside = before if truth is None else np.stack(truth).astype(np.float32)
    if name == "panned":
        size, way = before.shape[2:0:-1], cv2.INTER_CUBIC
        moved = [np.array([[1.0, 0, -pan(k)[0, 2] - 96], [0, 1.0, -pan(k)[1, 2] - 8]]) for k in range(len(film))]
        before, after = (
            np.stack([cv2.warpAffine(one, to, size, flags=way) for one, to in zip(frames, moved, strict=True)])
            for frames in (before, after)
        )
        beside = before
    person = (np.abs(after - before).max(-1) > 0).mean(0) > 0.9
    if head is not None:
        person, plain = head, before - as_bright(beside, before, head)
        beside = as_bright(beside, after, head)
    if name == "panned":
        person[:12] = person[-12:] = False
        person[:, :12] = person[:, -12:] = False
    row: dict[str, Any] = {"film": name, "frames": len(film), "keys": relighter.keys}
    for what, view in (("pixels", lambda x: x), ("areas", areas)):
        own, ours = flicker(view(before), person), flicker(view(after), person)
        row |= {f"{what}, film": f"{own:.3f}", f"{what}, relit": f"{ours:.3f}", f"{what}, ratio": f"{ours / own:.2f}"}
        if truth is not None:
            row[f"{what}, truth"] = f"{flicker(view(beside), person):.3f}"
    if truth is not None:
        error = after - beside
        row["error of a frame"] = f"{np.sqrt(np.square(areas(error)[:, person]).mean()):.2f}"
        row["error of the film as it is"] = f"{np.sqrt(np.square(areas(plain)[:, person]).mean()):.2f}"
        row["flicker of the error, areas"] = f"{flicker(areas(error), person):.3f}"
    row["first frame from the still path"] = f"{np.abs(out[0] - first).mean():.2f}"
    return {**row, **cost(len(film), seconds, used)}, out


def cost(frames: int, seconds: float, used: float) -> dict[str, str]:
    """By the clock, which a busy machine slows down, and of the processors."""
    return {"frames a second": f"{frames / seconds:.2f}", "processor seconds a frame": f"{used / frames:.3f}"}


def write_long(path: Path, seconds: float) -> int:
    """A film of 1280 x 720 that a hand might hold, 30 frames a second, with sound; returns its frames."""
    import av
    from skimage.data import astronaut

    rng, count = np.random.default_rng(3), round(30 * seconds)
    photo = cv2.resize(astronaut(), (1280, 1280), interpolation=cv2.INTER_CUBIC)[:800]
    with av.open(str(path), "w") as film:
        out = film.add_stream("libx264", rate=30, options={"crf": "14"})
        out.width, out.height, out.pix_fmt = 1280, 720, "yuv420p"  # type: ignore[attr-defined]
        for k in range(count):
            to = np.array([[1.0, 0, 20 * np.sin(k / 17)], [0, 1.0, 10 * np.sin(k / 11) - 25]])
            shown = noisy(cv2.warpAffine(photo, to, (1280, 720), borderMode=cv2.BORDER_REPLICATE), rng, 2.0)
            film.mux(out.encode(av.VideoFrame.from_ndarray(shown, format="rgb24")))  # type: ignore[attr-defined]
        film.mux(out.encode(None))  # type: ignore[attr-defined]
    return count


def spent() -> float:
    """Processor seconds of the processes that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def long_film(seconds: float) -> dict[str, Any]:
    """Through the command line, memory watched."""
    with tempfile.TemporaryDirectory() as place:
        film, output = Path(place, "long.mp4"), Path(place, "relit.mp4")
        count = write_long(film, seconds)
        words = [sys.executable, "-m", "facerelight.cli", "relight", str(film), "--light", "60,20"]
        memory, used = [], -spent()
        with subprocess.Popen([*words, "--output", str(output), "--json"], stdout=subprocess.PIPE, text=True) as run:
            while run.poll() is None:
                pages = Path(f"/proc/{run.pid}/statm").read_text().split()
                if len(pages) > 1:
                    memory.append(int(pages[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6)
                time.sleep(0.5)
            report = json.loads(run.stdout.read()) if run.stdout else {}
        used += spent()
    quarter = max(1, len(memory) // 4)
    return {
        "film": "1280 x 720, panned, H.264",
        "frames": count,
        "keys": report["keys"],
        **cost(count, report["seconds"], used),
        "memory, second quarter, MB": f"{np.median(memory[quarter : 2 * quarter]):.0f}",
        "memory, last quarter, MB": f"{np.median(memory[-quarter:]):.0f}",
    }


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--long", type=float, default=0.0, metavar="SECONDS")
    parser.add_argument("--films", type=Path, help="folder: every fifth frame as a picture, beside the film's own")
    parser.add_results("csv")
    arguments = parser.parse_args()
    films: dict[str, tuple[Any, ...]] = {"rendered head": rendered_films(arguments.frames)}
    films = {"still": (still_film(arguments.frames),), "panned": (panned_film(arguments.frames),), **films}
    table = []
    for name, (film, *known) in films.items():
        row, out = measured(name, film, *known)
        table.append(row)
        parser.save_rows(arguments.csv, table)  # so far
        print(json.dumps(row), flush=True)
        if arguments.films:
            arguments.films.mkdir(parents=True, exist_ok=True)
            for k in range(0, len(film), 5):
                shown = np.hstack([film[k], out[k], *([known[0][k]] if known else [])])
                cv2.imwrite(str(arguments.films / f"{name.replace(' ', '_')}_{k:03d}.png"), shown[..., ::-1])
    if arguments.long:
        table.append(long_film(arguments.long))
        print(json.dumps(table[-1]))
    parser.save_rows(arguments.csv, table)


if __name__ == "__main__":
    main()
