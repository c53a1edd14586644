"""The viewer in a notebook: the page in a cell, and the light that is set in it in Python, both ways."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np

from facerelight.geometry.sources import Lamp
from facerelight.photo.files.pixels import as_rgb
from facerelight.photo.files.profiles import encode_srgb
from facerelight.photo.scenes import parse_lamp
from facerelight.photo.session import PhotoRelighter
from facerelight.photo.viewer.page import shrunken, viewer_page

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

try:
    import anywidget
    import traitlets
except ModuleNotFoundError as error:
    raise RuntimeError('the widget needs anywidget; pip install "facerelight[notebook]"') from error

__all__ = ["Widget"]

MOST_LAMPS, LARGEST = 3, 60.0  # of the page: lamps, and degrees of a lamp's size
START = Lamp(40, 30, size=8)
FILL = 0.15


class Widget(anywidget.AnyWidget):
    """A photo to light in a notebook's cell; ``lamps``, ``fill`` and ``strength`` follow the page, and it them.

    Args:
        photo: an array as for :func:`facerelight.relight`.
        relighter: the model; None: the packaged one.
        side: pixels of the photo's longer side in the page; :meth:`render` keeps its own size.
        height: of the cell in pixels.

    Raises:
        ValueError: a photo that cannot be used.
        LandmarksNotFoundError: no face.

    Example:
        >>> widget = Widget(photo)  # doctest: +SKIP
        >>> widget.lamps = [Lamp(60, 20), Lamp(-60, 10, power=0.3)]  # doctest: +SKIP
        >>> picture = widget.render()  # doctest: +SKIP
    """

    _esm = files("facerelight.photo.viewer").joinpath("web", "widget.mjs").read_text("utf-8")
    page = traitlets.Unicode().tag(sync=True)
    height = traitlets.Int(640).tag(sync=True)
    scene = traitlets.Dict().tag(sync=True)
    """``lamps``, each ``azimuth``, ``elevation``, ``size``, ``power`` and ``colour``; ``fill``; ``strength``."""

    def __init__(
        self,
        photo: np.ndarray,
        relighter: StatisticalRelighter | None = None,
        side: int = 900,
        height: int = 640,
    ) -> None:
        self._photo, self._relighter = photo, relighter
        pixels = as_rgb(photo)
        if pixels.dtype == np.float32:
            pixels = (65535 * pixels).round().astype(np.uint16)
        shown = PhotoRelighter(shrunken(pixels, side), relighter=relighter)
        self._relighter = shown.relighter
        scene = {"lamps": [_described(START)], "fill": FILL, "strength": 1.0}
        super().__init__(page=viewer_page(shown), height=height, scene=scene)

    @cached_property
    def session(self) -> PhotoRelighter:
        """Of the photo at its own size, conditioned when it is first asked for."""
        return PhotoRelighter(self._photo, relighter=self._relighter)

    @property
    def lamps(self) -> list[Lamp]:
        """The lamps, at most three."""
        return [_lamp(one) for one in self.scene["lamps"]]

    @lamps.setter
    def lamps(self, lamps: Sequence[Lamp]) -> None:
        if not 1 <= len(lamps) <= MOST_LAMPS or not all(isinstance(lamp, Lamp) for lamp in lamps):
            raise ValueError(f"lamps: expected one to {MOST_LAMPS} of facerelight.Lamp, got {lamps!r}")
        if any(lamp.size > LARGEST for lamp in lamps):
            raise ValueError(f"lamps: expected sizes up to {LARGEST:g} degrees, got {[lamp.size for lamp in lamps]}")
        self.scene = {**self.scene, "lamps": [_described(lamp) for lamp in lamps]}

    @property
    def fill(self) -> float:
        """Share of light from all around, 0 to 1."""
        return float(self.scene["fill"])

    @fill.setter
    def fill(self, share: float) -> None:
        self.scene = {**self.scene, "fill": _share("fill", share)}

    @property
    def strength(self) -> float:
        """0 the photo, 1 the relit picture."""
        return float(self.scene["strength"])

    @strength.setter
    def strength(self, share: float) -> None:
        self.scene = {**self.scene, "strength": _share("strength", share)}

    def render(self) -> np.ndarray:
        """The photo under the light that the page shows, of its own shape and dtype."""
        return self.session.render(self.lamps, fill=self.fill, strength=self.strength)


def _lamp(said: dict[str, Any]) -> Lamp:
    numbers = f"{said['azimuth']},{said['elevation']},size={said['size']},power={said['power']}"
    return parse_lamp(f"{numbers},colour={said['colour']}")


def _described(lamp: Lamp) -> dict[str, Any]:
    coded = encode_srgb(np.array(lamp.colour) / max(lamp.colour))
    colour = "#" + "".join(f"{round(255 * float(value)):02x}" for value in coded)
    place = {"azimuth": lamp.azimuth, "elevation": lamp.elevation, "size": lamp.size, "power": lamp.power}
    return {**place, "colour": colour}


def _share(name: str, share: float) -> float:
    if not 0 <= share <= 1:
        raise ValueError(f"{name}: expected a share from 0 to 1, got {share}")
    return float(share)
