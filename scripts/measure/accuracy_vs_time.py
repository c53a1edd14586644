"""What accuracy costs in time: every knob of the package against error on held-out people, as tables and a plot.

python scripts/measure/accuracy_vs_time.py --output trade_off/ --csv [--data yaleb_192x168.npz]
python scripts/measure/accuracy_vs_time.py --output trade_off/ --from-csv scripts/results/accuracy_vs_time.csv

The first takes about half an hour on two cores (--quick: a smoke test); the second draws what it kept.

Each row changes one knob off the default. Error: RMSE in grey levels over held-out rendered heads (and, with --data,
seven people of Extended Yale B, statistics of the other 21), inputs lit from the front and from 70 degrees, twelve
output lights; *distance* is the RMSE between the row's images and those of the converged reference (rank 80, 48
functions over the lights, all heads). Slow settings are measured on fewer *people*, and left out of the plot. Time:
median of paired runs for one image and twelve lights, as a ratio to one product of an (8064, 64) with a (64, 64) matrix
in the same process, so that it carries to another machine. Memory: what the process needs on top while it relights, and
the statistics' buffers.
"""

import csv
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from facerelight.config import DEFAULT_CONFIG, QUALITIES, TrainConfig
from facerelight.evaluation.cost import paired, peak_memory_mb
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, markdown, read_rows
from facerelight.evaluation.trade_off import Table, draw_trade_off
from facerelight.geometry.lights import (
    angle_grid,
    even_hemisphere,
    hemisphere_quadrature,
    light_from_angles,
    nearest_lights,
)
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.mixture import draw_mixture, histogram_mode
from facerelight.recognition.exemplars import direct_subspace, light_moments, synthesize
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.photometric import make_normalizer
from facerelight.train.dataset import make_dataset
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter
from facerelight.viewpoint.regions import GroupRelighter, make_regions, random_groups
from facerelight.viewpoint.thesis import GridViews
from facerelight.viewpoint.views import LightViews

FIELDS = [
    "knob",
    "value",
    "default",
    "rmse_front",
    "rmse_side",
    "distance",
    "yale_front",
    "yale_side",
    "milliseconds",
    "ratio",
    "peak_mb",
    "statistics_mb",
    "people",
]
SOURCES = torch.stack((light_from_angles(0.0, 0.0), light_from_angles(70.0, 0.0)))
MORE_INPUTS = (5, 17, 40)  # further lights, for rows with several inputs
POSED = [View(-30.0), View(30.0), View()]  # three photographs of a person, as in 5.6.1
ASKED = [View(float(azimuth)) for azimuth in (-83, -52, -22, 0, 22, 52, 83)]  # off the thesis's grid

Relight = Callable[
    [torch.Tensor, int], torch.Tensor
]  # all images of a person (J, H, W) and the source's index -> targets (Q, H, W)
Maker = Callable[["World"], tuple[Relight, FaceStatistics]]


class World:
    """People under J lights: a bootstrap and strangers; which lights are the sources and the targets; whether faces
    need registration."""

    def __init__(
        self,
        images: torch.Tensor,
        lights: torch.Tensor,
        valid: torch.Tensor,
        strangers: torch.Tensor,
        there: torch.Tensor,
        register: bool = False,
    ) -> None:
        self.register = register
        self.images, self.lights, self.valid, self.strangers, self.there = images, lights, valid, strangers, there
        self.sources = nearest_lights(SOURCES, lights).tolist()
        self.targets = nearest_lights(even_hemisphere(12), lights)

    def fit(self, options: FitOptions, heads: int | None = None, every: int = 1) -> FaceStatistics:
        return FaceStatistics.fit(
            self.images[:heads, ::every], self.lights[::every], self.valid[:heads, ::every], options
        )

    def relit(self, relight: Relight, people: int | None = None) -> list[list[torch.Tensor]]:
        """By source and person, ``(12, H, W)``."""
        return [[relight(person, source) for person in self.strangers[:people]] for source in self.sources]

    def errors(self, made: list[list[torch.Tensor]]) -> list[float]:
        """Mean RMSE in grey levels for each source."""
        result = []
        for source, images in zip(self.sources, made, strict=True):
            found = []
            for image, person, there in zip(images, self.strangers, self.there, strict=False):
                kept = there[self.targets] & (self.targets != source)
                if there[source]:
                    found.append(rmse(image[kept], person[self.targets[kept]]))
            result.append(statistics.mean(found))
        return result


def rmse(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a.clamp(0, 1) - b.clamp(0, 1)).square().mean((1, 2)).sqrt().mean() * 255)


