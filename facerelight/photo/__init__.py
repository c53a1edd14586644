"""The default path, a photograph in and a photograph out: files, faces, matte, colour, bust, ratio, and the session that joins them."""

from facerelight.photo.session import PhotoRelighter, crop_frame, load_relighter, relight

__all__ = ["PhotoRelighter", "crop_frame", "load_relighter", "relight"]
