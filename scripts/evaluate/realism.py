"""How easily rendered crops are told from photographs: the accuracy of a small network, 50 % being perfect.

python scripts/evaluate/realism.py --data yaleb_192x168.npz --domain domain.json --csv

Extended Yale B and as many rendered heads under its lights, grey, of one size, each crop with the same mean and spread
and with the same noise; so neither brightness nor the sensor gives them away. Four folds: people and heads of the test
are never trained on. Balanced accuracy over single crops, in percent, and over people by the mean of their crops.
"""

from dataclasses import replace

import torch
from torch import Tensor, nn

from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import load_yale, to_grid
from facerelight.evaluation.results import ScriptParser, found_domain, markdown
from facerelight.geometry.lights import angle_pairs
from facerelight.train.dataset import make_dataset

SOURCES = ("makehuman", "ict")
FOLDS, EPOCHS, BATCH = 4, 6, 64
NOISE = 0.05  # of the crops' spread, standard deviation


def alike(images: Tensor, generator: torch.Generator) -> Tensor:
    """Crops ``(..., H, W)`` of mean 0 and spread 1, with noise."""
    centred = images - images.mean((-2, -1), keepdim=True)
    scaled = centred / centred.std((-2, -1), keepdim=True).clamp_min(1e-3)
    return scaled + NOISE * torch.randn(scaled.shape, generator=generator)


def network() -> nn.Module:
    """Three convolutions and a mean over what they find."""
    layers: list[nn.Module] = []
    for before, after in ((1, 16), (16, 32), (32, 64)):
        layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, 1))


def trained(crops: Tensor, rendered: Tensor, generator: torch.Generator) -> nn.Module:
    """A network that has seen ``crops (M, H, W)``, mirrored half of the time; ``rendered (M,)`` is 1 or 0."""
    torch.manual_seed(0)
    model = network()
    steps = EPOCHS * (len(crops) // BATCH)
    optimiser = torch.optim.AdamW(model.parameters(), lr=2e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 2e-3, total_steps=steps)
    for _ in range(EPOCHS):
        for part in torch.randperm(len(crops), generator=generator)[: len(crops) // BATCH * BATCH].split(BATCH):
            batch = crops[part, None]
            mirrored = torch.rand(len(batch), generator=generator) < 0.5
            batch = torch.where(mirrored[:, None, None, None], batch.flip(-1), batch)
            loss = nn.functional.binary_cross_entropy_with_logits(model(batch)[:, 0], rendered[part])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
    return model.eval()


def accuracy(real: Tensor, valid: Tensor, heads: Tensor) -> tuple[float, float]:
    """Balanced accuracy in percent, over crops and over people, of ``real (N, J, H, W)`` where ``valid (N, J)``, and
    ``heads (N, J, H, W)``."""
    generator = torch.Generator().manual_seed(0)
    real, heads = alike(real, generator), alike(heads, generator)
    by_crop, by_person = [], []
    for fold in range(FOLDS):
        out = torch.arange(len(real)) % FOLDS == fold
        kinds = [(real[~out][valid[~out]], 0.0), (heads[~out][valid[~out]], 1.0)]
        crops = torch.cat([kind for kind, _ in kinds])
        model = trained(crops, torch.cat([torch.full((len(kind),), value) for kind, value in kinds]), generator)
        with torch.no_grad():
            for images, sign in ((real[out], -1), (heads[out], 1)):
                found = model(images.flatten(0, 1)[:, None])[:, 0].view(images.shape[:2]) * sign
                seen = valid[out]
                by_crop.append(float((found[seen] > 0).float().mean()))
                by_person.append(float(((found * seen).sum(1) > 0).float().mean()))
    return 100 * sum(by_crop) / len(by_crop), 100 * sum(by_person) / len(by_person)


def main() -> None:
    parser = ScriptParser(__file__, __doc__)
    parser.add_faces()
    parser.add_domain()
    parser.add_size(48, 42)
    parser.add_results("csv")
    args = parser.parse_args()
    faces = load_yale(args.data, args.height, args.width)
    real, valid = to_grid(faces)
    config = TrainConfig(len(real), lights=angle_pairs(faces.lights), height=args.height, width=args.width, margin=0.0)
    rows: list[dict[str, object]] = []
    for source in SOURCES:
        heads = make_dataset(replace(config, source=source, domain=found_domain(args.domain))).images()
        crops, people = accuracy(real, valid, heads)
        rows.append({"heads": source, "crops": round(crops, 1), "people": round(people, 1)})
    print(markdown(rows))
    parser.save_rows(args.csv, rows)


if __name__ == "__main__":
    main()
