"""Several photographs under nearly one light: do they help, or hurt?

python scripts/measure/nearby_lights.py --csv

RMS grey levels over held-out rendered heads, relit from 1, 2, 5 and 21 images whose lights lie some degrees apart,
rounded to 8 bits or compressed as JPEG 75, the lights known or estimated. Noise 0 is the thesis's exact interpolation.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.config import QUALITIES
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import light_from_angles
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.train.dataset import make_dataset
from facerelight.train.run import trained_folder

APART = (0.1, 0.5, 1.0, 3.0, 10.0)  # degrees
INPUTS = (1, 2, 5, 21)
CENTRE = (20.0, 10.0)
TARGETS = [(0, 0), (70, 0), (-35, 15), (35, -20), (0, 45), (-60, -20), (-70, 45)]
GOLDEN = 137.508  # degrees: points of a sunflower, each about as far from its neighbours


def bundle(apart: float, count: int) -> Tensor:
    """``count`` lights about :data:`CENTRE`, neighbours ``apart`` degrees from each other, ``(count, 3)``."""
    index = torch.arange(count, dtype=torch.float64)
    radius, turn = apart * index.sqrt(), torch.deg2rad(GOLDEN * index)
    return light_from_angles(CENTRE[0] + radius * turn.cos(), CENTRE[1] + radius * turn.sin()).float()


def recorded(images: Tensor, kind: str) -> Tensor:
    """``images (N, K, H, W)`` as a file holds them."""
    rounded = (images.clamp(0, 1) * 255).round().to(torch.uint8)
    if kind == "8 bits":
        return rounded.float() / 255
    flat = [
        cv2.imdecode(cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, 75))[1], cv2.IMREAD_GRAYSCALE)
        for image in rounded.flatten(0, 1).numpy()
    ]
    return torch.from_numpy(np.stack(flat)).float().div(255).view(images.shape)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--heads", type=int, default=8)
    parser.add_argument("--seed", type=int, default=7919)
    parser.add_argument("--draws", type=int, default=8, help="of estimated lights")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    config = QUALITIES["draft"]
    fitted = StatisticalRelighter.from_pretrained(trained_folder(config))
    angles = torch.tensor(TARGETS, dtype=torch.float64)
    targets = light_from_angles(angles[:, 0], angles[:, 1]).float()
    bundles = [bundle(apart, max(INPUTS)) for apart in APART]
    heads = replace(config, heads=args.heads, seed=args.seed)
    images = make_dataset(heads, torch.cat((targets, *bundles))).images()
    truth, parts = images[:, : len(targets)], images[:, len(targets) :].split(max(INPUTS), 1)
    face = config.frame.oval() < 1
    rows = []
    for noise, kind, known in (
        (0.0, "8 bits", True),
        (1.0, "8 bits", True),
        (1.0, "JPEG 75", True),
        (1.0, "8 bits", False),
        (1.0, "JPEG 75", False),
    ):
        relighter = StatisticalRelighter(fitted.statistics, fitted.covariance, fitted.estimator, noise)
        for apart, lights, taken in zip(APART, bundles, parts, strict=True):
            row = {"images": kind, "lights": "known" if known else "estimated", "noise": noise, "apart": apart}
            photos = recorded(taken, kind)
            for count in INPUTS:
                errors = []
                for person, wanted in zip(photos, truth, strict=True):
                    given = lights[:count] if known else None
                    seen = relighter.condition(person[None, :count], given, draws=args.draws, mask=face[None].float())
                    errors.append((seen.mean(targets)[0] - wanted)[:, face].square().mean())
                row[f"of_{count}"] = round(float(torch.stack(errors).mean().sqrt()) * 255, 2)
            print(row, flush=True)
            rows.append(row)
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
