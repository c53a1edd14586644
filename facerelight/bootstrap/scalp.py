"""Hair as geometry: a second surface over the scalp, raised by the hair's thickness; beards and brows lift the skin."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d, maximum_filter
from scipy.spatial import cKDTree

from facerelight.bootstrap.features import BROW, brow_arc
from facerelight.bootstrap.hair import CENTRE, GIRTH, Hairstyle, beard_cover, fall, hair_depth, strands
from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.noise import bump

if TYPE_CHECKING:
    from facerelight.bootstrap.skin import Look

__all__ = ["Scalp", "grow_hair"]

COLUMNS = 80  # around the head, closer in front
STEP = 0.085  # between rows
LOWEST = -3.3  # height of the last row
SUNK = 0.3  # where no hair is, the surface lies up to that far under the skin
ROOTS = 0.03  # so far behind the hairline hair begins to rise
HANG = 0.12  # hair that hangs comes in by so much a unit
ROUND = 0.22  # the free edge of hanging hair is rounded over that width


class Scalp(NamedTuple):
    """Where the nodes of the hair's surface, in rows from the crown down and columns round the head ``(R, C)``, lie on
    the average head.

    ``corners (R, C, 3)``, a node's triangle, and ``weights (R, C, 3)`` in it, 0 where no head is; ``axis (R, 3)`` and
    ``outward (R, C, 3)``: where hair is counted from and which way; ``radius (R, C)`` on the average head.
    """

    corners: np.ndarray
    weights: np.ndarray
    axis: np.ndarray
    outward: np.ndarray
    radius: np.ndarray

    @classmethod
    def fit(cls, head: Head) -> Scalp:
        """Find the nodes on the average head of ``head``; the same for all heads of a source."""
        turn = np.linspace(-1, 1, COLUMNS, endpoint=False)
        azimuth = np.pi * (0.72 * turn + 0.28 * turn**3)
        upper = np.linspace(0.02, np.pi / 2, 19)
        lower = np.arange(STEP, CENTRE[1] - LOWEST, STEP)
        way = np.concatenate((upper, np.pi / 2 + lower / GIRTH))
        axis = np.array(CENTRE) - np.concatenate((np.zeros(len(upper)), lower))[:, None] * (0, 1, 0)
        tilt = np.minimum(way, np.pi / 2)[:, None]
        level = np.sin(tilt)
        outward = np.stack((level * np.sin(azimuth), np.repeat(np.cos(tilt), COLUMNS, 1), level * np.cos(azimuth)), -1)
        # the head rolled out: direction from the crown, way from it
        corners, weights = _locate(head, way[:, None, None] * np.stack((np.sin(azimuth), np.cos(azimuth)), -1))
        place = (weights[..., None] * head.reference[corners]).sum(-2)
        radius = ((place - axis[:, None]) * outward).sum(-1) * (weights.sum(-1) > 0)
        return cls(corners, weights, axis, outward, radius)


def _locate(head: Head, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The outermost triangles of the average head at ``nodes (R, C, 2)`` of its map, and weights of their corners."""
    skin = head.triangles[(head.is_eye[head.triangles] < 0.5).all(1)]
    azimuth, way = (a.numpy() for a in fall(torch.from_numpy(head.reference).float()))
    corner = (way[:, None] * np.stack((np.sin(azimuth), np.cos(azimuth)), 1))[skin]  # (T, 3, 2)
    a, b, c = corner[:, 0], corner[:, 1], corner[:, 2]
    area = _cross(b - a, c - a)
    middle = corner.mean(1)
    reach = np.linalg.norm(corner - middle[:, None], axis=2).max(1)
    flat = nodes.reshape(-1, 2)
    near = cKDTree(flat).query_ball_point(middle, reach)
    node = np.fromiter((n for found in near for n in found), int)
    which = np.repeat(np.arange(len(skin)), [len(found) for found in near])
    p, t = flat[node], which
    v, w = _cross(p - a[t], c[t] - a[t]) / area[t], _cross(b[t] - a[t], p - a[t]) / area[t]
    weight = np.stack((1 - v - w, v, w), 1)
    height = np.linalg.norm((head.reference[skin[t]].mean(1) - CENTRE) * (1, 0.01, 1), axis=1)
    inside = np.flatnonzero((weight > -1e-6).all(1))
    inside = inside[np.argsort(height[inside])]  # the outermost comes last and stays
    corners, weights = np.zeros((len(flat), 3), int), np.zeros((len(flat), 3))
    corners[node[inside]], weights[node[inside]] = skin[t[inside]], weight[inside]
    return corners.reshape(*nodes.shape[:2], 3), weights.reshape(*nodes.shape[:2], 3)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def grow_hair(head: Head, scalp: Scalp, look: Look) -> Head:
    """A head with its hair, beard and brows in volume; bald and shaven it stays as it is.

    The hair's vertices come after the head's own; their ``is_eye`` is 0, and -1 where hair hangs free of the head.
    """
    grown = _lift_skin(head, look)
    style = look.style
    if not style.line:
        return grown
    on_head = scalp.weights.sum(-1) > 0
    base = (scalp.weights[..., None] * grown.vertices[scalp.corners]).sum(-2) - scalp.axis[:, None]
    average = scalp.radius.copy()
    for row in range(1, len(base)):  # below an open neck
        base[row], average[row] = (
            np.where(on_head[row, :, None], base[row], base[row - 1]),
            np.where(on_head[row], average[row], average[row - 1]),
        )
    radius = (base * scalp.outward).sum(-1)
    aside = base - radius[..., None] * scalp.outward
    own = scalp.axis[:, None] + average[..., None] * scalp.outward
    flat = torch.from_numpy(own.reshape(-1, 3)).float()
    depth = hair_depth(flat, style).numpy().reshape(radius.shape)
    locks = strands(flat, 36, 5, style, 5).numpy().reshape(radius.shape)
    full = ((depth - ROOTS) / style.rise).clip(0, 1)
    thickness = style.volume * full * (2 - full) * (1 + style.locks * locks).clip(0.2)
    hangs, height = np.zeros(radius.shape, np.float32), np.repeat(scalp.axis[:, 1:2], radius.shape[1], 1)
    # outside it dips as steeply as it rises: it meets the skin where it is painted
    dip = (2 * style.volume / style.rise * (depth - ROOTS)).clip(-SUNK, 0)
    outer = radius + thickness + dip
    if style.hem is None:
        outer -= 0.5 * thickness * (1 - ((own[..., 1] - 0.5) / 0.7).clip(0, 1))  # the sides are shorter
    else:
        hanging = _hang(radius, thickness, depth, -np.diff(scalp.axis[:, 1], prepend=scalp.axis[0, 1]))
        lifted = (hanging > np.maximum(outer, radius)) & (own[..., 1] < 0.6)
        hangs = maximum_filter(lifted, (3, 3), mode=("nearest", "wrap")).astype(np.float32)
        own = own + (hangs * (hanging - outer).clip(0))[..., None] * scalp.outward
        outer = np.maximum(outer, hanging)
        height = np.maximum(height, style.hem + 0.08 * strands(flat, 12, 5, style, 6).numpy().reshape(radius.shape))
    axis = np.stack(np.broadcast_arrays(CENTRE[0], height, CENTRE[2]), -1)
    vertices = axis + aside + outer[..., None] * scalp.outward
    kept = maximum_filter((depth > 0) | (outer > radius), (3, 3), mode=("nearest", "wrap"))
    above = height == scalp.axis[:, 1:2]  # the end
    index = np.arange(radius.size).reshape(radius.shape)
    square = np.stack([np.roll(index, (-i, -j), (0, 1)) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], -1)[:-1]
    square = square[kept.ravel()[square].all(-1) & above.ravel()[square].any(-1)] + len(head.vertices)
    bare = ~_covered(head, style)
    return Head(
        np.concatenate((grown.vertices, vertices.reshape(-1, 3))),
        np.concatenate((head.triangles[bare], square[:, [0, 1, 2]], square[:, [0, 2, 3]])),
        np.concatenate((head.reference, own.reshape(-1, 3))),
        np.concatenate((head.is_eye, -hangs.ravel())),
        head.landmarks,
    )


