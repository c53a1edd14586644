"""Lay photographs out under the set-ups that have names, under two environment maps and in each other's light.

python scripts/figures/named_lights.py PHOTOS --output outputs/named_lights
python scripts/figures/named_lights.py PHOTOS --one astronaut.png --output .github/images/named_lights.jpg

Every photograph is shown as it is, in all lights, and in the light of the one before it. ``--one`` draws a single
photograph, in two rows.
"""

from pathlib import Path

import cv2
import numpy as np
import torch

from facerelight.evaluation.results import ScriptParser
from facerelight.evaluation.visualize import contact_sheet
from facerelight.geometry.environment import environment_light, even_light, map_directions
from facerelight.geometry.lights import angles_from_light, light_from_angles
from facerelight.geometry.sources import LightMixture
from facerelight.geometry.studio import STUDIO, studio_lamps
from facerelight.photo import PhotoRelighter
from facerelight.photo.faces.landmarks import LandmarksNotFoundError
from facerelight.photo.files.disk import find_photos, read_photo

ROWS = 5  # photographs a sheet
FILL = 0.1


def sunset() -> torch.Tensor:
    """A low warm sun at image-left, a blue sky that is bright about it, and dark ground, ``(64, 128, 3)`` linear."""
    directions = map_directions(64, 128)
    near = directions @ light_from_angles(65.0, 8.0).double()
    sky = torch.tensor((0.35, 0.5, 0.9)) + torch.tensor((1.0, 0.55, 0.2)) * (0.5 + 0.5 * near[..., None]) ** 4
    sun = torch.tensor((1.0, 0.55, 0.25)) * 150 * (near > 0.98)[..., None]
    ground = torch.tensor((0.12, 0.1, 0.08)).expand_as(sky)
    return torch.where(directions[..., 1:2] > 0, sky + sun, ground)


def room() -> torch.Tensor:
    """A tall window at image-right in a room of warm walls, with a lamp on the ceiling, ``(64, 128, 3)`` linear."""
    directions = map_directions(64, 128)
    azimuth, elevation = angles_from_light(directions)
    window = ((azimuth + 50).abs() < 22) & (elevation > -15) & (elevation < 45)
    walls = torch.tensor((0.5, 0.4, 0.3)).expand(64, 128, 3)
    lamp = torch.tensor((3.0, 2.2, 1.3)) * (elevation > 70)[..., None]
    return walls + lamp + torch.tensor((6.0, 7.0, 8.0)) * window[..., None]


def scenes() -> dict[str, tuple[object, float]]:
    """Lights and their fill by name; a key light at image-left."""
    named = {name: (studio_lamps(name), FILL) for name in STUDIO}
    maps = {"a sunset": environment_light(sunset()), "a room": environment_light(room()), "even": even_light()}
    return named | {name: (light, 0.0) for name, light in maps.items()}


def head(session: PhotoRelighter) -> tuple[slice, slice]:
    """Rows and columns of head and shoulders."""
    (x, y), unit = session.landmarks[:2].mean(0).tolist(), float((session.landmarks[1] - session.landmarks[0]).norm())
    across = slice(max(0, int(x - 2.6 * unit)), int(x + 2.6 * unit))
    return slice(max(0, int(y - 2.4 * unit)), int(y + 4.0 * unit)), across


def shown(pixels: np.ndarray, height: int = 700) -> np.ndarray:
    """Eight bits, three channels, not larger than needed."""
    pixels = (pixels / 257).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
    pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels[..., :3]
    scale = height / len(pixels)
    return pixels if scale >= 1 else cv2.resize(pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def pictures(session: PhotoRelighter, other: LightMixture | None) -> dict[str, np.ndarray]:
    """Head and shoulders in every light, by name."""
    view, wanted = head(session), scenes()
    if other is not None:
        wanted["of the one above"] = (other, 0.0)
    relit = {name: shown(session.render(light, fill=fill)[view]) for name, (light, fill) in wanted.items()}
    return {"photo": shown(session.photo[view])} | relit


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("photos", type=Path, help="a folder")
    parser.add_argument("--one", type=Path, default=None, help="draw this photograph alone, the folder's not")
    parser.add_argument("--output", type=Path, default=Path("outputs/named_lights"))
    args = parser.parse_args()
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, np.ndarray]] = []
    other: LightMixture | None = None
    for path in [args.one] if args.one else find_photos(args.photos):
        try:
            session = PhotoRelighter(read_photo(path).pixels)
        except (LandmarksNotFoundError, ValueError) as error:
            print(f"{path.name}: {error}")
            continue
        rows.append(pictures(session, other))
        other = session.light
    if args.one:
        names, images = list(rows[0]), list(rows[0].values())
        half = -(-len(names) // 2)
        contact_sheet([images[:half], images[half:]], [names[:half], names[half:]], args.output, height=2.4)
        return
    for start in range(0, len(rows), ROWS):
        part = rows[start : start + ROWS]
        contact_sheet(
            [list(row.values()) for row in part],
            [list(row) for row in part],
            Path(f"{args.output}-{start // ROWS + 1}.png"),
        )


if __name__ == "__main__":
    main()
