"""Several pixels at a time (5.5): error against the group's size, the number of heads and the covariance's estimator,
and det C_m.

python scripts/evaluate/groups.py --csv --figure groups.png

The input is lit from the side, the output from the front, as in figures 5.9 and 5.10; people are held-out rendered
heads. Tells which of the three causes suspected in 5.5.2 (the criterion of grouping, the greedy algorithm, too few
data) makes the thesis's images noisy. Inputs are taken to be free of noise, as the thesis does.
"""

import tempfile
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch.utils.data import DataLoader
from tqdm import tqdm

from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import light_from_angles
from facerelight.model.statistics import FaceStatistics
from facerelight.numerics.shrinkage import KINDS
from facerelight.train.dataset import make_dataset
from facerelight.viewpoint.regions import GroupRelighter, group_by_correlation, make_regions, random_groups
from facerelight.viewpoint.thesis import PrintedGroups
from facerelight.viewpoint.views import LightViews

SOURCE, TARGET = (70.0, 0.0), (0.0, 0.0)
PRINTED = "as printed"  # instead of a kind of covariance: the thesis's (5.2), see PrintedGroups


def render(config: TrainConfig, folder: Path) -> torch.Tensor:
    """Images ``(N, J, H, W)`` of all heads of ``config``, kept in ``folder``."""
    path = folder / f"groups_{config.key()}.pt"
    if not path.exists():
        loader = DataLoader(
            make_dataset(config), batch_size=None, num_workers=1, collate_fn=lambda x: x, multiprocessing_context="fork"
        )
        torch.save(torch.stack([head.images for head in tqdm(loader, desc="rendering heads")]), path)
    return torch.load(path, weights_only=True)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[40, 100, 400], help="bootstrap sizes N")
    parser.add_argument("--sizes", type=int, nargs="+", default=[1, 2, 5, 10, 30], help="pixels a group r")
    parser.add_argument("--people", type=int, default=20, help="held-out heads")
    parser.add_argument("--lights", type=int, default=20)
    parser.add_size(48, 42)
    parser.add_argument(
        "--kernel-width",
        type=float,
        default=0.05,
        help="of the lights' kernel; narrow: both lights are bootstrap lights",
    )
    parser.add_argument("--cache", default=None)
    parser.add_results("csv")
    parser.add_argument("--figure", default=None)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        config = TrainConfig(
            heads=max(args.counts) + args.people,
            lights=args.lights,
            height=args.height,
            width=args.width,
            margin=0.0,
            supersample=1,
        )
        images = render(config, Path(args.cache or temporary))
    lights = config.directions()
    source = lights[(lights @ light_from_angles(*SOURCE)).argmax()][None]
    target = lights[(lights @ light_from_angles(*TARGET)).argmax()]
    tests = images[-args.people :]
    j, q = int((lights @ source[0]).argmax()), int((lights @ target).argmax())
    rows = []
    for count in args.counts:
        chosen = images[:count]
        views = LightViews(FaceStatistics.fit(chosen, lights, rank=2, kernel_width=args.kernel_width))
        samples = chosen[:100].flatten(0, 1).flatten(1)
        for grouping in ("correlation", "random"):
            for size in args.sizes:
                pixels = samples.shape[1]
                groups = (
                    group_by_correlation(samples, size)
                    if grouping == "correlation"
                    else random_groups(pixels, size, torch.Generator().manual_seed(0))
                )
                for kind in (*KINDS, PRINTED):
                    if size == 1 and kind not in ("sample", PRINTED):
                        continue  # one pixel: nothing to shrink between pixels
                    regions = make_regions(groups)
                    relighter = (
                        PrintedGroups(views, regions, "sample", noise=0)
                        if kind == PRINTED
                        else GroupRelighter(views, regions, kind, noise=0)
                    )
                    out = relighter(tests[:, j : j + 1], source, target)
                    made = out.mean.clamp(0, 1)
                    rmse = float((made - tests[:, q].clamp(0, 1)).square().mean((1, 2)).sqrt().mean() * 255)
                    log_det = float(out.log_det.sum() / pixels)
                    promised = float(out.variance.mean().sqrt() * 255)
                    rows.append(
                        {"heads": count, "grouping": grouping, "r": size, "covariance": kind, "rmse": rmse}
                        | {"promised_rmse": promised, "log_det_per_pixel": log_det}
                    )
                    print(rows[-1], flush=True)
    shown = table(rows)
    print(markdown(shown))
    parser.save_rows(args.csv, shown)
    if args.figure:
        draw(rows, args.figure)


def table(rows: list[dict]) -> list[dict[str, object]]:
    """A row for each number of heads, grouping and covariance: RMSE by the group's size r, then log det C_m a pixel;
    single pixels, where there is nothing to shrink, beside every kind."""
    cells: dict[tuple[int, str, str], dict[str, object]] = {}
    for row in sorted(rows, key=lambda row: row["r"]):
        alone = row["r"] == 1 and row["covariance"] == "sample"
        for kind in KINDS if alone else (row["covariance"],):
            key = row["heads"], row["grouping"], kind
            kept = cells.setdefault(key, dict(zip(("heads", "grouping", "covariance"), key, strict=True)))
            kept[f"r = {row['r']}"] = round(row["rmse"], 1)
            kept[f"log det, r = {row['r']}"] = round(row["log_det_per_pixel"], 2)
    return list(cells.values())


def draw(rows: list[dict], path: str) -> None:
    """Error against r, a panel for each N, a line for each estimator."""
    counts = sorted({row["heads"] for row in rows})
    figure = Figure(figsize=(3.4 * len(counts), 3), layout="constrained")
    for axis, count in zip(figure.subplots(1, len(counts), sharey=True, squeeze=False)[0], counts, strict=True):
        for grouping, style in (("correlation", "-"), ("random", ":")):
            for index, kind in enumerate((*KINDS, PRINTED)):
                line = [
                    row
                    for row in rows
                    if row["heads"] == count and row["grouping"] == grouping and row["covariance"] == kind
                ]
                first = [row for row in rows if row["heads"] == count and row["grouping"] == grouping and row["r"] == 1]
                first = [row for row in first if row["covariance"] == ("sample" if kind != PRINTED else PRINTED)]
                points = sorted({(row["r"], row["rmse"]) for row in first + line})
                axis.plot(*zip(*points, strict=True), style, marker=".", label=f"{kind}, {grouping}", color=f"C{index}")
        axis.set_xscale("log")
        axis.set_xlabel("pixels a group r")
        axis.set_title(f"N = {count} heads", fontsize=9)
    figure.axes[0].set_ylabel("RMSE, grey levels")
    figure.axes[-1].legend(fontsize=6)
    figure.savefig(path)


if __name__ == "__main__":
    main()
