"""Light from behind a face: its nearest side, and what of the face it reaches."""

import math

import torch

from facerelight.geometry.behind import nearest_side, share_reached
from facerelight.geometry.lights import light_from_angles


def test_the_nearest_side():
    lights = light_from_angles(torch.tensor([30.0, 120.0, -165.0]), torch.tensor([10.0, 0.0, 0.0])).double()
    expected = torch.stack((lights[0], torch.tensor([-1.0, 0, 0]).double(), torch.tensor([1.0, 0, 0]).double()))
    assert torch.allclose(nearest_side(lights), expected, atol=1e-6)
    assert torch.equal(nearest_side(torch.tensor([0.0, 0.0, -1.0])), torch.zeros(3))  # neither side is nearer


def test_what_a_lamp_reaches():
    normals = light_from_angles(torch.tensor([[0.0, 45.0, 80.0]]), 0.0)  # (1, 3, 3)
    lamps = light_from_angles(torch.tensor([60.0, 90.0, 120.0, 170.0, 180.0]), 0.0)[:, None]
    found = share_reached(normals, lamps)[:, 0]
    assert torch.allclose(found[:2], torch.ones(2, 3))
    assert (found.diff(dim=0)[1:] <= 0).all()
    assert torch.equal(found[3:, :2], torch.zeros(2, 2))
    rim = (math.cos(math.radians(40)) + 0.15) / (math.cos(math.radians(10)) + 0.15)
    assert abs(float(found[2, 2]) - rim) < 1e-5


def test_of_a_large_lamp_only_points_behind_are_lessened():
    normals = light_from_angles(torch.tensor([[0.0, 60.0]]), 0.0)
    points = light_from_angles(torch.tensor([80.0, 100.0]), 0.0)
    half = share_reached(normals, points)
    full = (nearest_side(points) @ normals[0].T + 0.15).clamp_min(1e-3)
    alone = share_reached(normals, points[1:])
    assert torch.allclose(half[0], (full[0] + alone[0] * full[1]) / full.sum(0), atol=1e-6)
