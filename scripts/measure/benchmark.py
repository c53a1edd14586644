"""Speed where it counts, as ratios to operations that cannot be avoided, all in one process on two threads.

python scripts/measure/benchmark.py --json benchmark.json
python scripts/measure/benchmark.py --compare before.json after.json

Sizes: 100 x 100 pixels, 101 lights, whole-face rank 40. Medians of paired runs; the bare operation and ours alternate.
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch

from facerelight.evaluation.cost import paired
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import even_hemisphere
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.model.statistics import FaceStatistics
from facerelight.recognition.pca import IndividualPCAClassifier
from facerelight.recognition.subspaces import Subspace


def seconds(code: str, repeats: int = 5) -> float:
    """Least wall-clock seconds of a fresh interpreter running ``code``."""
    taken = []
    for _ in range(repeats):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
        taken.append(time.perf_counter() - started)
    return min(taken)


def made_statistics(
    people: int = 48, lights: int = 101, size: int = 100
) -> tuple[FaceStatistics, torch.Tensor, torch.Tensor]:
    """Statistics of smooth random faces: their values do not matter for the time."""
    directions = even_hemisphere(lights)
    generator = torch.Generator().manual_seed(0)
    small = torch.rand(people, 4, 13, 13, generator=generator)
    fields = torch.nn.functional.interpolate(small, (size, size), mode="bicubic").clamp(0, 1)
    normal = torch.nn.functional.normalize(torch.cat((fields[:, :2] - 0.5, torch.ones_like(fields[:, :1])), 1), dim=1)
    images = torch.einsum("ncyx,jc->njyx", normal, directions).clamp_min(0) * (0.3 + 0.5 * fields[:, 3:])
    return FaceStatistics.fit(images, directions, rank=12, face_rank=40), images, directions


def measure() -> dict[str, float]:
    torch.set_num_threads(2)
    learned, images, lights = made_statistics()
    results: dict[str, float] = {}
    person = images[:1, 40:41]
    targets = even_hemisphere(900)
    for name in ("pixel", "face"):
        relighter = StatisticalRelighter(learned, name)
        results[f"condition_render_one_{name}_seconds"] = paired(
            lambda r=relighter: r.condition(person, lights[40:41]).mean(targets[:1]), lambda: None
        )[0]
    results["face_over_pixel"] = (
        results["condition_render_one_face_seconds"] / results["condition_render_one_pixel_seconds"]
    )
    maps = [torch.rand(101, 10_000) for _ in range(3)]
    n_map, weights = torch.rand(3, 10_000), learned.weights(targets)

    def four_products() -> torch.Tensor:  # W mu_v, W sigma_v, W b, S n of 4.3
        weights @ maps[0], weights @ maps[1], weights @ maps[2]
        return targets @ n_map

    for name, suffix in (("face", "_face"), ("pixel", "")):
        posterior = StatisticalRelighter(learned, name).condition(person, lights[40:41])
        mine, bare, ratio = paired(lambda p=posterior: p.mean(targets), four_products)
        results |= {
            f"render_900{suffix}_seconds": mine,
            f"render_900{suffix}_over_gemm": ratio,
            "gemm_900_seconds": bare,
        }
    results["variance_of_one_light_seconds"] = paired(lambda: posterior.variance(targets[:1]), lambda: None)[0]
    prototypes = torch.nn.functional.normalize(torch.rand(10_000, 24 * 21), dim=1)
    directions = torch.nn.functional.normalize(torch.randn(10_000, 3), dim=1)
    estimator = KernelIlluminationEstimator(
        prototypes, directions, torch.full((10_000,), 0.2), torch.zeros(3), torch.zeros(3, 3), torch.ones(24, 21)
    )
    plain = torch.rand(10_000, 10_000)  # every prototype at 100 x 100, as the thesis compares them
    image = person.flatten()
    mine, bare, ratio = paired(lambda: estimator(person), lambda: plain @ image, 25)
    results |= {"estimate_seconds": mine, "estimate_over_gemm": ratio}
    thumbnail = prototypes[0][None]
    results["estimate_over_thumbnail_gemm"] = paired(lambda: estimator(person), lambda: thumbnail @ prototypes.T, 25)[2]
    results |= photo(learned) | recognition()
    deps = seconds("import torch, kornia, cv2, PIL.Image, safetensors")
    results["import_seconds_over_deps"] = (
        seconds("import torch, kornia, cv2, PIL.Image, safetensors, facerelight") - deps
    )
    results["import_seconds_over_torch_kornia"] = seconds("import torch, kornia, facerelight") - seconds(
        "import torch, kornia"
    )
    return results


def recognition(people: int = 1000, pixels: int = 100, dimension: int = 40) -> dict[str, float]:
    """One probe against the subspaces of many people, over the product of the probe with all of their bases side by
    side."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.linalg.qr(torch.randn(pixels**2, dimension, generator=generator)).Q
    spaces = [Subspace(torch.zeros(pixels**2), directions.roll(i, 0), torch.ones(dimension)) for i in range(people)]
    classifier = IndividualPCAClassifier().fit_subspaces(spaces, list(range(people)))
    side_by_side = classifier.bases.permute(1, 0, 2).reshape(pixels**2, people * dimension).contiguous()
    probe = torch.rand(1, pixels, pixels, generator=generator)
    row = probe.flatten(1)
    mine, _, ratio = paired(lambda: classifier.decision_function(probe), lambda: row @ side_by_side)
    return {
        "recognize_1000_seconds": mine,
        "recognize_1000_over_gemm": ratio,
        "recognize_1000_mb": classifier.bases.numel() * 4 / 1e6,
    }


def photo(learned: FaceStatistics) -> dict[str, float]:
    """A 512 x 512 colour photo end to end (landmarks given), and loading the default statistics."""
    from facerelight.config import TrainConfig
    from facerelight.photo import PhotoRelighter
    from facerelight.train.run import trained_folder

    folder = trained_folder(TrainConfig())
    loading = paired(lambda: StatisticalRelighter.from_pretrained(folder), lambda: None)[0]
    relighter = StatisticalRelighter.from_pretrained(folder)
    picture = np.random.default_rng(0).integers(0, 256, (512, 512, 3)).astype(np.uint8)
    marks = ((202.0, 201.0), (307.0, 203.0), (256.0, 304.0))
    whole = paired(lambda: PhotoRelighter(picture, marks, relighter).render(40, 10), lambda: None, 7)[0]
    session = PhotoRelighter(picture, marks, relighter)
    return {
        "load_statistics_seconds": loading,
        "photo_512_seconds": whole,
        "photo_512_next_light_seconds": paired(lambda: session.render(40, 10), lambda: None, 7)[0],
    }


def compare(before: Path, after: Path) -> None:
    """A table of two runs, of two commits say."""
    old, new = (json.loads(path.read_text()) for path in (before, after))
    shared = sorted(set(old) & set(new) - {"made"})
    rows = [
        {"": name, "before": f"{old[name]:.4g}", "after": f"{new[name]:.4g}", "ratio": f"{new[name] / old[name]:.2f}"}
        for name in shared
    ]
    print(markdown(rows))


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_results("json")
    parser.add_argument("--compare", type=Path, nargs=2, metavar=("BEFORE", "AFTER"), default=None)
    args = parser.parse_args()
    if args.compare:
        compare(*args.compare)
        return
    results = measure()
    for name, value in results.items():
        print(f"{name}: {value:.4g}")
    parser.save_report(args.json, results)


if __name__ == "__main__":
    main()
