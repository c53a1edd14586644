"""Statistically optimal relighting of faces, and recognition under any light."""

from facerelight.detail import keep_detail
from facerelight.illumination import KernelIlluminationEstimator
from facerelight.lights import angles_from_light, light_from_angles
from facerelight.photo import PhotoRelighter, relight
from facerelight.relighter import StatisticalRelighter
from facerelight.statistics import FaceStatistics

__all__ = [
    "FaceStatistics",
    "KernelIlluminationEstimator",
    "PhotoRelighter",
    "StatisticalRelighter",
    "angles_from_light",
    "keep_detail",
    "light_from_angles",
    "relight",
]
