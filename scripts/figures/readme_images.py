"""Make the pictures of the README: a public-domain photo relit by soft and by hard lamps, and what the light angles
mean on a rendered head.

python scripts/figures/readme_images.py --photo astronaut.png --output .github/images
"""

from pathlib import Path

import torch

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.heads import MakeHumanHeads
from facerelight.evaluation.results import ScriptParser
from facerelight.evaluation.visualize import contact_sheet
from facerelight.geometry.alignment import CropFrame
from facerelight.geometry.lights import light_from_angles
from facerelight.geometry.sources import Lamp
from facerelight.photo import PhotoRelighter
from facerelight.photo.files.disk import read_photo

SIZES = {"soft, 20 degrees": 20.0, "hard, 1 degree": 1.0}
FILL = 0.08


def lights(size: float) -> dict[str, list[Lamp]]:
    """Lamps by what the picture is called."""
    key = [Lamp(45, 30, size), Lamp(-60, 10, 25, power=0.3, colour=(0.7, 0.85, 1.0))]
    left, right, top = (Lamp(azimuth, elevation, size) for azimuth, elevation in ((60, 0), (-60, 0), (0, 35)))
    return {"azimuth 60": [left], "azimuth -60": [right], "elevation 35": [top], "key 45, 30 and a cold fill": key}


def relit_sheet(photo: Path, output: Path) -> None:
    """Head and shoulders of the photo, and relit by lamps from four sides, soft and hard."""
    pixels = read_photo(photo).pixels
    session = PhotoRelighter(pixels)
    (x, y), unit = session.landmarks[:2].mean(0).tolist(), float((session.landmarks[1] - session.landmarks[0]).norm())
    side = slice(max(0, int(x - 2.6 * unit)), int(x + 2.6 * unit))
    view = (slice(max(0, int(y - 2.2 * unit)), int(y + 3.8 * unit)), side)
    rows, names = [], []
    for kind, size in SIZES.items():
        scenes = lights(size)
        rows.append([pixels[view], *(session.render(lamps, fill=FILL)[view] for lamps in scenes.values())])
        names.append([f"photo; lamps {kind}", *scenes])
    contact_sheet(rows, names, output / "relit.png", height=2.2)


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
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--photo", type=Path, required=True)
    parser.add_argument("--output", type=Path, default=Path(".github/images"))
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    relit_sheet(args.photo, args.output)
    light_sheet(args.output)


if __name__ == "__main__":
    main()
