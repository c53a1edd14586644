"""Make the README's picture of the augmentation: a photo, and its crop under random lamps.

python scripts/figures/augment_image.py --output .github/images/augment.jpg
"""

from pathlib import Path

import torch
from PIL import Image
from skimage.data import astronaut

from facerelight.augment.frames import frame_landmarks
from facerelight.augment.random_face_relight import RandomFaceRelight
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.alignment import CropFrame, fit_similarity, warp_to_crop
from facerelight.photo.faces.landmarks import find_landmarks


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--side", type=int, default=112, help="of a crop, in pixels")
    parser.add_argument("--rows", type=int, default=2)
    parser.add_argument("--columns", type=int, default=9)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    photo = astronaut()
    matrix = fit_similarity(find_landmarks(photo), frame_landmarks("arcface112", args.side, args.side))[None]
    crop = warp_to_crop(torch.from_numpy(photo).permute(2, 0, 1)[None] / 255, matrix, CropFrame(args.side, args.side))
    torch.manual_seed(args.seed)
    relit = RandomFaceRelight(p=1.0)(crop.expand(args.rows * args.columns - 1, -1, -1, -1))
    rows = torch.cat((crop, relit)).unflatten(0, (args.rows, args.columns))
    sheet = torch.cat([torch.cat(list(row), -1) for row in rows], -2)
    pixels = (255 * sheet.clamp(0, 1)).round().byte().permute(1, 2, 0).numpy()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(args.output, quality=88)


if __name__ == "__main__":
    main()
