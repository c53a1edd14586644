"""What simulating only the effects a scene calls for saves: work run and skipped, and time against the full simulation.

python scripts/measure/effects.py --heads 5 --lights 40
"""

import statistics
import time
from collections import Counter

import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.effects import EFFECTS
from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.config import DEFAULT_CONFIG
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import even_hemisphere


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=5)
    parser.add_argument("--lights", type=int, default=40)
    parser.add_argument("--supersample", type=int, default=DEFAULT_CONFIG.supersample)
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_num_threads(1)
    lights = even_hemisphere(args.lights)
    auto, full = (
        BootstrapDataset(
            MakeHumanHeads(1), args.heads, lights, DEFAULT_CONFIG.frame, effects=effects, supersample=args.supersample
        )
        for effects in ("auto", "all")
    )
    _ = auto[0], full[0]  # open the renderers
    ratios, seconds, largest = [], {"auto": 0.0, "all": 0.0}, 0.0
    work: Counter[str] = Counter()
    for head in range(args.heads):
        started = time.perf_counter()
        a = auto[head]
        middle = time.perf_counter()
        b = full[head]
        ended = time.perf_counter()
        ratios.append((middle - started) / (ended - middle))
        seconds["auto"] += middle - started
        seconds["all"] += ended - middle
        largest = max(largest, float((a.images - b.images).abs().max()))
        work.update(a.work)
    counted = ("passes run", "passes skipped", "pixels run", "pixels skipped")
    rows = [{"effect": effect, **{what: work[f"{effect} {what}"] for what in counted}} for effect in EFFECTS]
    print(markdown(rows))
    parser.save_rows(args.csv, rows)
    per_light = {name: 1000 * s / args.heads / args.lights for name, s in seconds.items()}
    print(
        f"\n{args.heads} heads x {args.lights} lights: {per_light['auto']:.1f} ms an image,"
        f" all effects {per_light['all']:.1f} ms, "
        f"median ratio {statistics.median(ratios):.2f}, largest difference of a pixel {largest:.1e}"
    )


if __name__ == "__main__":
    main()
