"""Make the pictures of the README: a relit public-domain photo, and what the light angles mean on a rendered head.

python scripts/make_readme_images.py --photo astronaut.png --output .github/images
"""

import argparse
from pathlib import Path

import torch

from facerelight.alignment import CropFrame
from facerelight.bootstrap.generate import BootstrapDataset
from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.lights import light_from_angles
from facerelight.photo import PhotoRelighter
from facerelight.photo.files.disk import read_photo
from facerelight.visualize import contact_sheet, needle_map

LIGHTS = ((60, 0), (30, 0), (0, 0), (-30, 0), (-60, 0), (0, 45), (45, 30), (-45, 30), (0, -30))


def relit_sheet(photo: Path, output: Path) -> None:
    """The face of the photo, and relit under nine lights."""
    session = PhotoRelighter(read_photo(photo).rgb)
    middle, reach = session.landmarks.mean(0), float((session.landmarks[1] - session.landmarks[0]).norm()) * 2.2
    left, top, right, bottom = (int(v) for v in (*(middle - reach).clamp_min(0), *(middle + reach)))
    view = (slice(top, bottom), slice(left, right))
    pictures = [(session.coded[0].permute(1, 2, 0).numpy() * 255).astype("uint8")[view]]
    pictures += [session.render(*light)[view] for light in LIGHTS]
    names = ["photo", *(f"azimuth {a:+d}, elevation {e:+d}" for a, e in LIGHTS)]
    contact_sheet([pictures[:5], pictures[5:]], [names[:5], names[5:]], output / "relit.png", height=2.1)
    needle_map(session.relighter.statistics.n_mean, output / "needles.png")


def light_sheet(output: Path) -> None:
    """A rendered head under a grid of azimuths and elevations."""
    azimuths, elevations = (90, 45, 0, -45, -90), (45, 0, -45)
    lights = torch.stack([light_from_angles(float(a), float(e)) for e in elevations for a in azimuths])
    dataset = BootstrapDataset(MakeHumanHeads(0), 3, lights, CropFrame(160, 140, 0.25), supersample=2)
    images = list((dataset[2].images.clamp(0, 1) ** (1 / 2.2)).numpy())
    rows = [images[i * 5 : i * 5 + 5] for i in range(3)]
    names = [[f"az {a:+d}, el {e:+d}" for a in azimuths] for e in elevations]
    contact_sheet(rows, names, output / "lights.png", height=1.7)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photo", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=Path(".github/images"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    relit_sheet(args.photo, args.output)
    light_sheet(args.output)


if __name__ == "__main__":
    main()
