"""Hair as geometry: a second surface over the scalp, raised by the hair's thickness; beards and brows lift the skin."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree
from torch import Tensor

from facerelight.bootstrap.heads import Head
from facerelight.bootstrap.look.features import brows
from facerelight.bootstrap.look.hair import CENTRE, GIRTH, Hairstyle, beard_cover, fall, hair_depth, strands
from facerelight.bootstrap.look.skin import Look

__all__ = ["Scalp", "grow_hair"]

COLUMNS = 80  # around the head, closer in front
STEP = 0.085  # between rows
LOWEST = -3.3  # height of the last row
SUNK = 0.3  # where no hair is, the surface lies up to that far under the skin
ROOTS = 0.05  # so far behind the hairline hair begins to rise
INWARD = 0.12  # hair that hangs comes in by so much a unit
TEMPLES = 0.6  # height below which hair can hang free
ROUND = 0.22  # the free edge of hanging hair is rounded over that width


class Scalp(NamedTuple):
    """The hair's nodes on the average head, in rows from the crown down and columns round the head.

    ``corners (R, C, 3)``: the triangle that a node lies in, and ``weights (R, C, 3)`` of its corners; ``axis (R, 3)``
    and ``outward (R, C, 3)``: where a row is counted from and which way; ``anchor (R, C, 3)``: the same for the place
    in the triangle, which below an open neck is that of the last row; ``radius (R, C)`` on the average head.
    """

    corners: np.ndarray
    weights: np.ndarray
    axis: np.ndarray
    outward: np.ndarray
    anchor: np.ndarray
    radius: np.ndarray

    @classmethod
    def fit(cls, head: Head) -> Scalp:
        """Find the nodes on the average head of ``head``; they are the same for all heads of a source.

        Raises:
            ValueError: the head has no skin where hair grows.
        """
        turn = np.linspace(-1, 1, COLUMNS, endpoint=False)
        azimuth = np.pi * (0.72 * turn + 0.28 * turn**3)
        upper = np.linspace(0.02, np.pi / 2, 19)
        lower = np.arange(STEP, CENTRE[1] - LOWEST, STEP)
        way = np.concatenate((upper, np.pi / 2 + lower / GIRTH))
        axis = np.array(CENTRE) - np.concatenate((np.zeros(len(upper)), lower))[:, None] * (0, 1, 0)
        tilt = np.minimum(way, np.pi / 2)[:, None]
        level = np.sin(tilt)
        outward = np.stack((level * np.sin(azimuth), np.repeat(np.cos(tilt), COLUMNS, 1), level * np.cos(azimuth)), -1)
        # the head rolled out flat: the direction from the crown, and the way
        corners, weights = _locate(head, way[:, None, None] * np.stack((np.sin(azimuth), np.cos(azimuth)), -1))
        on_head = weights.sum(-1) > 0
        if not on_head[0].all():
            raise ValueError("head: expected skin at the crown, above and behind the eyes, got a mesh without")
        anchor = np.repeat(axis[:, None], COLUMNS, 1)
        for row in range(1, len(way)):
            for values in (corners, weights, anchor):
                values[row] = np.where(on_head[row, :, None], values[row], values[row - 1])
        radius = (((weights[..., None] * head.reference[corners]).sum(-2) - anchor) * outward).sum(-1)
        return cls(corners, weights, axis, outward, anchor, radius)


def _locate(head: Head, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The outermost triangles of the average head at ``nodes (R, C, 2)`` of its map, and weights of their corners,
    ``(R, C, 3)`` each."""
    skin = head.triangles[(head.is_eye[head.triangles] < 0.5).all(1)]
    azimuth, way = (a.numpy() for a in fall(_points(head.reference)))
    corner = (way[:, None] * np.stack((np.sin(azimuth), np.cos(azimuth)), 1))[skin]  # (T, 3, 2)
    middle = corner.mean(1)
    reach = np.linalg.norm(corner - middle[:, None], axis=2).max(1)
    flat = nodes.reshape(-1, 2)
    near = cKDTree(flat).query_ball_point(middle, reach)
    node = np.fromiter((n for found in near for n in found), int)
    which = np.repeat(np.arange(len(skin)), [len(found) for found in near])
    along, across = corner[which, 1] - corner[which, 0], corner[which, 2] - corner[which, 0]
    place = flat[node] - corner[which, 0]
    with np.errstate(divide="ignore", invalid="ignore"):  # triangles seen edge on hold no node
        v, w = _cross(place, across) / _cross(along, across), _cross(along, place) / _cross(along, across)
    weight = np.stack((1 - v - w, v, w), 1)
    inside = np.flatnonzero((weight > -1e-6).all(1))
    height = np.linalg.norm((head.reference[skin[which[inside]]].mean(1) - CENTRE) * (1, 0.01, 1), axis=1)
    inside = inside[np.argsort(height, kind="stable")]  # the outermost comes last and stays
    corners, weights = np.zeros((len(flat), 3), int), np.zeros((len(flat), 3))
    corners[node[inside]], weights[node[inside]] = skin[which[inside]], weight[inside]
    return corners.reshape(*nodes.shape[:2], 3), weights.reshape(*nodes.shape[:2], 3)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def _points(reference: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(reference, np.float32).reshape(-1, 3))


