"""A photograph's own light: how much comes from where, in which colour, and how sure that is.

Colours of light and of skin cannot be told apart: the light as a whole is taken for white, as a camera's white balance
means it to be. What can be told is that one side of a face is warmer than the other, and so how lights differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from facerelight.geometry.lights import angles_from_light
from facerelight.geometry.sources import LightMixture
from facerelight.numerics.gaussian import safe_cholesky
from facerelight.numerics.luminance import LUMINANCE

__all__ = ["OwnLight", "light_colours"]

TINT, REACH = (
    0.15,
    0.7,
)  # prior of how colours of lights differ: standard deviation of a channel, and over which distance
UNEVEN = 0.10  # of a channel: how the colour of skin itself varies over a face
PATCH = 300.0  # pixels of a crop that count as one observation of it
LEAST, MOST = 0.4, 2.0  # of a channel of a light's colour
FAINT = 0.003  # of all light: smaller amounts are the fit's own noise


@dataclass(frozen=True, eq=False)
class OwnLight:
    """The light of a photograph as a sum of n distant lights in front of the head.

    Args:
        directions: ``(n, 3)`` unit vectors as the camera sees them, float32.
        amounts: ``(n,)``, 1 being a lamp that at the camera lights the face as brightly as the photograph shows it.
        amounts_std: ``(n,)`` standard deviations.
        colours: ``(n, 3)`` linear RGB of luminance 1; the light as a whole is white.
        direction: ``(3,)``, the middle of the light; zero for a black photograph.
        direction_std: degrees, root mean square error of the middle as the model sees it.
        size: degrees, how far about the lights stand apart.
    """

    directions: Tensor
    amounts: Tensor
    amounts_std: Tensor
    colours: Tensor
    direction: Tensor
    direction_std: float
    size: float

    @property
    def mixture(self) -> LightMixture:
        """To render by: lights too faint to matter are left out."""
        kept = self.amounts > FAINT * self.amounts.sum()
        if not kept.any():
            kept = torch.zeros_like(kept)
            kept[self.directions[:, 2].argmax()] = True
        weights = self.amounts[kept, None] * self.colours[kept]
        count = int(kept.sum())
        return LightMixture(
            self.directions[kept], weights, torch.full((count,), self.size), torch.zeros(count, dtype=torch.long)
        )

    @property
    def white(self) -> LightMixture:
        """:attr:`mixture` without its colours."""
        mixture = self.mixture
        luminance = mixture.weights @ torch.tensor(LUMINANCE)
        return mixture._replace(weights=luminance[:, None].expand(-1, 3).contiguous())

    def report(self) -> dict[str, Any]:
        """As JSON holds it; angles in degrees, positive azimuth at image-left, positive elevation above; the brightest
        light first."""
        azimuth, elevation = angles_from_light(self.directions.double())
        lights = []
        for k in self.amounts.argsort(descending=True, stable=True).tolist():
            if self.amounts[k] <= FAINT * self.amounts.sum():
                break
            lights.append(
                {
                    "azimuth": round(float(azimuth[k]), 2),
                    "elevation": round(float(elevation[k]), 2),
                    "amount": round(float(self.amounts[k]), 5),
                    "std": round(float(self.amounts_std[k]), 5),
                    "colour": [round(float(c), 4) for c in self.colours[k]],
                }
            )
        middle = None
        if self.direction.any():
            a, e = angles_from_light(self.direction.double())
            middle = {"azimuth": float(a), "elevation": float(e), "std_degrees": self.direction_std}
            middle = {name: round(value, 2) for name, value in middle.items()}
        return {
            "middle": middle,
            "radius_degrees": self.size,
            "unit": "amount 1: a lamp that at the camera lights the face as brightly as the photo shows it; "
            "colours are linear RGB of luminance 1, the light as a whole taken for white",
            "lights": lights,
        }


def light_colours(colour: Tensor, images: Tensor, amounts: Tensor, weight: Tensor, directions: Tensor) -> Tensor:
    """Colours ``(n, 3)`` of lights, linear RGB of luminance 1, from how the colour of a face's skin varies over it.

    With ``w_j(x)`` the share of light j at a pixel and ``q_c(x)`` the skin's colour beside its mean, ``q_c - 1 = sum_j
    w_j d_jc + error``, and ``d`` is smooth over the sphere: ridge regression, channel by channel.

    Args:
        colour: ``(3, P)`` radiance of the face without highlights.
        images: ``(n, P)``, what it looks like under each light alone.
        amounts: ``(n,)`` of the lights.
        weight: ``(P,)``, where it is skin, 0 to 1.
        directions: ``(n, 3)``.

    Example:
        >>> light_colours(torch.ones(3, 4), torch.rand(2, 4), torch.ones(2), torch.ones(4), torch.eye(3)[:2])[0]
        tensor([1., 1., 1.])
    """
    luma = torch.tensor(LUMINANCE, dtype=torch.float64)
    colour, images, weight = colour.double(), images.double().clamp_min(0), weight.double()
    lit = amounts.double() @ images  # (P,)
    share = amounts.double()[:, None] * images / lit.clamp_min(1e-6)  # (n, P)
    luminance = luma @ colour
    bright = luminance / (luminance + 0.2 * (weight @ luminance) / weight.sum().clamp_min(1e-6)).clamp_min(1e-6)
    counted = weight * bright  # dark pixels hold little colour
    if float(counted.sum()) < 1e-6:
        return torch.ones(len(amounts), 3)
    chroma = colour / luminance.clamp_min(1e-4)  # (3, P)
    mean = (chroma * counted).sum(1) / counted.sum()
    tint = chroma / mean.clamp_min(1e-3)[:, None] - 1  # (3, P)
    precision = counted / (UNEVEN**2 * PATCH)
    prior = TINT**2 * torch.exp(-0.5 * torch.cdist(directions.double(), directions.double()).square() / REACH**2)
    root = safe_cholesky(prior + 1e-6 * torch.eye(len(prior)).double())
    rows = root.T @ share  # (n, P), of independent unit unknowns
    normal = torch.eye(len(root)).double() + (rows * precision) @ rows.T
    found = root @ torch.cholesky_solve((rows * precision) @ tint.T, safe_cholesky(normal))  # (n, 3)
    whole = amounts.double() @ found / amounts.double().sum().clamp_min(1e-12)
    colours = (1 + found - whole).clamp(LEAST, MOST)
    return (colours / (colours @ luma)[:, None]).float()
