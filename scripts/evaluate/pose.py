"""Other poses: statistics rendered on demand at exactly the pose asked for, against the thesis's interpolation over its
45 poses (5.6).

python scripts/evaluate/pose.py --csv --picture pose.png

Inputs are three images of a held-out head (30 degrees left, 30 right, frontal), outputs lie off the thesis's grid of
poses; the light is frontal and known throughout, as in 5.6.1. Also answers the question of section 7.3: does n vary
more over poses or over people?
"""

import tempfile
from dataclasses import replace

import torch
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.evaluation.visualize import contact_sheet
from facerelight.geometry.lights import light_from_angles
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter
from facerelight.viewpoint.thesis import POSES, GridViews

INPUTS = [View(-30.0), View(30.0), View()]
TARGETS = [View(float(a)) for a in (-83, -52, -22, 0, 22, 52, 83)]
LIGHTS = [(0.0, 0.0), (40.0, 0.0), (-40.0, 0.0), (0.0, 40.0)]  # the thesis learned n from four lights a pose
WIDTHS = (4.0, 6.0, 8.0, 10.0, 13.0)  # degrees


def variation_of_n(source: BootstrapViews, people: int) -> tuple[float, float]:
    """Mean square change of n between poses (of the average person), and between people (at a pose), over pixels and
    components."""
    few = BootstrapViews(replace(source.config, heads=people), source.folder)
    solver = torch.linalg.pinv(torch.stack([light_from_angles(*light) for light in LIGHTS]))
    n = []
    for view in tqdm(POSES[1::3], desc="n over poses and people"):
        images = torch.stack([few.images(replace(view, light=light)).flatten(1) for light in LIGHTS], 1)  # (N, 4, P)
        n.append(solver @ images)
    n = torch.stack(n)  # (poses, N, 3, P)
    return float(n.mean(1).var(0).mean()), float(n.var(1).mean())


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=100)
    parser.add_argument("--people", type=int, default=8, help="held-out heads")
    parser.add_size(64, 56)
    parser.add_argument("--cache", default=None, help="folder for rendered views (default: a temporary one)")
    parser.add_results("csv")
    parser.add_argument("--picture", default=None)
    args = parser.parse_args()
    config = TrainConfig(heads=args.heads, height=args.height, width=args.width, supersample=1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.cache or temporary
        source = BootstrapViews(config, folder)
        held_out = BootstrapViews(replace(config, heads=args.people), folder, first=args.heads)
        inputs = torch.stack([held_out.images(view) for view in INPUTS], 1)
        truth = torch.stack([held_out.images(view) for view in TARGETS], 1)
        mean_face = torch.stack([source.images(view).mean(0) for view in TARGETS])

        def error(relighter: ViewRelighter) -> tuple[float, torch.Tensor]:
            made = torch.stack([relighter(inputs, INPUTS, target).mean for target in TARGETS], 1)
            return float((made.clamp(0, 1) - truth.clamp(0, 1)).square().mean((2, 3)).sqrt().mean() * 255), made

        results: dict[str, float] = {
            "average_face": float((mean_face - truth).square().mean((2, 3)).sqrt().mean() * 255)
        }
        pictures = {"truth": truth[0]}
        for rank, name in ((0, "per-pixel"), (40, "whole-face")):
            results[f"on_demand_{name}"], made = error(ViewRelighter(source, rank))
            pictures[f"on demand, {name}"] = made[0]
        best = None
        for width in WIDTHS:
            grid = GridViews(source, width)
            results[f"interpolated_45_poses_width_{width:g}"], made = error(ViewRelighter(grid, 0))
            if best is None or results[f"interpolated_45_poses_width_{width:g}"] < best[0]:
                best = (results[f"interpolated_45_poses_width_{width:g}"], made)
        pictures["45 poses interpolated"] = best[1][0]
        results["ratio_to_best_interpolation"] = results["on_demand_whole-face"] / best[0]
        results["ratio_to_best_interpolation_per_pixel"] = results["on_demand_per-pixel"] / best[0]
        over_poses, over_people = variation_of_n(source, min(args.heads, 20))
        results["n_variance_over_poses"], results["n_variance_over_people"] = over_poses, over_people
    rows = [{"statistics": name.replace("_", " "), "value": f"{value:.4g}"} for name, value in results.items()]
    print(markdown(rows))
    parser.save_rows(args.csv, rows)
    if args.picture:
        rows = [[inputs[0, k] for k in range(3)], *pictures.values()]
        angles = [f"{view.azimuth:+.0f}" for view in TARGETS]
        names = [
            [f"input {view.azimuth:+.0f}" for view in INPUTS],
            *([f"{name} {angle}" for angle in angles] for name in pictures),
        ]
        contact_sheet([[image.clamp(0, 1).sqrt().numpy() for image in row] for row in rows], names, args.picture)


if __name__ == "__main__":
    main()
