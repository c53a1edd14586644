"""Are all skin tones relit equally well? Errors of held-out rendered heads by tone, and of photographs by frontal
brightness.

python scripts/evaluate/tones.py --data yaleb_192x168.npz --domain domain.json
"""

from pathlib import Path

import torch

from facerelight.config import TrainConfig
from facerelight.evaluation import relighting_errors
from facerelight.evaluation.datasets import FaceImages, load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, found_domain, markdown
from facerelight.geometry.lights import angle_pairs
from facerelight.model.statistics import FaceStatistics
from facerelight.train.dataset import make_dataset

GROUPS = 4
CASES = ("front", "side")


def by_tone(
    name: str, tone: torch.Tensor, errors: dict[str, torch.Tensor], brightness: torch.Tensor
) -> list[dict[str, object]]:
    """One row a group of equal size, from dark to light."""
    rows = []
    for group in tone.argsort().chunk(GROUPS):
        between = f"{float(tone[group].min()):.2f} to {float(tone[group].max()):.2f}"
        row: dict[str, object] = {"faces": name, "tone": between, "people": len(group)}
        for case in CASES:
            error = float(errors[case][group].nanmean())
            share = 100 * error / float(brightness[group].mean())
            row |= {f"RMSE {case}": round(error, 1), f"{case}, % of brightness": round(share)}
        rows.append(row)
    return rows


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument(
        "--data", type=Path, required=True, help="yaleb_192x168.npz or a CroppedYale folder; its lights serve both"
    )
    parser.add_domain()
    parser.add_argument("--heads", type=int, default=80)
    parser.add_argument("--people", type=int, default=40, help="held-out rendered heads")
    parser.add_size(48, 42)
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    angles = angle_pairs(faces.lights)
    dataset = make_dataset(
        TrainConfig(
            args.heads + args.people,
            lights=angles,
            height=args.height,
            width=args.width,
            margin=0.0,
            domain=found_domain(args.domain),
        )
    )
    images = dataset.images()
    statistics = FaceStatistics.fit(images[: args.heads], faces.lights, None, face_rank=40, brightness=True)
    strangers = images[args.heads :].clamp(0, 1)
    count, lights = strangers.shape[:2]
    held_out = FaceImages(
        strangers.flatten(0, 1),
        torch.arange(count).repeat_interleave(lights),
        torch.arange(lights).repeat(count),
        faces.lights,
        faces.angles,
        torch.zeros(count * lights, dtype=torch.long),
        [str(i) for i in range(count)],
    )
    photos, valid = to_grid(faces)
    frontal = int(faces.lights[:, 2].argmax())
    tone = torch.tensor([dataset.look(args.heads + index).tone for index in range(count)])
    levels = 255 * strangers[:, frontal].mean((1, 2))
    rows = by_tone(
        "rendered, by albedo",
        tone,
        {case: relighting_errors(statistics, held_out, case).nanmean(1) for case in CASES},
        levels,
    )
    bright = torch.where(valid[:, frontal], photos[:, frontal].mean((1, 2)), torch.nan)
    known = bright.isfinite().nonzero()[:, 0]
    errors = {case: relighting_errors(statistics, faces, case).nanmean(1)[known] for case in CASES}
    rows += by_tone("Yale B, by frontal brightness", bright[known], errors, 255 * bright[known])
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