def grow_hair(head: Head, scalp: Scalp, look: Look) -> Head:
    """A head with its hair, beard and brows in volume; who is bald and shaven stays as he is.

    The hair's vertices come after the head's own, with an ``is_eye`` of 0, or of -1 where hair hangs free of the head;
    what nobody sees of scalp and ears is left out of the triangles.
    """
    head, style = _lift_skin(head, look), look.style
    if not style.line:
        return head
    base = (scalp.weights[..., None] * head.vertices[scalp.corners]).sum(-2) - scalp.anchor
    radius = (base * scalp.outward).sum(-1)
    reference = scalp.axis[:, None] + scalp.radius[..., None] * scalp.outward
    points = _points(reference)
    depth, locks, ends = (
        values.numpy().reshape(radius.shape)
        for values in (hair_depth(points, style), strands(points, 36, 5, style, 5), strands(points, 12, 5, style, 6))
    )
    full = ((depth - ROOTS) / style.rise).clip(0, 1)
    thickness = style.volume * full * (2 - full) * (1 + style.locks * locks).clip(0.2)
    # outside it dips as steeply as it rises: it meets the skin where the paint says that hair begins
    dip = (2 * style.volume / style.rise * (depth - ROOTS)).clip(-SUNK, 0)
    height, free = np.repeat(scalp.axis[:, 1:2], radius.shape[1], 1), np.zeros(radius.shape)
    if style.hem is None:
        sides = 1 - 0.5 * (1 - ((reference[..., 1] - 0.5) / 0.7).clip(0, 1))  # cut shorter
        outer = radius + sides * thickness + dip
    else:
        hanging = _hang(radius, thickness, depth, -np.diff(scalp.axis[:, 1], prepend=scalp.axis[0, 1]))
        outer = np.maximum(hanging, radius + thickness + dip)
        free = _around((outer > radius) & (reference[..., 1] < TEMPLES), 3).astype(float)
        reference = reference + (free * (outer - radius - thickness - dip))[..., None] * scalp.outward
        height = np.maximum(height, style.hem + 0.2 * ends)
    axis = np.stack(np.broadcast_arrays(CENTRE[0], height, CENTRE[2]), -1)
    vertices = axis + base + (outer - radius)[..., None] * scalp.outward
    vertices[..., 1] -= (
        style.overhang * thickness * np.exp(-((depth / 0.25) ** 2)) * (reference[..., 1] / 0.3).clip(0, 1)
    )
    kept, above = _around((depth > 0) | (outer > radius), 3), height == scalp.axis[:, 1:2]
    index = np.arange(radius.size).reshape(radius.shape)
    square = np.stack([np.roll(index, (-i, -j), (0, 1)) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], -1)[:-1]
    square = square[kept.ravel()[square].all(-1) & above.ravel()[square].any(-1)] + len(head.vertices)
    return Head(
        np.concatenate((head.vertices, vertices.reshape(-1, 3))),
        np.concatenate((head.triangles[~_covered(head, style)], square[:, [0, 1, 2]], square[:, [0, 2, 3]])),
        np.concatenate((head.reference, reference.reshape(-1, 3))),
        np.concatenate((head.is_eye, -free.ravel().astype(np.float32))),
        head.landmarks,
    )


def _hang(radius: np.ndarray, thickness: np.ndarray, depth: np.ndarray, drop: np.ndarray) -> np.ndarray:
    """How far out hair is that hangs over the ears and beside the neck; at its front edge it turns in to the skin."""
    over = gaussian_filter(_around(np.where(depth > 0, radius, 0.0), 5), 1.2, mode=("nearest", "wrap"))
    hanging = np.where(depth > 0.1, over, radius) + thickness
    for row in range(1, len(drop)):
        hanging[row] = np.maximum(hanging[row], hanging[row - 1] - INWARD * drop[row])
    edge = 1 - (depth / ROUND).clip(0, 1)
    return hanging - 0.25 * edge**2 - 4 * (ROOTS - depth).clip(0)


def _around(values: np.ndarray, nodes: int) -> np.ndarray:
    return maximum_filter(values, (nodes, nodes), mode=("nearest", "wrap"))


def _covered(head: Head, style: Hairstyle) -> np.ndarray:
    """Triangles of scalp and ears ``(T,)`` that lie deep under hair."""
    reference = _points(head.reference)
    lowest = -0.8 if style.hem is None else max(-0.8, style.hem + 0.4)
    deep = (hair_depth(reference, style) > 0.15) & (reference[:, 1] > lowest) & (fall(reference)[1] > 0.2)
    return deep.numpy()[head.triangles].all(1)


def _lift_skin(head: Head, look: Look) -> Head:
    """Raise the skin under beard, moustache and brows, along its normals."""
    style, reference = look.style, _points(head.reference)
    if not (style.beard or style.moustache or style.brows):
        return head
    beard, moustache = beard_cover(reference, style)
    y = reference[:, 1]
    brow = brows(reference, look.brow_height, look.brow_width) * ((y - 0.12) / 0.06).clamp(0, 1)  # not the lid
    most = torch.maximum(torch.maximum(style.beard * beard, style.moustache * moustache), style.brows * brow)
    lift = most.numpy() * (head.reference[:, 2] > -1) * (head.is_eye < 0.5)
    lifted = head.triangles[(lift[head.triangles] > 1e-3).any(1)]
    return head._replace(vertices=head.vertices + lift[:, None] * head._replace(triangles=lifted).normals())
