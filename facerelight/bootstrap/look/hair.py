"""Hair: who wears what, where on the average head it is, and its albedo.

Where hair is, is one function (:func:`hair_depth`), of which both the volume (:mod:`scalp`) and the paint are made.
Positions are in the units of :mod:`heads`, of the average head.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from facerelight.bootstrap.look.noise import step

__all__ = ["BALD", "SHORN", "Hairstyle", "beard_cover", "fall", "hair_depth", "strand_albedo", "strands", "tint"]

CENTRE = (0.0, 0.45, -0.95)  # hair is laid out around the vertical through this point, from the crown down
GIRTH = 1.2  # the scalp's radius about it
KINDS = {"bald": 0.08, "cropped": 0.16, "short": 0.36, "receding": 0.1, "fringe": 0.12, "long": 0.18}
# azimuth in degrees, 0 in front: where the temple, sideburn, ear and nape are, and the hairline's height there
SIDES = ((54, 0.72), (62, 0.42), (68, 0.05), (73, -0.3), (81, -0.3), (86, 0.14), (100, 0.3), (115, 0.12), (121, -0.5))
NAPE = ((130, -1.0), (180, -1.2))
TOP, BOTTOM = 2.2, -4.0  # heights between which the field is laid out
HANGS = 1.0  # how far below a curtain's edge its line goes on


@dataclass(frozen=True)
class Hairstyle:
    """One person's hair; lengths in distances between the eyes.

    ``line``: the hairline, (azimuth in degrees from the front, height) from front to back; ``volume`` at most, 0
    without hair; ``rise``, how far behind the line that is reached; ``ragged``, how far the line wanders; ``locks``,
    how much of the volume is in locks; ``swirl`` in radians, how far it is combed round; ``overhang``, how far it
    slides down over its line, in its thickness; ``hem``, the height down to which it hangs, if it does; ``beard``,
    ``moustache``, ``brows``: their volumes.
    """

    line: tuple[tuple[float, float], ...] = ()
    volume: float = 0.0
    rise: float = 0.2
    ragged: float = 0.03
    locks: float = 0.3
    swirl: float = 0.0
    overhang: float = 0.0
    hem: float | None = None
    beard: float = 0.0
    moustache: float = 0.0
    brows: float = 0.0
    seed: int = 0

    @classmethod
    def random(cls, rng: np.random.Generator) -> Hairstyle:
        """Draw a person's hair."""
        kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
        high = max(0.85, float(rng.normal(1.05, 0.12)))
        recess, fringe = rng.uniform(0.0, 0.15), rng.uniform(0.45, 0.75)
        front: tuple[tuple[float, float], ...] = ((0, high), (26, high + 0.02), (40, high - 0.1 + recess))
        sides: tuple[tuple[float, float], ...] = SIDES
        hem = None
        volume, rise, ragged, overhang = rng.uniform(0.1, 0.22), rng.uniform(0.25, 0.45), 0.03, 0.0
        if kind == "cropped":
            volume = rng.uniform(0.025, 0.06)
        if kind == "receding":
            front, volume = ((0, high + 0.15), (22, high + 0.35), (40, high + 0.2)), rng.uniform(0.04, 0.1)
        curtain = rng.uniform(60, 74)
        if kind == "long":
            hem = float(rng.uniform(-1.1, -0.6) if rng.random() < 0.4 else rng.uniform(-3.2, -1.4))
            sides = ((54, 0.75), (curtain - 3, 0.35), (curtain, -0.3), (curtain - 1, hem - HANGS))
            volume, rise = rng.uniform(0.15, 0.28), 0.2
        if kind == "fringe" or (kind == "long" and rng.random() < 0.25):
            front = ((0, fringe), (22, fringe - 0.02), (44, fringe - 0.06))
            sides = ((56, min(0.42, fringe - 0.1)), *sides[1 if kind == "long" else 2 :])
            volume, rise, ragged = rng.uniform(0.08, 0.16), 0.1, 0.07
            overhang = 0.7
        elif kind in ("short", "receding"):
            ragged = 0.045
        bald, hairy = kind == "bald", rng.random() < (0.02 if kind == "long" else 0.14)
        beard = float(rng.uniform(0.03, 0.1)) if hairy else 0.0
        moustache = float(rng.uniform(0.02, 0.05)) if hairy or rng.random() < 0.04 else 0.0
        return cls(
            line=() if bald else tuple((float(a), float(b)) for a, b in (*front, *sides, *(() if hem else NAPE))),
            volume=0.0 if bald else float(volume),
            rise=float(rise),
            ragged=ragged,
            locks=float(rng.uniform(0.25, 0.5)),
            swirl=float(rng.normal(0, 0.35)),
            overhang=overhang,
            hem=hem,
            beard=beard,
            moustache=moustache,
            brows=float(rng.uniform(0.01, 0.03)),
            seed=int(rng.integers(2**31)),
        )


BALD = Hairstyle()
SHORN = Hairstyle(((0, 1.0), (40, 1.0), *SIDES, *NAPE))
"""Paint without volume."""


