"""Rendered people under the lights of photographs."""

from __future__ import annotations

import torch

from facerelight.config import TrainConfig
from facerelight.evaluation.datasets import FaceImages
from facerelight.geometry.lights import angle_pairs, angular_distance
from facerelight.train.dataset import make_dataset

__all__ = ["rendered_people"]

PAINT = 11  # seed of the heads, whom the packaged statistics have not seen
EDGES = (12.5, 25.5, 51.5, 77.5)  # degrees from the camera between Yale B's subsets


def rendered_people(like: FaceImages, people: int, height: int, width: int) -> FaceImages:
    """``people`` rendered under the lights of ``like`` that are in front of the face, in Yale B's crop, with subsets by
    the light's angle as there."""
    lights = like.lights[like.lights[:, 2] > 0.05]
    config = TrainConfig(people, lights=angle_pairs(lights), height=height, width=width, margin=0.0, seed=PAINT)
    images = make_dataset(config).images().clamp(0, 1)
    apart = angular_distance(lights, torch.tensor([[0.0, 0.0, 1.0]]).expand_as(lights))
    subset = 1 + torch.bucketize(apart, torch.tensor(EDGES))
    count = len(lights)
    return FaceImages(
        images.flatten(0, 1),
        torch.arange(people).repeat_interleave(count),
        torch.arange(count).repeat(people),
        lights,
        torch.tensor(angle_pairs(lights)),
        subset.repeat(people),
        [str(person) for person in range(people)],
    )
