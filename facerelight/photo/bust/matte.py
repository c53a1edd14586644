"""Which pixels of a photograph show the person: a small network's answer, sharpened along the photograph's own edges.

The network (MediaPipe's selfie segmentation, run by OpenCV) sees the bust at 256 x 256, twice, once mirrored. A colour
guided filter (He, Sun and Tang 2010) takes its answer to the edges. Where the network cannot be read, GrabCut answers,
seeded by where head and shoulders should be.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from facerelight.photo.bust.frame import Window, blur, compose, smooth_step
from facerelight.photo.colour import most_channel
from facerelight.photo.networks import SELFIE_SEGMENTATION, network_path

__all__ = ["coarse_cover", "ground_behind", "person_matte", "sharpened_matte"]

NETWORK_SIZE = (256, 256)
NEAR, AWAY = (4.6, 3.6, 6.2), 0.8  # units to each side, above and below the eyes; over which what is farther takes over
RADIUS = 0.10  # of the guided filter, in units
TIGHT = (0.1, 0.95)  # of the filtered cover: what is nearly background is background, so that no light spills on it
COARSE = 40.0  # pixels a unit of the copy on which the ground is averaged
GROUND = (0.5, 0.1)  # units around in which the ground behind a person is looked for, far and near
THROUGH = 0.4  # units around in which the ground is looked at
DIFFERS = (0.05, 0.1)  # of the ground's level: a colour this near is the ground's
VARIES = (0.06, 0.1)  # of its level: a ground that varies more is not plain
FLAT, BLANK = 1, 0.01  # grey levels that one colour varies by; share of the picture that is worth a look
RINGING, ALIKE = 8, 24.0  # pixels around it, and grey levels, within which compression left traces of it
SEEN = 0.4  # of the face at least, else the network has not seen the person
EDGE = 1e-4 * 255**2  # variance of colour, in grey levels, that counts as an edge


def person_matte(image: np.ndarray, window: Window) -> np.ndarray:
    """Cover of the person in 0..1, ``(h, w)`` float32.

    Args:
        image: ``(h, w, 3)`` uint8 sRGB, the window's copy.
        window: where the bust lies in it.
    """
    return sharpened_matte(coarse_cover(image, window), image, window)


def coarse_cover(image: np.ndarray, window: Window) -> np.ndarray:
    """What the network says, ``(h, w)`` float32 in 0..1, blurred at the person's edges; GrabCut where it cannot be
    read. Arguments as for :func:`person_matte`."""
    try:
        return _network_cover(image, window)
    except (cv2.error, RuntimeError):
        return _grabcut_cover(image, window)


def sharpened_matte(cover: np.ndarray, image: np.ndarray, window: Window) -> np.ndarray:
    """The coarse ``cover (h, w)`` taken to the edges of ``image``, and off what is ground; ``(h, w)`` float32 in
    0..1."""
    x, y = window.places()
    oval = np.hypot(x, (y + 0.42) / 1.42)  # of the face, 1 on its outline
    if float(cover[oval < 0.7].mean()) < SEEN:  # no person where the face is: the face alone
        rim = np.clip((1 - oval) / 0.4, 0, 1)
        return smooth_step(rim).astype(np.float32)
    cover = np.clip((cover - 0.5) * 1.6 + 0.5, 0, 1).astype(np.float32)
    fine = cv2.ximgproc.guidedFilter(image, cover, max(2, int(RADIUS * window.unit)), EDGE)
    cover = np.clip((fine - TIGHT[0]) / (TIGHT[1] - TIGHT[0]), 0, 1)
    beyond = np.clip((oval - 1.15) / 0.15, 0, 1)  # the face itself is never the ground
    cover *= 1 - beyond * _blank(image, window)
    return (cover * (1 - beyond * _seen_through(image, cover, window))).astype(np.float32)


def ground_behind(scene: np.ndarray, cover: np.ndarray, unit: float) -> np.ndarray:
    """The radiance ``(h, w, 3)`` of what is behind a person: an average of the uncovered pixels around, from near where
    there are some (blur fusion, Forte 2021)."""
    scale = min(1.0, COARSE / unit)
    small, hidden = (cv2.resize(map, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for map in (scene, cover))
    bare = np.clip(1 - 5 * hidden, 0, 1)[..., None]
    ground = np.zeros_like(small)
    for reach in GROUND:
        weight = blur(bare, reach * unit * scale).reshape(bare.shape)
        near = blur(small * bare, reach * unit * scale) / np.maximum(weight, 1e-4)
        share = np.clip(weight / 0.02, 0, 1)
        ground = share * near + (1 - share) * ground
    return cv2.resize(ground.astype(np.float32), cover.shape[::-1], interpolation=cv2.INTER_LINEAR)


def _seen_through(image: np.ndarray, cover: np.ndarray, window: Window) -> np.ndarray:
    """1 where hair has the colour of a plain ground behind it, ``(h, w)`` float32: gaps between strands, which are too
    fine for the network."""
    coded, bare, reach = image.astype(np.float32) / 255, np.square(1 - cover), THROUGH * window.unit
    weight = blur(bare, reach)
    mean, square = (
        blur(values * bare[..., None], reach) / np.maximum(weight, 1e-4)[..., None] for values in (coded, coded**2)
    )
    level = ground_behind(coded, cover, window.unit)
    scale = most_channel(level) + 0.2  # what differs little in the dark differs as little in the light
    varies = np.sqrt(np.maximum(most_channel(square - mean**2), 0)) / scale
    differs = most_channel(np.abs(coded - level)) / scale
    differs = np.maximum(differs, blur(differs, 0.02 * window.unit))
    alike = np.clip((DIFFERS[1] - differs) / (DIFFERS[1] - DIFFERS[0]), 0, 1)
    plain = np.clip((VARIES[1] - varies) / (VARIES[1] - VARIES[0]), 0, 1)
    above_shoulders = np.clip((window.places()[1] + 1.6) / 0.4, 0, 1)
    return alike * plain * above_shoulders * np.clip(weight / 0.03, 0, 1)


def _blank(image: np.ndarray, window: Window) -> np.ndarray:
    """1 on areas of one colour that reach the picture's border, ``(h, w)`` float32: paper, clipped sky, a cut-out's
    ground. What has the colour of one above the eyes is no clothes."""
    square: np.ndarray = np.ones((3, 3), np.uint8)
    flat = most_channel(cv2.dilate(image, square) - cv2.erode(image, square)) <= FLAT
    _, labels, found, _ = cv2.connectedComponentsWithStats(flat.astype(np.uint8))
    border = np.ones(flat.shape, bool)
    border[1:-1, 1:-1] = False
    above = border & (window.places()[1] > 0)
    large = found[:, cv2.CC_STAT_AREA] > BLANK * flat.size
    large[0] = False
    colours = {one: image[labels == one].mean(0) for one in np.unique(labels[border]) if large[one]}
    grounds = [colours[one] for one in np.unique(labels[above]) if large[one]]
    plain = [one for one, own in colours.items() if any(np.abs(own - ground).max() < FLAT + 1 for ground in grounds)]
    blank = np.isin(labels, plain).astype(np.float32)
    if not plain:
        return blank
    near = cv2.dilate(blank, np.ones((2 * RINGING + 1,) * 2, np.uint8)) > 0
    colour = blur(image * blank[..., None], RINGING) / np.maximum(blur(blank, RINGING), 1e-3)[..., None]
    alike = near & (most_channel(np.abs(image - colour)) < ALIKE)  # compression rings along its edge
    return blur(np.maximum(blank, alike), 0.7)


@lru_cache(maxsize=1)
def _network() -> cv2.dnn.Net:
    return cv2.dnn.readNetFromTFLite(str(network_path(SELFIE_SEGMENTATION)))


def _network_cover(image: np.ndarray, window: Window) -> np.ndarray:
    """The network's cover: it sees head and shoulders, and once more, less finely, what goes on beyond them."""
    x, y = window.places()
    beyond = max(float(np.abs(x).max()) - NEAR[0], float(y.max()) - NEAR[1], -float(y.min()) - NEAR[2])
    near = _seen_by_network(image, window, NEAR)
    if beyond < AWAY:
        return near
    inside = np.minimum(NEAR[0] - np.abs(x), np.minimum(NEAR[1] - y, NEAR[2] + y)) / AWAY
    share = np.clip(inside, 0, 1).astype(np.float32)
    return share * near + (1 - share) * _seen_by_network(image, window, (np.inf, np.inf, np.inf))


