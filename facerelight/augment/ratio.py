"""From faces under several lights to one log ratio of new light over old, which goes on softly beyond the face."""

from __future__ import annotations

import torch
from torch import Tensor

from facerelight.augment.crop_relighter import Radiances
from facerelight.geometry.alignment import CropFrame
from facerelight.numerics.blur import gaussian_blur
from facerelight.numerics.luminance import RATIO_FLOOR

__all__ = ["face_mask", "log_ratio"]

DARKEST, BRIGHTEST = -4.0, 1.5  # of the face's log ratio
OUTER_DARKEST, OUTER_BRIGHTEST = -2.5, 0.8  # of the rest's
FACE, RIM = 1.0, 0.25  # of the face's outline: where the model's answer begins to fade, and over how much it does
EYES = 0.35  # eye distances over which the rest is told from the face
MOUTH = (0.5, 0.28)  # half axes of an ellipse in eye distances: what is brighter than lips there is teeth
ODD = (0.2, 0.6)  # in log, than what the whole face says of them; teeth are dimmed as the skin around them
AROUND, HEARSAY = 0.12, 0.02  # eye distances over which, and weight with which, the odd is asked
LEAK = 0.25  # what the mean over people leaves of a lamp where most people are in shadow
LEAST = 0.01  # radiance
SOFT = 20.0  # degrees: a lamp as large as this has no edges


def face_mask(frame: CropFrame) -> Tensor:
    """How much of the face's outline a pixel is inside of, ``(h, w)``, 1 on the face, 0 beyond."""
    return ((FACE + RIM - frame.oval()) / RIM).clamp(0, 1)


def log_ratio(
    faces: Radiances, luminance: Tensor, shown: Tensor, fill: Tensor, size: Tensor, frame: CropFrame
) -> Tensor:
    """The log ratio of a lamp and a fill over the crops' own light, ``(B, h, w)``.

    Args:
        faces: under the crops' own light, a lamp at the camera, the lamp, and the fill, each of power 1.
        luminance: ``(B, h, w)`` of the crops.
        shown: ``(B or 1, h, w)``, where they show the face, see :func:`face_mask`.
        fill: ``(B,)``, the fill's share.
        size: ``(B,)``, the lamp's angular radius in degrees.
        frame: the maps' crop.
    """
    own, camera, lamp, everywhere = faces.maps.unbind(1)
    total = shown.sum((1, 2)).clamp_min(1e-6)
    mean = ((luminance * shown).sum((1, 2)) / total)[:, None, None]
    at_camera = ((camera * shown).sum((1, 2)) / total)[:, None, None]
    exposure = mean / at_camera.clamp_min(1e-6)  # a lamp at the camera keeps the face's brightness
    edged = ((SOFT - size) / 10).clamp(0, 1)[:, None, None]
    share = (lamp + LEAST) / (camera + LEAST)
    lamp = lamp * (share * (1 + LEAK) / (share + LEAK)).clamp_min(1e-6).pow(edged)
    fill = fill[:, None, None]
    new = ((1 - fill) * lamp + fill * everywhere) * exposure
    dark = RATIO_FLOOR * mean.clamp_min(1e-3)
    inner = torch.log((new + dark) / (own + dark))
    weight = shown
    odd = torch.log((luminance + dark) / (faces.explained + dark))
    trust = 1 - ((odd - ODD[0]) / (ODD[1] - ODD[0])).clamp(0, 1) * _mouth(frame).to(inner)
    sure = (trust + HEARSAY) * weight
    near = AROUND * _unit(frame)
    around = gaussian_blur(inner * sure, near) / gaussian_blur(sure, near).clamp_min(1e-4)
    inner = trust * inner + (1 - trust) * around
    sigma = EYES * _unit(frame)
    few = 1e-3
    level = (inner * weight).sum((1, 2), keepdim=True) / weight.sum((1, 2), keepdim=True).clamp_min(1e-6)
    outer = (gaussian_blur(inner * weight, sigma) + few * level) / (gaussian_blur(weight, sigma) + few)
    outer = outer.clamp(OUTER_DARKEST, OUTER_BRIGHTEST)
    return weight * inner.clamp(DARKEST, BRIGHTEST) + (1 - weight) * outer


def _mouth(frame: CropFrame) -> Tensor:
    """Where teeth may show, ``(h, w)`` in 0 to 1."""
    centre, unit = frame.landmarks[2], _unit(frame)
    y, x = torch.meshgrid(torch.arange(frame.height), torch.arange(frame.width), indexing="ij")
    radius = torch.hypot((x - centre[0]) / (MOUTH[0] * unit), (y - centre[1]) / (MOUTH[1] * unit))
    return ((1.2 - radius) / 0.4).clamp(0, 1)


def _unit(frame: CropFrame) -> float:
    """The eye distance in pixels."""
    eyes = frame.landmarks[:2]
    return float(eyes[1, 0] - eyes[0, 0])
