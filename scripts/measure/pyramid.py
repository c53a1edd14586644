"""The thesis's own suggestion against mixed identity (7.3): the per-pixel model on a multi-resolution pyramid.

python scripts/measure/pyramid.py --data yaleb_192x168.npz

Protocol yale-relight with real, registered statistics. Every image is a sum of bands, each half as fine as the one
before (Burt and Adelson); the model holds for each band as for the image, both being linear. A coarse pixel sees a
large part of the face. Rows: the per-pixel model, the same on the bands, and the whole-face model.
"""

import torch
from kornia.geometry.transform import resize

from facerelight.evaluation import SOURCES
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, markdown
from facerelight.geometry.lights import light_from_angles, nearest_lights
from facerelight.inference.relighter import StatisticalRelighter
from facerelight.model.learning import FitOptions
from facerelight.model.registration import align_people, deform, register, undeform
from facerelight.model.statistics import FaceStatistics


def bands(images: torch.Tensor, levels: int) -> list[torch.Tensor]:
    """``images (N, J, H, W)`` as differences between neighbouring resolutions, finest first, and the coarsest image
    last."""
    result = []
    for _ in range(levels - 1):
        height, width = images.shape[2:]
        coarse = resize(images, ((height + 1) // 2, (width + 1) // 2), interpolation="area")
        result.append(images - resize(coarse, (height, width), interpolation="bilinear"))
        images = coarse
    return [*result, images]


def collapse(parts: list[torch.Tensor]) -> torch.Tensor:
    """The way back."""
    image = parts[-1]
    for band in reversed(parts[:-1]):
        image = band + resize(image, (band.shape[-2], band.shape[-1]), interpolation="bilinear")
    return image


class Pyramid:
    """A per-pixel model for every band."""

    def __init__(
        self, images: torch.Tensor, lights: torch.Tensor, valid: torch.Tensor, levels: int, options: FitOptions
    ) -> None:
        self.levels = levels
        self.models = [
            StatisticalRelighter(FaceStatistics.fit(band, lights, valid, options)) for band in bands(images, levels)
        ]

    def relight(self, image: torch.Tensor, light: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """``image (1, 1, H, W)`` under ``targets (Q, 3)``, ``(Q, H, W)``."""
        parts = [
            model.condition(band, light).mean(targets)
            for model, band in zip(self.models, bands(image, self.levels), strict=True)
        ]
        return collapse(parts)[0]


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_size(96, 84)
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    images, valid = to_grid(faces)
    errors: dict[tuple[str, str], list[torch.Tensor]] = {}
    for fold in range(4):
        out = torch.arange(len(images)) % 4 == fold
        aligned = align_people(images[~out], faces.lights, valid[~out])
        whole = FaceStatistics.fit(aligned, faces.lights, valid[~out], FitOptions(face_rank=18))
        mean = whole.mean_images()
        pyramids = {
            levels: Pyramid(aligned, faces.lights, valid[~out], levels, FitOptions()) for levels in (2, 3, 4, 5)
        }
        for case, angles in SOURCES.items():
            source = int(nearest_lights(light_from_angles(*angles)[None], faces.lights))
            light = faces.lights[source : source + 1]
            for person, there in zip(images[out], valid[out], strict=True):
                targets = there.clone()
                targets[source] = False
                if not there[source]:
                    continue
                theta = register(person[source : source + 1], mean[source : source + 1])
                image = deform(person[source], theta)[None, None]
                made = {
                    model: StatisticalRelighter(whole, model).condition(image, light).mean(faces.lights[targets])[0]
                    for model in ("pixel", "face")
                }
                made |= {
                    f"pyramid of {n} levels": pyramid.relight(image, light, faces.lights[targets])
                    for n, pyramid in pyramids.items()
                }
                for name, relit in made.items():
                    error = (undeform(relit, theta).clamp(0, 1) - person[targets]) * 255
                    errors.setdefault((name, case), []).append(error.square().mean((1, 2)).sqrt())
    rows: list[dict[str, object]] = [
        {"model": name, **{case: round(float(torch.cat(errors[name, case]).mean()), 2) for case in SOURCES}}
        for name in dict.fromkeys(name for name, _ in errors)
    ]
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
