"""A small network that learns to tell people apart, and how well it tells others apart."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import cross_entropy, normalize

__all__ = ["rank_one", "train_network"]

WIDTHS = (16, 32, 64, 96)
EMBEDDING = 64
SCALE, MARGIN = 16.0, 0.2  # of the cosines, as in CosFace
RATE, DECAY = 2e-3, 5e-4
SHIFT = 2  # pixels by which crops are moved while training, for every augmentation alike


class _Network(nn.Module):
    """Crops ``(B, 1, H, W)`` to unit vectors ``(B, EMBEDDING)``; each crop's own mean and contrast are taken off."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for before, after in zip((1, *WIDTHS), WIDTHS, strict=False):
            layers += [nn.Conv2d(before, after, 3, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        self.body = nn.Sequential(*layers, nn.Flatten(), nn.Dropout(0.2), nn.LazyLinear(EMBEDDING))

    def forward(self, crops: Tensor) -> Tensor:
        mean, spread = crops.mean((1, 2, 3), keepdim=True), crops.std((1, 2, 3), keepdim=True)
        return normalize(self.body((crops - mean) / (spread + 1e-3)), dim=1)


def train_network(crops: Tensor, people: Tensor, seed: int, steps: int, batch: int = 64) -> nn.Module:
    """A network trained to tell ``people (N,)`` of ``crops (N, 1, H, W)`` apart: cosines with a margin, AdamW with a
    rate that goes down along a cosine."""
    torch.manual_seed(seed)
    network = _Network()
    network(crops[:2])  # the last layer takes its size
    classes = nn.Parameter(torch.randn(int(people.max()) + 1, EMBEDDING))
    optimizer = torch.optim.AdamW([*network.parameters(), classes], RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    network.train()
    for _ in range(steps):
        chosen = torch.randint(len(crops), (batch,))
        moved = torch.roll(crops[chosen], tuple(torch.randint(-SHIFT, SHIFT + 1, (2,)).tolist()), (2, 3))
        cosines = network(moved) @ normalize(classes, dim=1).T
        cosines = cosines.scatter_add(1, people[chosen, None], cosines.new_full((batch, 1), -MARGIN))
        optimizer.zero_grad()
        cross_entropy(SCALE * cosines, people[chosen]).backward()
        optimizer.step()
        schedule.step()
    return network.eval()


@torch.no_grad()
def rank_one(network: nn.Module, gallery: Tensor, owners: Tensor, probes: Tensor, people: Tensor) -> Tensor:
    """Which of ``probes (N, 1, H, W)`` are nearest to a gallery picture of their own person, ``(N,)`` bool.

    Args:
        network: crops to unit vectors.
        gallery: ``(G, 1, H, W)``, of ``owners (G,)``.
        people: ``(N,)``, whom the probes show.
    """
    return owners[(network(probes) @ network(gallery).T).argmax(1)] == people
