"""Statistically optimal relighting of faces, and recognition under any light."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facerelight.augment import RandomFaceRelight
    from facerelight.config import TrainConfig
    from facerelight.geometry.lights import angles_from_light, light_from_angles
    from facerelight.geometry.sources import Lamp, LightMixture
    from facerelight.geometry.sums import LightSum
    from facerelight.inference.detail import keep_detail
    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.light.amounts import SoftLightEstimator
    from facerelight.light.estimator import LightEstimator
    from facerelight.light.kernel import KernelIlluminationEstimator
    from facerelight.light.likelihood import LikelihoodIlluminationEstimator
    from facerelight.model.learning import FitOptions
    from facerelight.model.statistics import FaceStatistics
    from facerelight.photo import PhotoRelighter, relight
    from facerelight.recognition.class_conditional import GaussianClassifier
    from facerelight.recognition.classifier import Classifier, SumClassifier
    from facerelight.recognition.gallery.gallery import Gallery
    from facerelight.recognition.nearest import NearestNeighborClassifier
    from facerelight.recognition.pca import GlobalPCAClassifier, IndividualPCAClassifier
    from facerelight.viewpoint.pose import BootstrapViews, View, ViewRelighter
    from facerelight.viewpoint.regions import GroupRelighter
    from facerelight.viewpoint.views import LightViews

__version__ = "0.1.0"

_HOMES = {
    "BootstrapViews": "viewpoint.pose",
    "Classifier": "recognition.classifier",
    "FaceStatistics": "model.statistics",
    "FitOptions": "model.learning",
    "Gallery": "recognition.gallery.gallery",
    "GaussianClassifier": "recognition.class_conditional",
    "GlobalPCAClassifier": "recognition.pca",
    "GroupRelighter": "viewpoint.regions",
    "IndividualPCAClassifier": "recognition.pca",
    "KernelIlluminationEstimator": "light.kernel",
    "Lamp": "geometry.sources",
    "LightEstimator": "light.estimator",
    "LightMixture": "geometry.sources",
    "LightSum": "geometry.sums",
    "LightViews": "viewpoint.views",
    "LikelihoodIlluminationEstimator": "light.likelihood",
    "NearestNeighborClassifier": "recognition.nearest",
    "PhotoRelighter": "photo",
    "RandomFaceRelight": "augment",
    "SoftLightEstimator": "light.amounts",
    "StatisticalRelighter": "inference.relighter",
    "SumClassifier": "recognition.classifier",
    "TrainConfig": "config",
    "View": "viewpoint.pose",
    "ViewRelighter": "viewpoint.pose",
    "angles_from_light": "geometry.lights",
    "keep_detail": "inference.detail",
    "light_from_angles": "geometry.lights",
    "relight": "photo",
}

__all__ = [
    "BootstrapViews",
    "Classifier",
    "FaceStatistics",
    "FitOptions",
    "Gallery",
    "GaussianClassifier",
    "GlobalPCAClassifier",
    "GroupRelighter",
    "IndividualPCAClassifier",
    "KernelIlluminationEstimator",
    "Lamp",
    "LightEstimator",
    "LightMixture",
    "LightSum",
    "LightViews",
    "LikelihoodIlluminationEstimator",
    "NearestNeighborClassifier",
    "PhotoRelighter",
    "RandomFaceRelight",
    "SoftLightEstimator",
    "StatisticalRelighter",
    "SumClassifier",
    "TrainConfig",
    "View",
    "ViewRelighter",
    "angles_from_light",
    "keep_detail",
    "light_from_angles",
    "relight",
]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for: ``facerelight --help`` needs no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
