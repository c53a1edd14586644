"""The bust's own coordinates, and the window of the photograph that is worked on.

Bust coordinates: the origin midway between the eyes, one unit the distance between them, x to image-right, y up, the
eyes level. Whatever is not photograph (heights, normals, shading) lives on grids of these coordinates; the photograph's
part is a window around the bust.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from facerelight.geometry.alignment import CropFrame

__all__ = [
    "BUST",
    "FINE",
    "LARGEST_SIDE",
    "Grid",
    "Window",
    "between",
    "blur",
    "crop_onto",
    "smooth_step",
    "working_window",
]


@dataclass(frozen=True)
class Grid:
    """A raster of bust coordinates: x in ``[-side, side]``, y from ``top`` down to ``bottom``, ``density`` pixels a
    unit."""

    side: float
    top: float
    bottom: float
    density: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return round((self.top - self.bottom) * self.density), round(2 * self.side * self.density)

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of every pixel, ``(H, W)`` float32 each."""
        height, width = self.size
        x = (np.arange(width, dtype=np.float32) + 0.5) / self.density - self.side
        y = self.top - (np.arange(height, dtype=np.float32) + 0.5) / self.density
        return np.broadcast_to(x, (height, width)), np.broadcast_to(y[:, None], (height, width))

    def matrix(self) -> np.ndarray:
        """``(2, 3)``: bust coordinates to pixels of this grid."""
        return np.array(
            [[self.density, 0, self.side * self.density - 0.5], [0, -self.density, self.top * self.density - 0.5]]
        )


BUST = Grid(4.5, 3.5, -6.5, 24)
"""The whole bust, fine enough for its shape and for soft light."""
FINE = Grid(4.5, 3.5, -6.5, 64)
"""The same, fine enough for the edges of shadows and for the face."""
REACH = (6.0, 3.6, 11.0)  # of the window, in units: to each side, above and below the eyes
FADE = (2.4, 5.0)  # units over which the window ends at its sides and below
WIDE = 8.0  # pixels: wider blurs are done on smaller maps
LARGEST_SIDE = 960  # pixels of the window at which maps are made


@dataclass(frozen=True)
class Window:
    """The part of a photograph that holds the bust, and the smaller copy on which maps are made.

    ``rows`` and ``columns``: the part, in pixels of the photograph; ``size``: height and width of the copy; ``to_bust
    (2, 3)``: pixels of the copy to bust coordinates; ``unit``: pixels of the copy for one unit; ``crop``: the model's
    crop; ``to_crop (2, 3)``: copy to crop.
    """

    rows: slice
    columns: slice
    size: tuple[int, int]
    to_bust: np.ndarray
    to_crop: np.ndarray
    unit: float
    crop: CropFrame

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """x and y of every pixel of the copy in bust coordinates, ``(h, w)`` float32 each; do not write into them."""
        return self._places

    @cached_property
    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        column, row = np.arange(self.size[1], dtype=np.float64), np.arange(self.size[0], dtype=np.float64)[:, None]
        x, y = (self.to_bust[k, 0] * column + (self.to_bust[k, 1] * row + self.to_bust[k, 2]) for k in range(2))
        return x.astype(np.float32), y.astype(np.float32)

    def fade(self) -> np.ndarray:
        """1 on the bust, going over into 0 towards the window's ends, ``(h, w)``: a person may go on beyond them."""
        x, y = self.places()
        inside = np.minimum(
            (y + REACH[2]) / FADE[1], np.minimum((REACH[0] - np.abs(x)) / FADE[0], (REACH[1] - y) / 0.5)
        )
        inside = np.clip(inside, 0, 1)
        return smooth_step(inside).astype(np.float32)

    def onto(self, image: np.ndarray, grid: Grid, border: int = cv2.BORDER_REPLICATE) -> np.ndarray:
        """A map of the copy on ``grid``."""
        blur = 0.35 * self.unit / grid.density
        image = cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.5 else image
        return _warp(image, compose(grid.matrix(), self.to_bust), grid.size, border)

    def back(self, image: np.ndarray, grid: Grid) -> np.ndarray:
        """A map of ``grid`` on the copy; beyond the grid its border is repeated."""
        return _warp(image, invert(compose(grid.matrix(), self.to_bust)), self.size)

    def onto_crop(self, image: np.ndarray) -> np.ndarray:
        """A map of the copy on the model's crop."""
        blur = 0.4 * self.unit / crop_unit(self.crop)
        image = cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.5 else image
        return _warp(image, self.to_crop, (self.crop.height, self.crop.width))

    def from_crop(self, image: np.ndarray, outside: float) -> np.ndarray:
        """A map of the model's crop on the copy; ``outside`` beyond the crop."""
        matrix = invert(self.to_crop)
        return cv2.warpAffine(
            image,
            matrix,
            (self.size[1], self.size[0]),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=outside,
        )


