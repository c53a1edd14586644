"""``facerelight app``: its options."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from facerelight.photo.scenes import QUALITIES
from facerelight.photo.viewer.command import check_side

if TYPE_CHECKING:
    from facerelight.inference.relighter import StatisticalRelighter

__all__ = ["app_parser", "run_app"]

PORTS = (1024, 65535)


def app_parser() -> ArgumentParser:
    """The options of ``facerelight app``."""
    parser = ArgumentParser(
        prog="facerelight app",
        description="Serve a page on this machine that takes photos and lights them; Ctrl-C ends it.",
        allow_abbrev=False,
    )
    option = parser.add_argument
    option("--port", type=int, default=7860, help="of http://127.0.0.1 (default: 7860)")
    option("--browser", action="store_true", help="open the page")
    option("--side", type=int, default=1000, help="pixels of a photo's longer side in the page (default: 1000)")
    option("--quality", default="standard", choices=QUALITIES, help="of the statistics (default: standard)")
    option("--statistics", metavar="FOLDER", help="trained statistics (default: those of the quality)")
    return parser


def run_app(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Serve until interrupted; returns the exit code.

    Raises:
        ValueError: options that cannot be used.
        RuntimeError: Gradio is not installed.
    """
    check_side(arguments.side)
    if not PORTS[0] <= arguments.port <= PORTS[1]:
        raise ValueError(f"port: expected {PORTS[0]} to {PORTS[1]}, got {arguments.port}")
    from facerelight.photo.app.server import serve

    @cache
    def load() -> StatisticalRelighter:
        from facerelight.inference.relighter import StatisticalRelighter

        return StatisticalRelighter.from_pretrained(statistics_folder(arguments.statistics, arguments.quality))

    serve(load, arguments.port, arguments.side, arguments.browser)
    return 0
