"""Relit faces for training recognisers: an augmentation, its fast path, and relit training sets on disk."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facerelight.augment.random_face_relight import RandomFaceRelight

__all__ = ["RandomFaceRelight"]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for: the command line's help needs no torch."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from facerelight.augment import random_face_relight

    return getattr(random_face_relight, name)
