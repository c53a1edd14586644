"""Lay random heads of the bootstrap out, each under six lights.

python scripts/figures/heads.py --output outputs/heads.png
"""

from pathlib import Path

import cv2
import numpy as np
import torch

from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import light_from_angles
from facerelight.train.dataset import make_dataset

LIGHTS = ((0, 0), (50, 20), (-75, 10), (20, 60), (-30, -30), (110, 10))  # azimuth and elevation, degrees
COLUMNS = 4  # heads beside each other


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--source", default="ict")
    parser.add_argument("--heads", type=int, default=24)
    parser.add_size(128, 112)
    parser.add_argument("--output", type=Path, default=Path("outputs/heads.png"))
    args = parser.parse_args()
    config = TrainConfig(args.heads, args.source, height=args.height, width=args.width)
    lights = torch.stack([light_from_angles(float(a), float(e)) for a, e in LIGHTS])
    images = make_dataset(config, lights).images().clamp(0, 1) ** (1 / 2.2)
    people = [np.hstack(list(person)) for person in (255 * images).round().byte().numpy()]
    people += [np.zeros_like(people[0])] * (-len(people) % COLUMNS)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows = [np.hstack(people[k : k + COLUMNS]) for k in range(0, len(people), COLUMNS)]
    cv2.imwrite(str(args.output), np.vstack(rows))


if __name__ == "__main__":
    main()
