"""Statistically optimal relighting of faces, and recognition under any light."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facerelight.detail import keep_detail
    from facerelight.illumination import KernelIlluminationEstimator
    from facerelight.lights import angles_from_light, light_from_angles
    from facerelight.photo import PhotoRelighter, relight
    from facerelight.relighter import StatisticalRelighter
    from facerelight.sources import Lamp, LightMixture
    from facerelight.statistics import FaceStatistics

__all__ = [
    "FaceStatistics",
    "KernelIlluminationEstimator",
    "Lamp",
    "LightMixture",
    "PhotoRelighter",
    "StatisticalRelighter",
    "angles_from_light",
    "keep_detail",
    "light_from_angles",
    "relight",
]

_HOMES = {
    "FaceStatistics": "statistics",
    "KernelIlluminationEstimator": "illumination",
    "Lamp": "sources",
    "LightMixture": "sources",
    "PhotoRelighter": "photo",
    "StatisticalRelighter": "relighter",
    "angles_from_light": "lights",
    "keep_detail": "detail",
    "light_from_angles": "lights",
    "relight": "photo",
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for: ``facerelight --help`` needs no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