def rendered_world(heads: int, people: int, height: int, width: int) -> World:
    lights = torch.cat((SOURCES, even_hemisphere(12)[1:], even_hemisphere(DEFAULT_CONFIG.directions().shape[0])[1:]))
    dataset = make_dataset(
        TrainConfig(heads=heads + people, height=height, width=width, margin=0.0, supersample=1), lights
    )
    images = dataset.images(tqdm(range(heads + people), desc="rendering heads"))
    there = torch.ones(images.shape[:2], dtype=torch.bool)
    return World(images[:heads], lights, there[:heads], images[heads:], there[heads:])


def yale_world(path: Path, height: int, width: int) -> World:
    faces = load_yale(path, height, width)
    images, valid = to_grid(faces)
    out = torch.arange(len(images)) % 4 == 0
    aligned = align_people(images[~out], faces.lights, valid[~out])
    return World(aligned, faces.lights, valid[~out], images[out], valid[out], register=True)


class Bench:
    """The worlds, the reference operation and images, and the rows so far."""

    def __init__(self, worlds: dict[str, World], repeats: int) -> None:
        self.worlds, self.repeats = worlds, repeats
        pixels = worlds["heads"].images[0, 0].numel()
        a, b = torch.rand(pixels, 64), torch.rand(64, 64)
        self.product = lambda: a @ b
        self.rows: list[dict] = []
        heads = worlds["heads"]
        reference, _ = by_model(replace(DEFAULT_CONFIG.fit, face_rank=80, basis=48))(heads)
        self.reference = heads.relit(reference)

    def add(
        self, knob: str, value: object, default: bool, make: Maker, people: int | None = None, yale: bool = True
    ) -> None:
        """Measure one setting."""
        heads = self.worlds["heads"]
        relight, learned = make(heads)
        made = heads.relit(relight, people)
        errors = heads.errors(made)
        distance = statistics.mean(
            rmse(a, b) for x, y in zip(made, self.reference, strict=True) for a, b in zip(x, y, strict=False)
        )
        person = heads.strangers[0]

        def once() -> None:
            relight(person, heads.sources[1])

        cost = paired(once, self.product, self.repeats, bares=20)
        row = dict.fromkeys(FIELDS, "") | {
            "knob": knob,
            "value": value,
            "default": "yes" if default else "",
            "rmse_front": round(errors[0], 2),
            "rmse_side": round(errors[1], 2),
            "distance": round(distance, 2),
            "milliseconds": round(1e3 * cost.ours, 1),
            "ratio": round(cost.ratio, 1),
            "peak_mb": round(peak_memory_mb(once), 1),
            "people": len(heads.strangers[:people]),
            "statistics_mb": round(
                sum(buffer.numel() * buffer.element_size() for buffer in learned.buffers()) / 1e6, 1
            ),
        }
        if yale and "yale" in self.worlds:
            world = self.worlds["yale"]
            front, side = world.errors(world.relit(make(world)[0], people))
            row |= {"yale_front": round(front, 2), "yale_side": round(side, 2)}
        self.rows.append(row)
        print(row, flush=True)


def by_model(
    options: FitOptions,
    model: str = "face",
    heads: int | None = None,
    every: int = 1,
    dtype: torch.dtype = torch.float32,
    inputs: int = 1,
    variance: bool = False,
    method: str = "expected",
) -> Maker:
    """Relighting with known lights."""

    def make(world: World) -> tuple[Relight, FaceStatistics]:
        learned = world.fit(options, heads, every)
        relighter = StatisticalRelighter(learned, model).to(dtype)
        targets = world.lights[world.targets].to(dtype)

        def relight(person: torch.Tensor, source: int) -> torch.Tensor:
            chosen = [source, *MORE_INPUTS[: inputs - 1]]
            images, lights = person[chosen][None].to(dtype), world.lights[chosen].to(dtype)
            if method == "mle":
                return relighter(images, targets, lights, "mle").mean[0]
            posterior = relighter.condition(images, lights, register=world.register)
            if variance:
                posterior.variance(targets)
            return posterior.mean(targets)[0]

        return relight, learned

    return make


def by_estimate(finder: str, draws: int, how: str = "mean", independent: bool = False, people: int = 60) -> Maker:
    """Relighting with unknown lights; ``how``: "mean", "exact" mode or the thesis's "histogram" mode."""

    def make(world: World) -> tuple[Relight, FaceStatistics]:
        learned = world.fit(DEFAULT_CONFIG.fit)
        if finder == "kernel":
            estimator = KernelIlluminationEstimator.fit(world.images[:people], world.lights, world.valid[:people])
        else:
            estimator = LikelihoodIlluminationEstimator(learned)
        relighter = StatisticalRelighter(learned, "face", estimator)
        targets = world.lights[world.targets]

        def relight(person: torch.Tensor, source: int) -> torch.Tensor:
            image = person[None, source : source + 1]
            generator = torch.Generator().manual_seed(0)
            posterior = relighter.condition(
                image, estimator.sample(image, draws, generator, independent), register=world.register
            )
            if how == "mean":
                return posterior.mean(targets)[0]
            if how == "exact":
                return posterior.mode(targets)[0]
            parts = [posterior.people[0].components(target) for target in targets]
            modes = [histogram_mode(draw_mixture(part.mean, part.variance, 32, generator)) for part in parts]
            return torch.stack(modes).unflatten(1, image.shape[2:]).float()

        return relight, learned

    return make