def _seen_by_network(image: np.ndarray, window: Window, reach: tuple[float, float, float]) -> np.ndarray:
    """The network's answer to the window as far as ``reach`` (units to each side, above and below the eyes), seen
    upright, as it is and mirrored; the mean of both."""
    to_network = _upright(window, reach)
    upright = cv2.warpAffine(image, to_network, NETWORK_SIZE, flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REPLICATE)
    network, covers = _network(), []
    for mirrored in (False, True):
        seen = np.ascontiguousarray(upright[:, ::-1] if mirrored else upright)
        network.setInput(cv2.dnn.blobFromImage(seen, 1 / 255))
        cover = network.forward()[0, 0]
        covers.append(cover[:, ::-1] if mirrored else cover)
    back = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(
        np.mean(covers, 0).astype(np.float32),
        to_network,
        window.size[::-1],
        flags=back,
        borderMode=cv2.BORDER_REPLICATE,
    ).clip(0, 1)


def _upright(window: Window, reach: tuple[float, float, float]) -> np.ndarray:
    """``(2, 3)``: the copy's pixels to those of the network, which fill the upright rectangle around the copy, as far
    as ``reach``."""
    height, width = window.size
    corners = np.array([(x, y) for x in (-0.5, width - 0.5) for y in (-0.5, height - 0.5)])
    corners = corners @ window.to_bust[:, :2].T + window.to_bust[:, 2]
    low = np.maximum(corners.min(0), (-reach[0], -reach[2]))
    high = np.minimum(corners.max(0), (reach[0], reach[1]))
    scale = np.array((NETWORK_SIZE[0] / (high[0] - low[0]), NETWORK_SIZE[1] / (high[1] - low[1])))
    to_network = np.array([[scale[0], 0, -0.5 - low[0] * scale[0]], [0, -scale[1], high[1] * scale[1] - 0.5]])
    return compose(to_network, window.to_bust)


