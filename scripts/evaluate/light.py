"""Where a photo's light comes from: kernel regression, the model's own likelihood, and amounts of many lights.

python scripts/evaluate/light.py --data yaleb_192x168.npz --pie pie10_55x44.npz --csv
python scripts/evaluate/light.py --data yaleb_192x168.npz --domain domain.json --only-rig --csv light_rig.csv

Angle between estimate and label, in degrees, and how many percent of the labels lie inside the circle about the
estimate that holds 90 % of the estimator's samples. Yale: four folds, statistics of the other 21 people. PIE:
statistics of Yale, labels are the data's own estimates. Heads: 20 held-out rendered heads under 64 lights, statistics
of 100 others. Kernel regression with the package's widths (0.2 % of the images within one) and with the thesis's (a
tenth). The likelihood's temper is left at its default. An estimate of amounts is judged by its middle.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from facerelight.bootstrap.domain import Domain
from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import FaceImages, load_pie, load_yale, to_grid
from facerelight.evaluation.recognition import pie_as_canonical
from facerelight.evaluation.results import ScriptParser, found_domains, markdown
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import angle_pairs, angular_distance
from facerelight.light.amounts import SoftLightEstimator
from facerelight.light.estimator import LightEstimator
from facerelight.light.kernel import KernelIlluminationEstimator
from facerelight.light.likelihood import LikelihoodIlluminationEstimator
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

DRAWS = 64
WIDE = 0.1  # of the images within one width of each: the thesis's (4.4)
KERNEL, WIDER, LIKELIHOOD = "kernel regression on images", "the same, the thesis's widths", "likelihood under the model"
AMOUNTS = "amounts of many lights"


class Errors:
    """Angles, coverage and time of each estimator, over everything added."""

    def __init__(self, every: int) -> None:
        self.every = every
        self.angle: dict[str, list[torch.Tensor]] = {}
        self.inside: dict[str, list[torch.Tensor]] = {}
        self.seconds: dict[str, float] = {}

    def add(self, name: str, estimator: LightEstimator, images: torch.Tensor, truth: torch.Tensor) -> None:
        """``images (M, H, W)`` with lights ``truth (M, 3)``."""
        images, truth = images[:: self.every], truth[:: self.every]
        started = time.perf_counter()
        found = estimator(images[:, None]).direction[:, 0]
        self.seconds[name] = (time.perf_counter() - started) / len(images)
        drawn = estimator.sample(images[:, None], DRAWS)[:, :, 0]
        angle = angular_distance(found, truth)
        radius = angular_distance(drawn, found[:, None].expand_as(drawn)).quantile(0.9, dim=1)
        self.angle.setdefault(name, []).append(angle)
        self.inside.setdefault(name, []).append((angle <= radius).float())

    def row(self, name: str, people: str) -> dict[str, object]:
        """The figures of one estimator, as cells of a table: of these ``people`` the median and mean angle, and the
        percentage inside."""
        angles, inside = torch.cat(self.angle[name]), torch.cat(self.inside[name])
        return {
            f"{people}: angle": f"{float(angles.median()):.1f}, {float(angles.mean()):.1f}",
            f"{people}: in 90 %": round(100 * float(inside.mean())),
        }


def estimators(
    images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor | None, face_rank: int
) -> dict[str, LightEstimator]:
    """All, learned from the same people; photographs brought into step for the likelihood."""
    aligned = images if valid is None else align_people(images, lights, valid)
    statistics = FaceStatistics.fit(aligned, lights, valid, FitOptions(face_rank=face_rank, brightness=True))
    return {
        KERNEL: KernelIlluminationEstimator.fit(images, lights, valid),
        WIDER: KernelIlluminationEstimator.fit(images, lights, valid, fraction=WIDE),
        LIKELIHOOD: LikelihoodIlluminationEstimator(statistics),
        AMOUNTS: SoftLightEstimator(statistics),
    }


def on_heads(config: TrainConfig, every: int) -> tuple[dict[str, LightEstimator], Errors]:
    """Estimators by 100 rendered heads, and their errors on 20 others."""
    heads, lights, errors = (
        make_dataset(config).images(tqdm(range(120), desc="rendering heads")),
        config.directions(),
        Errors(every),
    )
    made = estimators(heads[:100], lights, None, 40)
    for name, estimator in made.items():
        errors.add(name, estimator, heads[100:].flatten(0, 1), lights.repeat(20, 1))
    return made, errors


def on_yale(faces: FaceImages, every: int) -> Errors:
    """Four folds, by the photographs of the other people."""
    (images, valid), errors = to_grid(faces), Errors(every)
    for fold in range(4):
        out = torch.arange(len(images)) % 4 == fold
        truth = faces.lights.expand(int(out.sum()), -1, -1)[valid[out]]
        for name, estimator in estimators(images[~out], faces.lights, valid[~out], 18).items():
            errors.add(name, estimator, images[out][valid[out]], truth)
    return errors


def by_heads(faces: FaceImages, made: Mapping[str, LightEstimator], every: int) -> Errors:
    """All photographs, by estimators of rendered heads."""
    (images, valid), errors = to_grid(faces), Errors(every)
    for name, estimator in made.items():
        errors.add(name, estimator, images[valid], faces.lights.expand(len(images), -1, -1)[valid])
    return errors


def by_rigs_heads(faces: FaceImages, domains: Sequence[Domain], config: TrainConfig, every: int) -> Errors:
    """Photographs of every n-th person by heads under the rig's own lights and lamps, as they were found to be on the
    other people; ``domains`` has n."""
    (images, valid), errors = to_grid(faces), Errors(every)
    for fold, domain in enumerate(domains):
        rig = replace(config, heads=100, lights=angle_pairs(faces.lights), domain=domain)
        out = torch.arange(len(images)) % len(domains) == fold
        truth = faces.lights.expand(int(out.sum()), -1, -1)[valid[out]]
        heads = make_dataset(rig).images(tqdm(range(100), desc="rendering heads"))
        for name, estimator in estimators(heads, faces.lights, None, 40).items():
            errors.add(name, estimator, images[out][valid[out]], truth)
    return errors


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--pie", type=Path, default=None)
    parser.add_domain()
    parser.add_argument("--only-rig", action="store_true", help="with --domain: heads under the rig's lamps alone")
    parser.add_size(96, 84)
    parser.add_argument("--every", type=int, default=1, help="take one photo in so many")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    config = TrainConfig(heads=120, height=args.height, width=args.width, margin=0.0, supersample=1)
    results: dict[str, Errors] = {}
    if args.only_rig and not args.domain:
        parser.error("--only-rig: expected a --domain beside it")
    if not args.only_rig:
        made, results["heads"] = on_heads(config, args.every)
        results |= {"Yale B": on_yale(faces, args.every), "Yale B by heads": by_heads(faces, made, args.every)}
    if args.domain:
        results["Yale B by the rig's heads"] = by_rigs_heads(faces, found_domains(args.domain), config, args.every)
    if args.pie and not args.only_rig:
        (images, valid), errors = to_grid(faces), Errors(args.every)
        pie = pie_as_canonical(load_pie(args.pie), CropFrame(args.height, args.width))
        for name, estimator in estimators(images, faces.lights, valid, 18).items():
            errors.add(name, estimator, pie.images, pie.lights[pie.light])
        results["PIE"] = errors
    rows: list[dict[str, object]] = []
    for name in (KERNEL, WIDER, LIKELIHOOD, AMOUNTS):
        cells = [errors.row(name, people) for people, errors in results.items()]
        rows.append({"row": name} | {key: value for part in cells for key, value in part.items()})
        rows[-1]["ms an image"] = round(1e3 * next(iter(results.values())).seconds[name], 1)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
