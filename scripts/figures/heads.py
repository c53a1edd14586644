"""Lay random heads of the bootstrap out in colour, each under six lights.

python scripts/figures/heads.py --output outputs/heads.png

Statistics are of luminance; colour is put on here. Of a person's luminance melanin is what it says, with a share of
blood of its own: absorptions of melanin (Jacques 1998, the wavelength's power -3.33) and of blood, three quarters
oxygenated (Prahl 1999), at 610, 545 and 460 nanometres. Highlights keep the lamp's colour.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.dataset import BootstrapDataset
from facerelight.bootstrap.look import Look, paint
from facerelight.bootstrap.look.features import lips
from facerelight.bootstrap.look.hair import strand_albedo
from facerelight.bootstrap.shading import plan_effects, shade
from facerelight.config import TrainConfig
from facerelight.evaluation.results import ScriptParser
from facerelight.geometry.lights import light_from_angles
from facerelight.numerics.luminance import LUMINANCE
from facerelight.train.dataset import make_dataset

LIGHTS = ((0, 0), (50, 20), (-75, 10), (20, 60), (-30, -30), (110, 10))  # azimuth and elevation, degrees
COLUMNS = 4  # heads beside each other
WAVELENGTHS = np.array((610.0, 545.0, 460.0))
MELANIN = (WAVELENGTHS / 545) ** -3.33
BLOOD = np.array((0.07, 1.0, 0.78))
PIGMENT_FREE = 0.62  # reflectance of skin without either, of a cheek whose tone is 1
IRISES = ((1.25, 0.95, 0.6), (1.2, 0.97, 0.65), (0.85, 1.0, 1.3), (0.95, 1.02, 1.0))  # brown twice, blue, grey
EXPOSURE = 1.3


def even(colour: Tensor) -> Tensor:
    """A colour ``(3,)`` brought to unit luminance."""
    return colour / (colour @ torch.tensor(LUMINANCE))


def skin_colour(tone: float, blood: float) -> Tensor:
    """Colour of unit luminance of skin whose luminance is ``tone``, ``(3,)``."""
    amounts = np.linspace(0, 6, 2000)[:, None]
    colours = np.exp(-amounts * MELANIN - blood * BLOOD)
    luminance = colours @ np.asarray(LUMINANCE)
    return even(torch.from_numpy(colours[np.abs(luminance - min(tone, 0.95) * PIGMENT_FREE).argmin()]).float())


def colours(reference: Tensor, is_eye: Tensor, look: Look) -> Tensor:
    """Colour of unit luminance of a person at points ``(P, 3)`` of the average head, ``(P, 3)``."""
    rng = np.random.default_rng(look.seed)
    blood = rng.uniform(0.15, 0.4)
    skin, mouth = skin_colour(look.tone, blood), skin_colour(look.tone, blood + 0.6)
    # half of what hair reflects has passed through its pigment
    hair = torch.tensor(0.5 + 0.5 * strand_albedo(look.hair) ** (MELANIN - 1), dtype=torch.float32)
    iris = torch.tensor(IRISES[rng.integers(len(IRISES))] if look.tone > 0.5 else IRISES[0])
    tinted = torch.lerp(skin.expand(len(reference), 3), mouth, lips(reference)[0][:, None].clamp(0, 1))
    # what a lighter tone would not lighten is no skin
    lighter = paint(reference, is_eye, replace(look, tone=1.1 * look.tone)) / paint(reference, is_eye, look)
    tinted = torch.lerp(even(hair), tinted, ((lighter - 1) / 0.1).clamp(0, 1)[:, None])
    side, y = reference[:, 0].abs() - 0.5, reference[:, 1]
    inside = torch.hypot(side - look.gaze.aside * reference[:, 0].sign(), y - look.gaze.up) < look.gaze.iris
    eye = torch.where(inside[:, None], even(iris), torch.ones(3))
    return torch.where(is_eye[:, None] > 0.5, eye, tinted)


def picture(dataset: BootstrapDataset, index: int) -> np.ndarray:
    """Person ``index`` under all lights beside each other, BGR, 8 bits."""
    surface, material = dataset.surface(index)
    seen = dataset.renderer.geometry().attribute
    values = torch.from_numpy(np.ascontiguousarray(seen)).flatten(0, 1)[surface.pixel]
    tint = torch.zeros(*surface.size, 3)
    tint.view(-1, 3)[surface.pixel] = colours(values[:, :3], values[:, 3], dataset.look(index))
    matte = replace(material, specular=0.0)
    images = []
    for light in dataset.lights:
        whole, diffuse = (
            shade(surface, light, skin, plan_effects(surface, light, skin), dataset.renderer)
            for skin in (material, matte)
        )
        images.append(diffuse[..., None] * tint + (whole - diffuse)[..., None])
    radiance = torch.stack(images).permute(0, 3, 1, 2)  # (J, 3, H, W)
    radiance = torch.nn.functional.avg_pool2d(radiance, dataset.supersample)
    coded = (EXPOSURE * radiance).clamp(0, 1) ** (1 / 2.2)
    return np.hstack(list((255 * coded).round().byte().permute(0, 2, 3, 1).numpy()[..., ::-1]))


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_argument("--source", default="ict")
    parser.add_argument("--heads", type=int, default=24)
    parser.add_argument("--columns", type=int, default=COLUMNS, help="heads beside each other")
    parser.add_size(128, 112)
    parser.add_argument("--output", type=Path, default=Path("outputs/heads.png"))
    args = parser.parse_args()
    config = TrainConfig(args.heads, args.source, height=args.height, width=args.width)
    dataset = make_dataset(config, torch.stack([light_from_angles(float(a), float(e)) for a, e in LIGHTS]))
    people = [picture(dataset, index) for index in range(args.heads)]
    dataset.close()
    people += [np.zeros_like(people[0])] * (-len(people) % args.columns)
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows = [np.hstack(people[k : k + args.columns]) for k in range(0, len(people), args.columns)]
    cv2.imwrite(str(args.output), np.vstack(rows))


if __name__ == "__main__":
    main()