def working_window(shape: tuple[int, ...], to_crop: np.ndarray, crop: CropFrame, largest: int = LARGEST_SIDE) -> Window:
    """The window of a photograph of ``shape (H, W, ...)`` whose similarity ``to_crop (2, 3)`` takes its pixels to the
    model's crop; its copy has at most ``largest`` pixels on the longer side."""
    to_bust = compose(crop_to_bust(crop), to_crop)
    corners = np.array([(x, y) for x in (-REACH[0], REACH[0]) for y in (REACH[1], -REACH[2])])
    back = invert(to_bust)
    corners = corners @ back[:, :2].T + back[:, 2]
    low = np.maximum(np.floor(corners.min(0)).astype(int), 0)
    high = np.minimum(np.ceil(corners.max(0)).astype(int) + 1, (shape[1], shape[0]))
    width, height = (int(v) for v in np.maximum(high - low, 1))
    scale = min(1.0, largest / max(width, height))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    # pixel centres: copy pixel i stands for photograph pixel (i + 0.5) / scale - 0.5
    sx, sy = width / size[1], height / size[0]
    to_photo = np.array([[sx, 0, low[0] + 0.5 * sx - 0.5], [0, sy, low[1] + 0.5 * sy - 0.5]])
    bust = compose(to_bust, to_photo)
    unit = 1 / np.sqrt(abs(np.linalg.det(bust[:, :2])))
    rows, columns = slice(low[1], low[1] + height), slice(low[0], low[0] + width)
    return Window(rows, columns, size, bust, compose(to_crop, to_photo), float(unit), crop)


def crop_unit(crop: CropFrame) -> float:
    """Pixels of the crop between the eyes."""
    return float(crop.landmarks[1, 0] - crop.landmarks[0, 0])


def crop_to_bust(crop: CropFrame) -> np.ndarray:
    """``(2, 3)``: pixels of the crop to bust coordinates."""
    unit = crop_unit(crop)
    x, y = crop.landmarks[:2].mean(0).tolist()
    return np.array([[1 / unit, 0, -x / unit], [0, -1 / unit, y / unit]])


def crop_onto(image: np.ndarray, crop: CropFrame, grid: Grid, border: float = 0.0) -> np.ndarray:
    """A map of the crop on ``grid``; ``border`` outside."""
    matrix = compose(grid.matrix(), crop_to_bust(crop))
    return cv2.warpAffine(
        image, matrix, grid.size[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=border
    )


def between(image: np.ndarray, source: Grid, target: Grid) -> np.ndarray:
    """A map of one grid on another."""
    return _warp(image, compose(target.matrix(), invert(source.matrix())), target.size)


def blur(image: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian blur of a map ``(H, W)`` or ``(H, W, C)``, ``sigma`` in pixels; float32. A wide one is done on a smaller
    map: nothing is left that it could not hold."""
    image = np.asarray(image, np.float32)
    if sigma <= WIDE:
        return cv2.GaussianBlur(image, (0, 0), max(sigma, 0.3))
    height, width = image.shape[:2]
    small = cv2.resize(
        image, (-int(-width * WIDE // (2 * sigma)), -int(-height * WIDE // (2 * sigma))), interpolation=cv2.INTER_AREA
    )
    scale = np.sqrt(small.shape[0] * small.shape[1] / (height * width))
    # a box of 1 / scale pixels and linear interpolation blur by themselves, in pixels of the small map by 1/12 and 1/6
    own = np.sqrt((sigma * scale) ** 2 - 1 / 12 - 1 / 6)
    return cv2.resize(cv2.GaussianBlur(small, (0, 0), own), (width, height), interpolation=cv2.INTER_LINEAR)


def smooth_step(share: np.ndarray) -> np.ndarray:
    """``share`` in 0..1, eased at both ends: ``t^2 (3 - 2 t)``."""
    return share * share * (3 - 2 * share)


def compose(second: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The affine map ``(2, 3)`` that does ``first`` and then ``second``."""
    return np.column_stack((second[:, :2] @ first[:, :2], second[:, :2] @ first[:, 2] + second[:, 2]))


def invert(matrix: np.ndarray) -> np.ndarray:
    """The inverse of an affine map ``(2, 3)`` of the plane, in closed form."""
    return cv2.invertAffineTransform(np.asarray(matrix, np.float64))


def _warp(
    image: np.ndarray,
    matrix: np.ndarray,
    size: tuple[int, int],
    border: int = cv2.BORDER_REPLICATE,
    flags: int = cv2.INTER_LINEAR,
) -> np.ndarray:
    """``image`` seen through the map ``matrix (2, 3)`` from its pixels to those of the result, of ``size`` (H, W)."""
    return cv2.warpAffine(image, matrix, (size[1], size[0]), flags=flags, borderMode=border)
