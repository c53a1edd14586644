"""Photographs on disk and in memory: read as a camera or an editor wrote them, given back in kind."""

from facerelight.photo.files.disk import (
    SUFFIXES,
    check_writable,
    find_people,
    find_photos,
    not_held,
    read_photo,
    write_photo,
)
from facerelight.photo.files.photograph import PhotoFile, from_pillow, to_pillow

__all__ = [
    "SUFFIXES",
    "PhotoFile",
    "check_writable",
    "find_people",
    "find_photos",
    "from_pillow",
    "not_held",
    "read_photo",
    "to_pillow",
    "write_photo",
]
