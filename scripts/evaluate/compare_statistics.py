"""How far the statistics of rendered heads are from those of real faces, part by part: numbers, and maps in a picture.

The picture holds statistics of the photographs, so it belongs outside the repository.

python scripts/evaluate/compare_statistics.py --data yaleb_192x168.npz --domain domain.json --output comparison.png
"""

from pathlib import Path

import matplotlib
import torch
from torch import Tensor

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, found_domain, markdown
from facerelight.geometry.lights import angle_pairs
from facerelight.model.statistics import FaceStatistics, PixelStatistics
from facerelight.train.run import rendered_statistics


def correlation(pixel: PixelStatistics) -> Tensor:
    """Correlation of v over the lights, the mean of all pixels, ``(J, J)``."""
    factor = pixel.v_factor.flatten(2)
    full = torch.einsum("jrp,krp->jk", factor, factor) / factor.shape[-1]
    return full.fill_diagonal_(1.0)


def spectrum(images: Tensor) -> Tensor:
    """Power of the frontal images' logarithm by spatial frequency, in octaves below Nyquist, mean of all people,
    ``(5,)``."""
    logs = (images.clamp_min(0) + 0.02).log()
    logs = logs - logs.mean((1, 2), keepdim=True)
    window = torch.hann_window(logs.shape[1])[:, None] * torch.hann_window(logs.shape[2])
    power = torch.fft.fft2(logs * window).abs().square().mean(0)
    frequency = torch.hypot(torch.fft.fftfreq(logs.shape[1])[:, None], torch.fft.fftfreq(logs.shape[2])[None])
    octave = torch.log2(0.5 / frequency.clamp_min(1e-3)).floor().clamp(0, 4).long()
    return torch.stack([power[octave == k].mean() for k in range(5)])


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_argument("--heads", type=int, default=80)
    parser.add_domain()
    parser.add_argument("--source", default="ict")
    parser.add_size(96, 84)
    parser.add_argument("--output", type=Path, default=None, help="a picture of the maps")
    parser.add_results("csv")
    args = parser.parse_args()
    torch.set_grad_enabled(False)
    faces = load_yale(args.data, args.height, args.width)
    photos, valid = to_grid(faces)
    angles = angle_pairs(faces.lights)
    domain = found_domain(args.domain)
    rendered = rendered_statistics(
        TrainConfig(args.heads, args.source, angles, args.height, args.width, margin=0.0, domain=domain)
    )
    real = FaceStatistics.fit(photos, faces.lights, valid, rendered.options, face_rank=20)
    assert rendered.store is not None
    frontal = int(faces.lights[:, 2].argmax())
    heads = torch.stack([torch.from_numpy(array[frontal].copy()) for array in rendered.store])
    people = photos[valid[:, frontal], frontal]

    albedo = [statistics.n_mean.norm(dim=0) for statistics in (real, rendered)]
    angle = torch.rad2deg(torch.acos(((real.n_mean * rendered.n_mean).sum(0) / (albedo[0] * albedo[1])).clamp(-1, 1)))
    ratio = albedo[0] / albedo[1] * (albedo[1].mean() / albedo[0].mean())
    pixels = [statistics.pixel for statistics in (real, rendered)]
    spread = [pixel.n_factor.square().sum((0, 1)).sqrt() for pixel in pixels]
    v_error = 255 * (real.v_mean - rendered.v_mean)
    v_spread = [255 * pixel.v_std for pixel in pixels]
    image = [s.mean_images() for s in (real, rendered)]
    gain = (image[0] * image[1]).sum((1, 2)) / image[1].square().sum((1, 2))
    off = correlation(pixels[0]) - correlation(pixels[1])
    tones = [255 * people.mean((1, 2)), 255 * heads.mean((1, 2))]
    power = [spectrum(people), spectrum(heads)]

    rows: list[dict[str, object]] = []

    def add(statistic: str, real: object = "", rendered: object = "", distance: object = "") -> None:
        rows.append({"statistic": statistic, "real": real, "rendered": rendered, "distance": distance})

    def rms(difference: Tensor, digits: int) -> str:
        return f"RMS {difference.square().mean().sqrt():.{digits}f}"

    add("direction of mean n", distance=f"median {angle.median():.1f}, mean {angle.mean():.1f} degrees")
    spread_of_ratio = f"ratio's spread {ratio.log().std():.3f}"
    add("length of mean n (albedo)", *(f"{length.mean():.3f}" for length in albedo), spread_of_ratio)
    add("spread of n", *(f"{each.mean():.3f}" for each in spread))
    add("mean v, grey levels", distance=rms(v_error, 1))
    add("spread of v, grey levels", *(f"{each.mean():.1f}" for each in v_spread))
    gains = f"{gain.min():.2f} to {gain.max():.2f}, spread {gain.log().std():.2f}"
    add("brightness by light, real over rendered", distance=gains)
    add("mean image, grey levels", distance=rms(255 * (image[0] - image[1]), 1))
    add("correlation of v over lights", distance=rms(off, 3))
    quantile = torch.tensor((0.1, 0.5, 0.9))
    texts = ("/".join(f"{v:.0f}" for v in tone.quantile(quantile)) for tone in tones)
    add("tones, grey levels, 10/50/90 %", *texts)
    for k in range(5):
        here, there = float(power[0][k]), float(power[1][k])
        waves = f"log power, {2**k * 2} to {2**k * 4} pixels a wave"
        add(waves, f"{here:.2f}", f"{there:.2f}", f"{here / there:.2f}")
    print(markdown(rows))
    parser.save_rows(args.csv, rows)
    if args.output is None:
        return
    order = [
        int((faces.angles - torch.tensor(wanted)).abs().sum(1).argmin())
        for wanted in ((0.0, 0.0), (70.0, 0.0), (0.0, 45.0))
    ]
    maps = [("angle of mean n", angle, 0, 40), ("albedo, real", albedo[0], 0, 1), ("albedo, rendered", albedo[1], 0, 1)]
    for j in order:
        maps += [(f"v at {faces.angles[j].int().tolist()}: real - rendered", v_error[j], -80, 80)]
        maps += [("its spread, real", v_spread[0][j], 0, 60), ("its spread, rendered", v_spread[1][j], 0, 60)]
    figure, axes = plt.subplots(4, 3, figsize=(9, 13))
    for axis, (title, values, low, high) in zip(axes.flat, maps, strict=True):
        axis.imshow(values, cmap="RdBu_r" if low < 0 else "gray", vmin=low, vmax=high)
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(args.output, dpi=90)


if __name__ == "__main__":
    main()