def fall(reference: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth (radians, 0 in front, -pi to pi) and way from the crown (radians, below the widest part in girths) of
    points ``(P, 3)``: hair falls along the latter."""
    x, y, z = (reference - torch.tensor(CENTRE)).unbind(-1)
    around = torch.hypot(x, z)
    return torch.atan2(x, z), torch.atan2(around, y.clamp_min(0)) + (-y).clamp_min(0) / GIRTH


def strands(reference: Tensor, around: int, along: int, style: Hairstyle, octave: int = 0) -> Tensor:
    """Smooth noise ``(P,)`` of about unit variance at points ``(P, 3)``, drawn out along the hair: ``around`` bumps
    round the head, ``along`` from the crown down."""
    azimuth, way = fall(reference)
    generator = torch.Generator().manual_seed((style.seed + octave) % 2**31)
    lattice = torch.randn(along, around, generator=generator)
    lattice = torch.cat((lattice, lattice[:, :1]), 1)  # it goes round
    turned = (azimuth + style.swirl * way.clamp_max(2.0) + 0.04 * torch.sin(5 * way + style.seed % 7)) / (2 * math.pi)
    grid = torch.stack((2 * (turned % 1) - 1, way / 2.5 - 1), -1)[None, None]
    noise = torch.nn.functional.grid_sample(lattice[None, None], grid, padding_mode="border", align_corners=True)
    return 1.5 * noise[0, 0, 0] * (way / 0.5).clamp_max(1)  # at the crown all hair meets


def hair_depth(reference: Tensor, style: Hairstyle) -> Tensor:
    """How deep in the hair points ``(P, 3)`` of the average head lie ``(P,)``: the distance to the hairline, negative
    outside."""
    if not style.line:
        return torch.full_like(reference[:, 0], -10.0)
    azimuth, _ = fall(reference)
    grid = torch.stack((2 * azimuth.abs() / math.pi - 1, 2 * (reference[:, 1] - BOTTOM) / (TOP - BOTTOM) - 1), -1)
    depth = torch.nn.functional.grid_sample(
        _distance(style.line)[None, None], grid[None, None], padding_mode="border", align_corners=True
    )[0, 0, 0]
    return depth + style.ragged * strands(reference, 32, 5, style)


@lru_cache(maxsize=4)
def _distance(line: tuple[tuple[float, float], ...]) -> Tensor:
    """Signed distance to a hairline, laid out over azimuth (0 to pi) and height."""
    azimuth, height = np.meshgrid(np.linspace(0, np.pi, 128), np.linspace(BOTTOM, TOP, 160))
    corners = np.array(line) * (np.pi / 180, 1)
    place, ends = np.stack((GIRTH * azimuth, height), -1)[..., None, :], corners * (GIRTH, 1)
    way = ends[1:] - ends[:-1]
    part = (((place - ends[:-1]) * way).sum(-1) / (way**2).sum(-1)).clip(0, 1)
    distance = np.linalg.norm(place - ends[:-1] - part[..., None] * way, axis=-1).min(-1)
    behind = azimuth > corners[-1, 0]  # of a curtain
    rising = corners[: corners[:, 0].argmax() + 1]
    inside = (height > np.interp(azimuth, rising[:, 0], rising[:, 1])) | behind
    return torch.from_numpy(np.where(inside, distance, -distance).astype(np.float32))


def beard_cover(reference: Tensor, style: Hairstyle) -> tuple[Tensor, Tensor]:
    """Where beard and moustache are at points ``(P, 3)`` of the average head: ``(P,)`` each, 0 to 1."""
    x, y, z = reference.unbind(-1)
    side = x.abs() + 0.02 * strands(reference, 90, 40, style, 2)
    lips = torch.hypot(side / 0.5, (y + 1.1) / 0.21)
    cheek = -0.95 + 0.65 * ((side - 0.5) / 0.45).clamp(0, 1) - y
    beard = (
        step(cheek, 0, 0.1) * step(y + 1.95 - 0.5 * side, 0, 0.2) * step(z + 0.82, 0, 0.15) * step(lips - 1.15, 0, 0.2)
    )
    moustache = step(0.11 - (y + 0.87 + 0.3 * side.square()).abs(), 0, 0.05) * step(0.52 - side, 0, 0.1) * (z > 0)
    return beard, moustache * step(lips - 0.9, 0, 0.15)


def strand_albedo(darkness: float) -> float:
    """Albedo of hair of a ``darkness`` from 0, blond, to 1, black."""
    return 0.02 + 0.45 * (1 - darkness) ** 2


def tint(albedo: Tensor, reference: Tensor, hangs: Tensor, style: Hairstyle, darkness: float) -> Tensor:
    """Paint hair over skin of ``albedo (P,)``, 0 to 1.

    ``hangs (P,)``: 1 where hair hangs free of the head; ``darkness`` 0 to 1.
    """
    if not style.line and not style.beard and not style.moustache:
        return albedo
    depth = hair_depth(reference, style) + 0.025 * strands(reference, 200, 16, style, 1)
    cover = step(depth, 0, 0.05)
    if style.hem is not None:  # hair hangs over the neck, it does not grow there
        cover = cover * step(reference[:, 1] + 0.9, 0, 0.2)
    cover = torch.maximum(cover, step(hangs - 0.4, 0, 0.3))
    if style.beard or style.moustache:
        beard, moustache = beard_cover(reference, style)
        cover = torch.maximum(cover, torch.maximum(beard * (style.beard > 0), moustache * (style.moustache > 0)))
    streaks = 0.17 * strands(reference, 90, 9, style, 3) + 0.2 * strands(reference, 280, 24, style, 4)
    hair = strand_albedo(darkness) * torch.exp(streaks)
    roots = torch.maximum((depth > -0.1).float(), hangs)  # lie in the shade of the hair above
    hair = hair * (1 - (0.25 + 0.15 * hangs) * roots * (1 - depth / 0.2).clamp(0, 1))
    return torch.lerp(albedo, hair, cover)
