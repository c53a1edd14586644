"""Parts of accuracy_vs_time.py: memory, and the rows on recognition, rendering and poses."""

import ctypes
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace

import torch
from evaluate_pose import INPUTS, TARGETS, GridViews

from facerelight.config import DEFAULT_CONFIG, TrainConfig
from facerelight.geometry.lights import angle_grid, even_hemisphere, hemisphere_quadrature
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.exemplars import direct_subspace, light_moments, synthesize
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.photometric import make_normalizer
from facerelight.train.dataset import make_dataset
from facerelight.viewpoint.pose import BootstrapViews, ViewRelighter


def peak_memory_mb(run: Callable[[], object]) -> float:
    """Resident memory that ``run`` needs on top of what is there, in MB (Linux with glibc: the high-water mark is reset
    first)."""

    def status(field: str) -> int:
        with open("/proc/self/status") as file:
            return next(int(line.split()[1]) for line in file if line.startswith(field))

    ctypes.CDLL(None).malloc_trim(
        0
    )  # what earlier work freed goes back to the system, and does not hide what this needs
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    before = status("VmRSS")
    run()
    return max(0, status("VmHWM") - before) / 1024


def recognition(
    learned: FaceStatistics, people: torch.Tensor, lights: torch.Tensor, targets: torch.Tensor, quick: bool
) -> list[dict[str, object]]:
    """Individual PCA over ``people (N, J, H, W)``, each enrolled from one image lit from up to 70 degrees, probes under
    the ``targets``."""
    relighter = StatisticalRelighter(learned, "face")
    generator = torch.Generator().manual_seed(0)
    front = (lights[:, 2] > 0.34).nonzero()[:, 0]
    chosen = front[torch.randint(len(front), (len(people),), generator=generator)]
    photos = people[torch.arange(len(people)), chosen]
    probes = people[:, targets].flatten(0, 1)
    labels = [person for person in range(len(people)) for _ in targets]
    rows: list[dict[str, object]] = []

    def add(
        knob: str,
        value: object,
        default: bool,
        nodes: torch.Tensor | None = None,
        dimension: int = 9,
        photometric: str | None = None,
        scale: float = 1.0,
    ) -> None:
        nodes = even_hemisphere(80) if nodes is None else nodes
        small = (round(people.shape[2] * scale), round(people.shape[3] * scale))

        def shrunk(images: torch.Tensor) -> torch.Tensor:
            return images if scale == 1 else torch.nn.functional.interpolate(images[:, None], small, mode="area")[:, 0]

        classifier = IndividualPCAClassifier(dimension, normalizer=make_normalizer(photometric))
        started = time.perf_counter()
        posterior = relighter.condition(photos[:, None], lights[chosen][:, None])
        if value == "direct, no synthesis":
            moments = light_moments(posterior, nodes, torch.ones(len(nodes)))
            classifier.fit_subspaces(
                [direct_subspace(person, moments, dimension) for person in posterior.people], range(len(people))
            )
        else:
            relit = synthesize(posterior, nodes).flatten(0, 1)
            classifier.fit(shrunk(relit), [person for person in range(len(people)) for _ in nodes])
        enrolled = time.perf_counter()
        right = classifier.score(shrunk(probes), labels)
        ended = time.perf_counter()
        rows.append(
            {
                "knob": knob,
                "value": value,
                "default": "yes" if default else "",
                "error": round(100 * (1 - right), 1),
                "enrol_ms": round(1e3 * (enrolled - started) / len(people), 1),
                "probe_ms": round(1e3 * (ended - enrolled) / len(probes), 2),
                "mb_a_person": round(classifier.bases[0].numel() * 4 / 1e6, 2),
            }
        )
        print(rows[-1], flush=True)

    add("exemplars", 80, True)
    add("exemplars", "direct, no synthesis", False)
    if quick:
        return rows
    for count in (20, 40, 160):
        add("exemplars", count, False, even_hemisphere(count))
    add("exemplars", "900, the thesis's grid", False, angle_grid(30))
    for order in (4, 8, 12):
        add("quadrature of the hemisphere", f"{2 * order**2} nodes", False, hemisphere_quadrature(order)[0])
    for dimension in (3, 5, 9, 20, 40):
        add("dimensions", dimension, dimension == 9, dimension=dimension)
    for scale in (0.25, 0.5, 1.0):
        add("resolution", f"{scale:g} of 96 x 84", scale == 1, scale=scale)
    for photometric in ("tan_triggs", "weber"):
        add("photometric", photometric, False, photometric=photometric)
    return rows


def rendering(heads: int, lights: int) -> list[dict[str, object]]:
    """Effects that a scene calls for against all of them, at the default config's size: time of an image and distance
    from all effects."""
    images: dict[str, torch.Tensor] = {}
    rows: list[dict[str, object]] = []
    for effects in ("all", "auto"):
        dataset = make_dataset(TrainConfig(heads=heads, lights=lights, effects=effects))
        _ = dataset[0]  # opens the renderer
        started = time.perf_counter()
        images[effects] = dataset.images(range(heads))
        seconds = time.perf_counter() - started
        dataset.close()
        difference = float((images[effects] - images["all"]).square().mean().sqrt() * 255)
        milliseconds = 1e3 * seconds / heads / len(dataset.lights)
        rows.append(
            {
                "knob": "effects",
                "value": effects,
                "default": "yes" if effects == "auto" else "",
                "rmse": round(difference, 6),
                "image_ms": round(milliseconds, 1),
            }
        )
        print(rows[-1], flush=True)
    return rows


def poses(quick: bool) -> list[dict[str, object]]:
    """Other poses from three photographs: statistics of the thesis's 45 poses interpolated against rendering the pose
    that is asked for."""
    heads, people, height, width = (6, 2, 24, 21) if quick else (60, 4, 48, 42)
    targets = TARGETS[4:5] if quick else TARGETS
    config = TrainConfig(heads=heads, height=height, width=width, supersample=1, fit=DEFAULT_CONFIG.fit)
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        source = BootstrapViews(config, folder)
        held_out = BootstrapViews(replace(config, heads=people), folder, first=heads)
        inputs = torch.stack([held_out.images(view) for view in INPUTS], 1)
        truth = torch.stack([held_out.images(view) for view in targets], 1)
        for view in INPUTS:
            source.images(view)
        started = time.perf_counter()
        for view in targets:
            source.images(view)
        rendered = (time.perf_counter() - started) / len(targets)
        makers = {
            "on demand, whole-face": (lambda: ViewRelighter(source, min(40, heads - 2)), rendered),
            "on demand, per-pixel": (lambda: ViewRelighter(source, 0), rendered),
        }
        if not quick:
            makers["45 poses interpolated"] = (lambda: ViewRelighter(GridViews(source, 6.0), 0), 0.0)
        for name, (make, once) in makers.items():
            relighter = make()
            times, made = [], []
            for view in targets:
                started = time.perf_counter()
                made.append(relighter(inputs, INPUTS, view).mean)
                times.append(time.perf_counter() - started)
            error = (torch.stack(made, 1).clamp(0, 1) - truth.clamp(0, 1)).square().mean((2, 3)).sqrt().mean() * 255
            rows.append(
                {
                    "knob": "pose",
                    "value": name,
                    "default": "yes" if name == "on demand, whole-face" else "",
                    "rmse": round(float(error), 2),
                    "view_ms": round(1e3 * statistics.median(times) / people, 1),
                    "first_view_ms": round(1e3 * once, 0),
                }
            )
            print(rows[-1], flush=True)
    return rows