def _covered(head: Head, style: Hairstyle) -> np.ndarray:
    """Triangles of scalp and ears ``(T,)`` that nobody sees for hair."""
    reference = torch.from_numpy(np.asarray(head.reference, np.float32))
    way = fall(reference)[1]
    deep = (hair_depth(reference, style) > 0.15) & (reference[:, 1] > -0.8) & (way > 0.2)
    if style.hem is not None:
        deep &= reference[:, 1] > style.hem + 0.4
    return deep.numpy()[head.triangles].all(1)


def _hang(radius: np.ndarray, thickness: np.ndarray, depth: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """How far out hair is that hangs over the ears and beside the neck; at its front edge it turns in to the skin."""
    over = maximum_filter(np.where(depth > 0, radius, 0.0), (5, 5), mode=("nearest", "wrap"))
    over = gaussian_filter1d(gaussian_filter1d(over, 1.2, axis=0, mode="nearest"), 1.2, axis=1, mode="wrap")
    hanging = np.where(depth > 0.1, over, radius) + thickness
    for row in range(1, len(drop)):
        hanging[row] = np.maximum(hanging[row], hanging[row - 1] - HANG * drop[row])
    edge = 1 - (depth / ROUND).clip(0, 1)
    return hanging - 0.25 * edge**2 - 4 * (0.05 - depth).clip(0)


def _lift_skin(head: Head, look: Look) -> Head:
    """Raise the skin under beard, moustache and brows, along its normals."""
    style, reference = look.style, torch.from_numpy(np.asarray(head.reference, np.float32))
    if not (style.beard or style.moustache or style.brows):
        return head
    beard, moustache = beard_cover(reference, style)
    side, y = reference[:, 0].abs(), reference[:, 1]
    arc = brow_arc(side, look.brow_height)
    brow = bump(y - arc, look.brow_width) * ((side > BROW[0]) & (side < BROW[1]))
    lift = torch.maximum(torch.maximum(style.beard * beard, style.moustache * moustache), style.brows * brow)
    lift = (lift * (reference[:, 2] > -1)).numpy() * (head.is_eye < 0.5)
    return head._replace(vertices=head.vertices + lift[:, None] * head.normals())