def _grabcut_cover(image: np.ndarray, window: Window) -> np.ndarray:
    """GrabCut's cover (Rother, Kolmogorov and Blake 2004), seeded by an upright head and shoulders."""
    height, width = window.size
    x, y = window.places()
    seeds: np.ndarray = np.full((height, width), cv2.GC_BGD, np.uint8)
    seeds[(np.hypot(x / 2.2, (y + 0.1) / 2.6) < 1) | ((np.abs(x) < 4.2) & (y < -1.7 - 0.15 * np.abs(x)))] = (
        cv2.GC_PR_BGD
    )
    near = (
        (np.hypot(x / 1.35, y / 2.0) < 1)
        | ((np.abs(x) < 1.0) & (y < 0))
        | ((np.abs(x) < 3.0) & (y < -3.2 - 0.2 * np.abs(x)))
    )
    seeds[near] = cv2.GC_PR_FGD
    sure = (
        (np.hypot(x / 0.95, (y + 0.42) / 1.35) < 1)
        | ((np.abs(x) < 0.6) & (y < -1) & (y > -2.6))
        | ((np.abs(x) < 1.4) & (y < -4))
    )
    seeds[sure] = cv2.GC_FGD
    scale = min(1.0, 360 / max(height, width))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    seeds = cv2.resize(seeds, small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    cv2.setRNGSeed(0)
    nowhere = (0, 0, 1, 1)  # seeds alone count
    cv2.grabCut(
        np.ascontiguousarray(small[..., ::-1]),
        seeds,
        nowhere,
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        5,
        cv2.GC_INIT_WITH_MASK,
    )
    cover = ((seeds == cv2.GC_FGD) | (seeds == cv2.GC_PR_FGD)).astype(np.float32)
    return cv2.resize(cv2.GaussianBlur(cover, (0, 0), 1), (width, height), interpolation=cv2.INTER_LINEAR)
