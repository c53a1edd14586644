"""What an augmentation is worth under lights that were not trained on, people kept apart or not."""

from __future__ import annotations

from collections.abc import Callable

import kornia.augmentation as kornia
import torch
from torch import Tensor

from facerelight.augment.crop_relighter import CropRelighter
from facerelight.augment.random_face_relight import RandomFaceRelight
from facerelight.evaluation.augmentation.network import rank_one, train_network
from facerelight.evaluation.datasets import FaceImages

__all__ = ["AUGMENTATIONS", "TASKS", "accuracies", "augmentation", "augmented"]

Augmentation = Callable[[Tensor], Tensor]
TASKS = ("strangers", "same people")
TRAINED = 1  # the subset of lights that is trained on: those within 12 degrees of the camera
SHARE = 0.8  # of the copies that are changed
CODED = 1 / 2.2  # a picture's values are radiance to this power
FOLDS = 4
OURS = "RandomFaceRelight"
AUGMENTATIONS: dict[str, tuple[Callable[[], torch.nn.Module], ...]] = {
    "none": (),
    "ColorJitter": (lambda: kornia.ColorJitter(0.5, 0.5, 0.0, 0.0, p=SHARE),),
    "RandomPlasmaShadow": (lambda: kornia.RandomPlasmaShadow(p=SHARE),),
    "RandomLinearIllumination": (lambda: kornia.RandomLinearIllumination(p=SHARE),),
    "RandomLinearIllumination, gain to 0.9": (lambda: kornia.RandomLinearIllumination((0.1, 0.9), p=SHARE),),
    "those three together": (
        lambda: kornia.ColorJitter(0.5, 0.5, 0.0, 0.0, p=0.5),
        lambda: kornia.RandomPlasmaShadow(p=0.5),
        lambda: kornia.RandomLinearIllumination((0.1, 0.9), p=0.5),
    ),
}
"""What is compared, on pictures coded as a screen shows them."""


def augmentation(name: str, relighter: CropRelighter) -> Augmentation:
    """The augmentation ``name`` of linear grey crops ``(B, 1, H, W)`` in Yale B's frame, to coded ones."""
    if name == OURS:
        relight = RandomFaceRelight(
            "yale", (-90, 90), (-40, 70), mix=(0.0, 0.1), encoding="linear", relighter=relighter, p=SHARE
        )
        return lambda crops: _coded(relight(crops))
    parts = [make() for make in AUGMENTATIONS[name]]

    def apply(crops: Tensor) -> Tensor:
        coded = _coded(crops).expand(-1, 3, -1, -1)
        for part in parts:
            coded = part(coded)
        return coded.mean(1, keepdim=True)

    return apply


def _coded(crops: Tensor) -> Tensor:
    return crops.clamp(0, 1) ** CODED


@torch.no_grad()
def augmented(crops: Tensor, apply: Augmentation, copies: int, seed: int) -> Tensor:
    """``copies`` of ``crops (N, 1, H, W)``, the first as they are, coded, ``(copies * N, 1, H, W)``."""
    torch.manual_seed(seed)
    return torch.cat([_coded(crops), *(apply(crops) for _ in range(copies - 1))])


def accuracies(
    faces: FaceImages, task: str, apply: Augmentation, seed: int, steps: int, copies: int
) -> dict[str, float]:
    """Rank-one accuracy in per cent under lights that were not trained on, in all and by subset of the lights.

    Trained on the images of subset 1 alone. "strangers": four folds, three fourths of the people are trained on, the
    others are enrolled with one picture each, the light at the camera, and named among themselves by cosine. "same
    people": everybody is trained on and enrolled with the pictures that were.

    Args:
        faces: photographs, or renderings, of people under many lights.
        task: one of ``TASKS``.
        apply: see :func:`augmentation`.
        seed: of the copies and of the network.
        steps: of training.
        copies: that are made of every picture before it.
    """
    crops, few = faces.images[:, None], faces.subset == TRAINED
    front = int((faces.lights @ torch.tensor([0.0, 0.0, 1.0])).argmax())
    right: list[Tensor] = []
    subsets: list[Tensor] = []
    for fold in range(FOLDS if task == "strangers" else 1):
        stranger = faces.subject % FOLDS == fold
        learned = few & ~stranger if task == "strangers" else few
        people = torch.unique(faces.subject[learned], return_inverse=True)[1]
        pool = augmented(crops[learned], apply, copies, seed)
        network = train_network(pool, people.repeat(copies), seed, steps)
        enrolled = stranger & (faces.light == front) if task == "strangers" else learned
        asked = ~few & stranger if task == "strangers" else ~few
        right.append(
            rank_one(
                network,
                _coded(crops[enrolled]),
                faces.subject[enrolled],
                _coded(crops[asked]),
                faces.subject[asked],
            )
        )
        subsets.append(faces.subset[asked])
    correct, subset = torch.cat(right).double(), torch.cat(subsets)
    by_subset = {f"subset {s}": 100 * float(correct[subset == s].mean()) for s in sorted(set(subset.tolist()))}
    return {"all": 100 * float(correct.mean()), **by_subset}
