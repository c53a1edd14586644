"""The default path, photo in and photo out: files, faces, matte, colour, bust, ratio and the session of them all."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from facerelight.photo.face_model import crop_frame
    from facerelight.photo.session import PhotoRelighter, load_relighter, relight

__all__ = ["PhotoRelighter", "crop_frame", "load_relighter", "relight"]


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for: files and the command line's help need no torch."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from facerelight.photo import session

    return getattr(session, name)
