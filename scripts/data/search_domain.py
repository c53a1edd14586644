"""Find the rendered world's scalar settings on the training side of each fold of Extended Yale B: a coordinate search.

For every candidate all people are relit from a frontal and from a side-lit image, fine detail kept. A fold sees the
errors of its training people alone (with two folds, of every second person), and walks from even lamps to the best
value of one setting after another, twice through. "all" does the same with everybody, for use on other data.

Heads are rendered once for every way of standing and painting; lamps and fill light are factors of what was rendered.

python scripts/data/search_domain.py --data yaleb_192x168.npz --json domain.json
"""

import json
import multiprocessing
from dataclasses import asdict, replace
from functools import cache

import torch
from torch import Tensor

from facerelight.bootstrap.domain import Domain, lamp_strength
from facerelight.config import TrainConfig
from facerelight.evaluation import relighting_errors
from facerelight.evaluation.datasets import FaceImages, load_yale
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import angle_pairs
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

DETAIL = 0.5
START = Domain()
KNOBS: dict[str, tuple[float, ...]] = {
    "side_light": (0.0, 0.2, 0.3, 0.4),
    "top_light": (0.0, 0.1, 0.15, 0.2),
    "fill": (0.0, 0.01, 0.02),
    "pitch": (-4.0, 0.0, 4.0),
    "misalign": (0.05, 0.07, 0.09),
    "turn": (4.0, 6.0, 8.0),
    "texture": (0.03, 0.05, 0.08),
}
UNIT_FILL = 0.01


def render(task: tuple[TrainConfig, int, int]) -> Tensor:
    """Heads ``first`` to ``last`` of a config, ``(N, J, H, W)``."""
    config, first, last = task
    torch.set_num_threads(1)
    return make_dataset(config).images(range(first, last))


class Search:
    """Errors of every candidate, each once."""

    def __init__(self, faces: FaceImages, source: str, heads: int, height: int, width: int) -> None:
        self.faces = faces
        angles = angle_pairs(faces.lights)
        self.config = TrainConfig(heads, source, lights=angles, height=height, width=width, margin=0.0)
        self.pool = multiprocessing.get_context("spawn").Pool(2)
        self.parts, self.error = cache(self._parts), cache(self._error)
        self.evaluated = 0

    def _parts(self, domain: Domain) -> tuple[Tensor, Tensor]:
        """Of a world with even lamps and without fill: images ``(N, J, H, W)``, and what unit fill light adds to all of
        them ``(N, 1, H, W)``."""
        dark = replace(self.config, domain=domain)
        filled = replace(
            self.config,
            domain=replace(domain, fill=UNIT_FILL),
            lights=self.config.lights[:4],  # type: ignore[index]
        )
        half = dark.heads // 2
        tasks = [(config, *part) for config in (dark, filled) for part in ((0, half), (half, dark.heads))]
        *images, first, last = self.pool.map(render, tasks, 1)
        lit = torch.cat(images)
        return lit, (torch.cat((first, last)) - lit[:, :4]).mean(1, keepdim=True)

    def images(self, domain: Domain) -> Tensor:
        """What ``domain`` looks like, ``(N, J, H, W)``."""
        lit, fill = self.parts(replace(domain, side_light=0.0, top_light=0.0, fill=0.0))
        y, z = self.faces.lights[:, 1], self.faces.lights[:, 2]
        lamps = lamp_strength(y, z, domain.side_light, domain.top_light)
        return lamps[:, None, None] * lit + domain.fill / UNIT_FILL * fill

    def _error(self, domain: Domain) -> Tensor:
        """RMSE in grey levels by person, mean of the frontal and the side-lit input, ``(people,)``."""
        statistics = FaceStatistics.fit(self.images(domain), self.faces.lights, None, face_rank=20, brightness=True)
        errors = torch.stack(
            [relighting_errors(statistics, self.faces, case, DETAIL).nanmean(1) for case in ("front", "side")]
        )
        self.evaluated += 1
        print(f"{errors.nanmean(1)[0]:.2f} front {errors.nanmean(1)[1]:.2f} side  {domain}", flush=True)
        return errors.mean(0)

    def walk(self, people: list[int]) -> Domain:
        """The best value of one setting after another, twice through, by the errors of ``people``."""
        best = START
        for name, values in 2 * list(KNOBS.items()):
            tried = [replace(best, **{name: value}) for value in values]
            best = min(tried, key=lambda domain: float(self.error(domain)[people].nanmean()))
        return best


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--source", default="ict", help="of the heads: ict, makehuman, or a path")
    parser.add_argument("--folds", type=int, default=2)
    parser.add_argument("--heads", type=int, default=40)
    parser.add_size(48, 42)
    parser.add_results("json")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    search = Search(faces, args.source, args.heads, args.height, args.width)
    everybody = list(range(len(faces.names)))
    found = {
        "folds": [asdict(search.walk([i for i in everybody if i % args.folds != fold])) for fold in range(args.folds)],
        "all": asdict(search.walk(everybody)),
        "evaluated": search.evaluated,
    }
    print(json.dumps(found, indent=2))
    parser.save_report(args.json, found)


if __name__ == "__main__":
    main()
