"""Names of films, and places for them."""

from __future__ import annotations

import os
from pathlib import Path

from facerelight.photo.files.disk import SUFFIXES

__all__ = ["FILMS", "WRITTEN", "check_film_output", "is_film"]

WRITTEN = (".mp4", ".m4v", ".mov", ".mkv", ".webm")
FILMS = (*WRITTEN, ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".wmv", ".flv", ".3gp", ".ogv", ".gif", ".apng")


def is_film(path: str | Path, output: str | None = None) -> bool:
    """Whether a file's name is a film's, or that of its ``output`` is while its own says nothing."""
    suffix, asked = Path(path).suffix.lower(), Path(output or "").suffix.lower()
    return suffix in FILMS or (asked in WRITTEN and suffix not in SUFFIXES)


def check_film_output(path: Path, force: bool) -> None:
    """What is wrong with a place for a film.

    Raises:
        ValueError: another suffix, a folder that cannot be written to, or a file that exists already.
    """
    if path.suffix.lower() not in WRITTEN:
        raise ValueError(f"{path}: expected a film's name ({', '.join(WRITTEN)}), got {path.suffix or 'no suffix'!r}")
    folder = path.parent
    while not os.path.lexists(folder) and folder != folder.parent:
        folder = folder.parent
    if path.is_dir() or not folder.is_dir() or not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: expected a file in a folder that can be written, which {folder} is not")
    if path.exists() and not force:
        raise ValueError(f"{path}: exists already; --force overwrites it, --output says another place")
