"""Other poses: statistics rendered on demand at exactly the pose asked for, against the thesis's interpolation over its
45 poses (5.6).

python scripts/evaluate_pose.py --heads 100 --json pose.json --picture pose.png

Inputs are three images of a held-out head (30 degrees left, 30 right, frontal), outputs lie off the thesis's grid of
poses; the light is frontal and known throughout, as in 5.6.1. Also answers the question of section 7.3: does n vary
more over poses or over people?
"""

import argparse
import json
import tempfile
from dataclasses import replace

import numpy as np
import torch
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.visualize import contact_sheet
from facerelight.geometry.lights import light_from_angles
from facerelight.numerics.kernels import kernel_weights
from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter
from facerelight.viewpoint.views import ViewFields

GRID = [View(float(a), float(e)) for a in np.linspace(-90, 90, 15) for e in (-10, 0, 20)]  # the thesis's 45 poses
INPUTS = [View(-30.0), View(30.0), View()]
TARGETS = [View(float(a)) for a in (-83, -52, -22, 0, 22, 52, 83)]
LIGHTS = [(0.0, 0.0), (40.0, 0.0), (-40.0, 0.0), (0.0, 40.0)]  # the thesis learned n from four lights a pose
WIDTHS = (4.0, 6.0, 8.0, 10.0, 13.0)  # degrees


class GridViews:
    """The thesis's way: fields at 45 poses, kernel regression between them (5.6)."""

    def __init__(self, source: BootstrapViews, width: float) -> None:
        self.source, self.width = source, width
        self.grid = torch.stack([source.images(view).flatten(1) for view in GRID])  # (45, N, P)
        self.angles = torch.tensor([[view.azimuth, view.elevation] for view in GRID])

    @property
    def size(self) -> tuple[int, int]:
        return self.source.size

    def fields(self, views) -> ViewFields:
        at = torch.tensor([[view.azimuth, view.elevation] for view in views])
        weights = kernel_weights(torch.cdist(at, self.angles).square(), self.width)
        images = torch.einsum("vg,gnp->vnp", weights, self.grid)
        mean = images.mean(1)
        same = torch.tensor([[float(a == b) for b in views] for a in views])
        return ViewFields(mean, (images - mean[:, None])[None], 4e-6 * same[..., None].expand(-1, -1, mean.shape[1]))


def variation_of_n(source: BootstrapViews, people: int) -> tuple[float, float]:
    """Mean square change of n between poses (of the average person), and between people (at a pose), over pixels and
    components."""
    few = BootstrapViews(replace(source.config, heads=people), source.folder)
    solver = torch.linalg.pinv(torch.stack([light_from_angles(*light) for light in LIGHTS]))
    n = []
    for view in tqdm(GRID[1::3], desc="n over poses and people"):
        images = torch.stack([few.images(replace(view, light=light)).flatten(1) for light in LIGHTS], 1)  # (N, 4, P)
        n.append(solver @ images)
    n = torch.stack(n)  # (poses, N, 3, P)
    return float(n.mean(1).var(0).mean()), float(n.var(1).mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--heads", type=int, default=100)
    parser.add_argument("--people", type=int, default=8, help="held-out heads")
    parser.add_argument("--height", type=int, default=64)
    parser.add_argument("--width", type=int, default=56)
    parser.add_argument("--cache", default=None, help="folder for rendered views (default: a temporary one)")
    parser.add_argument("--json", default=None)
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
    for name, value in results.items():
        print(f"{name}: {value:.4g}")
    if args.json:
        with open(args.json, "w") as file:
            json.dump(
                {"heads": args.heads, "people": args.people, "size": [args.height, args.width], "results": results},
                file,
                indent=2,
            )
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
