"""Statistically optimal relighting of faces, and recognition under any light."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facerelight.geometry.lights import angles_from_light, light_from_angles
    from facerelight.geometry.sources import Lamp, LightMixture
    from facerelight.inference.detail import keep_detail
    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.light.kernel import KernelIlluminationEstimator
    from facerelight.model.statistics import FaceStatistics
    from facerelight.photo import PhotoRelighter, relight

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
    "FaceStatistics": "model.statistics",
    "KernelIlluminationEstimator": "light.kernel",
    "Lamp": "geometry.sources",
    "LightMixture": "geometry.sources",
    "PhotoRelighter": "photo",
    "StatisticalRelighter": "inference.relighter",
    "angles_from_light": "geometry.lights",
    "keep_detail": "inference.detail",
    "light_from_angles": "geometry.lights",
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