def by_groups(size: int) -> Maker:
    """Random groups of pixels (5.1)."""

    def make(world: World) -> tuple[Relight, FaceStatistics]:
        learned = world.fit(replace(DEFAULT_CONFIG.fit, face_rank=0, rank=2, brightness=False))
        pixels = world.images[0, 0].numel()
        groups = random_groups(pixels, size, torch.Generator().manual_seed(0))
        relighter = GroupRelighter(LightViews(learned), make_regions(groups))

        def relight(person: torch.Tensor, source: int) -> torch.Tensor:
            image, light = person[None, source : source + 1], world.lights[source : source + 1]
            return torch.stack([relighter(image, light, target).mean[0] for target in world.lights[world.targets]])

        return relight, learned

    return make


def by_resolution(scale: float) -> Maker:
    """The model at a coarser resolution, its images enlarged to the full one."""

    def make(world: World) -> tuple[Relight, FaceStatistics]:
        size = world.images.shape[2:]
        small = (round(size[0] * scale), round(size[1] * scale))
        coarse = torch.nn.functional.interpolate(world.images, small, mode="area")
        learned = FaceStatistics.fit(
            coarse,
            world.lights,
            world.valid,
            replace(DEFAULT_CONFIG.fit, temper=max(1.0, DEFAULT_CONFIG.fit.temper * scale**2)),
        )
        relighter = StatisticalRelighter(learned, "face")

        def relight(person: torch.Tensor, source: int) -> torch.Tensor:
            image = torch.nn.functional.interpolate(person[None, source : source + 1], small, mode="area")
            made = relighter.condition(image, world.lights[source : source + 1], register=world.register)
            made = made.mean(world.lights[world.targets])
            return torch.nn.functional.interpolate(made, size, mode="bicubic", antialias=False)[0]

        return relight, learned

    return make


def relighting(bench: Bench, quick: bool) -> None:
    default = DEFAULT_CONFIG.fit
    bench.add("model", "whole-face", True, by_model(default))
    bench.add("model", "per-pixel", False, by_model(default, "pixel"))
    bench.add("variance", "with the means", False, by_model(default, variance=True))
    if quick:
        return
    heads = len(bench.worlds["heads"].images)
    for rank in (5, 10, 20, 40, 80):
        bench.add(
            "whole-face rank",
            rank,
            rank == default.face_rank,
            by_model(replace(default, face_rank=rank)),
            yale=rank <= 20,
        )
    for rank in (4, 8, 12, 24):
        bench.add("correlation rank", rank, rank == default.rank, by_model(replace(default, rank=rank)))
    for basis in (8, 16, 24, 48):
        bench.add("functions over lights", basis, basis == default.basis, by_model(replace(default, basis=basis)))
    for temper in (1.0, 10.0, 100.0, 1000.0):
        bench.add("temper", temper, temper == default.temper, by_model(replace(default, temper=temper)))
    for count in (20, 40, 80, heads):
        bench.add("heads", count, count == DEFAULT_CONFIG.heads, by_model(default, heads=count), yale=False)
    for every in (4, 2, 1):
        bench.add(
            "lights",
            -(-len(bench.worlds["heads"].lights) // every),
            every == 1,
            by_model(default, every=every),
            yale=False,
        )
    for name, config in QUALITIES.items():  # at one resolution; their own are 96 x 84, 128 x 112 and 192 x 168
        every = max(1, 64 // config.directions().shape[0])
        bench.add(
            "quality",
            name,
            name == "standard",
            by_model(config.fit, heads=min(config.heads, heads), every=every),
            yale=False,
        )
    for scale in (0.25, 0.5, 0.75, 1.0):
        bench.add("resolution", f"{scale:g} of 96 x 84", False, by_resolution(scale))
    bench.add("unknown gain", "yes", True, by_model(default))
    bench.add("unknown gain", "no", False, by_model(replace(default, brightness=False)))
    bench.add("dtype", "float32", True, by_model(default))
    bench.add("dtype", "float64", False, by_model(default, dtype=torch.float64), yale=False)
    for inputs in (1, 2, 4):
        bench.add("input images", inputs, inputs == 1, by_model(default, inputs=inputs), yale=False)
    bench.add("input images", "4, MLE (fixed n)", False, by_model(default, "pixel", inputs=4, method="mle"), yale=False)
    for size in (1, 5, 30):
        bench.add("pixels a group", size, False, by_groups(size), people=2, yale=False)
    for people in (10, 60):
        bench.add(
            "light unknown",
            f"kernel, {people * len(bench.worlds['heads'].lights):,} prototypes",
            False,
            by_estimate("kernel", 8, people=people),
            yale=False,
        )
    for draws in (1, 8, 32, 128):
        bench.add(
            "light unknown",
            f"likelihood, {draws} draws",
            draws == 32,
            by_estimate("likelihood", draws),
            people=4,
            yale=draws == 8,
        )
    bench.add(
        "light unknown",
        "likelihood, 32 independent draws",
        False,
        by_estimate("likelihood", 32, independent=True),
        people=4,
        yale=False,
    )
    bench.add(
        "light unknown",
        "most probable image, exact, 32 draws",
        False,
        by_estimate("likelihood", 32, "exact"),
        people=2,
        yale=False,
    )
    bench.add(
        "light unknown",
        "most probable image, histogram, 32 draws",
        False,
        by_estimate("likelihood", 32, "histogram"),
        people=2,
        yale=False,
    )


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
    targets = ASKED[4:5] if quick else ASKED
    config = TrainConfig(heads=heads, height=height, width=width, supersample=1, fit=DEFAULT_CONFIG.fit)
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as folder:
        source = BootstrapViews(config, folder)
        held_out = BootstrapViews(replace(config, heads=people), folder, first=heads)
        inputs = torch.stack([held_out.images(view) for view in POSED], 1)
        truth = torch.stack([held_out.images(view) for view in targets], 1)
        for view in POSED:
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
                made.append(relighter(inputs, POSED, view).mean)
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


def save(tables: dict[str, list[dict]], folder: Path) -> None:
    """A CSV and a Markdown table each, and the plot."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        with (folder / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        (folder / f"{name}.md").write_text(markdown(rows, bold="value") + "\n")
    relit = Table(
        "Relighting",
        tables["relighting"],
        error=("rmse_side", "RMSE from a side-lit input,\ngrey levels", "RMSE"),
        cost=("milliseconds", "milliseconds for one image and twelve lights"),
        apart=("input images", "light unknown"),
    )
    known = Table(
        "Recognition",
        tables["recognition"],
        error=("error", "rank-1 errors, percent", "percent wrong"),
        cost=("enrol_ms", "milliseconds to enrol a person"),
    )
    draw_trade_off([relit, known], folder / "trade_off.png")


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--output", type=Path, required=True, help="folder for tables and plot")
    parser.add_faces(required=False)
    parser.add_argument("--quick", action="store_true", help="a smoke test")
    parser.add_argument("--from-csv", type=Path, default=None, help="measure nothing: tables and plot of what was kept")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    if args.from_csv:
        tables = kept(args.from_csv)
    else:
        tables = measured(args.data, args.quick)
        parser.save_rows(args.csv, [{"table": name, **row} for name, rows in tables.items() for row in rows])
    save(tables, args.output)


def kept(path: Path) -> dict[str, list[dict]]:
    """The tables that ``--csv`` wrote into one file; of each the columns that it fills."""
    tables: dict[str, list[dict]] = {}
    for row in read_rows(path):
        tables.setdefault(row.pop("table"), []).append(row)
    for name, rows in tables.items():
        columns = [column for column in rows[0] if column == "default" or any(row[column] for row in rows)]
        tables[name] = [{column: row[column] for column in columns} for row in rows]
    return tables


def measured(data: Path | None, quick: bool) -> dict[str, list[dict]]:
    """The tables, by name."""
    height, width = (24, 21) if quick else (96, 84)
    worlds = {"heads": rendered_world(10, 2, height, width) if quick else rendered_world(160, 30, height, width)}
    gallery = worlds["heads"].strangers
    worlds["heads"].strangers = gallery[:10]
    if data:
        worlds["yale"] = yale_world(data, height, width)
    bench = Bench(worlds, 3 if quick else 7)
    relighting(bench, quick)
    heads = worlds["heads"]
    return {
        "relighting": bench.rows,
        "recognition": recognition(heads.fit(DEFAULT_CONFIG.fit), gallery, heads.lights, heads.targets, quick),
        "rendering": rendering(2 if quick else 3, 4 if quick else 20),
        "poses": poses(quick),
    }


if __name__ == "__main__":
    main()
