"""``facerelight recognize``: its options, what it does, and what it prints."""

from __future__ import annotations

import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from facerelight.photo.scenes import QUALITIES

if TYPE_CHECKING:  # help and errors of the command line need no torch
    from facerelight.inference.relighter import StatisticalRelighter
    from facerelight.recognition.gallery.gallery import Gallery
    from facerelight.recognition.gallery.report import Answers

__all__ = ["recognize_parser", "run_recognize"]

CLASSIFIERS = ("sface", "individual_pca")
EPILOG = """Enroll people who agreed to it: templates of faces are biometric data, whose use many laws restrict. Exit
codes: 0 done; 1 everybody is a stranger, or photos were skipped (each is named); 2 bad input; 3 the program or the
machine failed."""


def recognize_parser() -> ArgumentParser:
    """The options of ``facerelight recognize``."""
    parser = ArgumentParser(
        prog="facerelight recognize",
        description="Enroll people from photos, and identify others among them.",
        epilog=EPILOG,
        allow_abbrev=False,
    )
    parser.add_argument("gallery", help="gallery file (.safetensors) to write or to read")
    option = parser.add_argument_group("who is in the gallery").add_argument
    what = "folder with NAME.jpg or NAME/*.jpg; or a photo, of which every face is enrolled"
    option("--enroll", metavar="PLACE", help=what)
    option(
        "--names", nargs="+", metavar="NAME", help="of the faces in that photo, left to right (default: PHOTO-1, ...)"
    )
    option("--add", action="store_true", help="enroll into the gallery that is there")
    option("--force", action="store_true", help="enroll into a new gallery, and overwrite the one that is there")
    option("--list", action="store_true", help="print who is enrolled, and from how many photos")
    option("--remove", nargs="+", default=[], metavar="NAME", help="forget people and all that is kept of them")
    option = parser.add_argument_group("who is in a photo").add_argument
    option(
        "--photos", nargs="+", default=[], metavar="PLACE", help="photos, or folders of them; every face is identified"
    )
    rate = "share of strangers who may pass for somebody enrolled (default: 0.01)"
    option("--far", type=float, default=0.01, metavar="RATE", help=rate)
    option("--top", type=int, default=1, metavar="N", help="people to name for each face, likeliest first (default: 1)")
    option("--unknown", default="stranger", metavar="NAME", help="what strangers are called (default: stranger)")
    option("--json", action="store_true", help="print the answers as JSON")
    option("--csv", metavar="FILE", help="also write the answers as CSV, a row a face and person named")
    option = parser.add_argument_group("the recogniser").add_argument
    which = "sface, a deep network (default where its weights are installed), or the thesis's individual_pca"
    option("--classifier", choices=CLASSIFIERS, help=which)
    option(
        "--quality", default="standard", choices=QUALITIES, help="of individual_pca's statistics (default: standard)"
    )
    option("--statistics", metavar="FOLDER", help="trained statistics (default: those of the quality)")
    return parser


def run_recognize(arguments: Namespace, statistics_folder: Callable[[str | None, str], Path]) -> int:
    """Do what the command line says; returns the exit code.

    Args:
        arguments: parsed by :func:`recognize_parser`.
        statistics_folder: of the folder given and the quality; trains where there is none.

    Raises:
        ValueError: options that cannot be used, or a gallery that cannot be read.
    """
    from facerelight.recognition.gallery.report import Answers

    _check(arguments)
    path = Path(arguments.gallery)

    @cache
    def relighter() -> StatisticalRelighter:
        from facerelight.inference.relighter import StatisticalRelighter

        return StatisticalRelighter.from_pretrained(statistics_folder(arguments.statistics, arguments.quality))

    fresh = bool(arguments.enroll) and not arguments.add
    gallery = _made(arguments, relighter) if fresh else _loaded(path, arguments, relighter)
    for name in arguments.remove:
        gallery.remove(name)
        _say(f"forgot {name}")
    answers = Answers(arguments.unknown, _say)
    if arguments.enroll:
        _enroll(gallery, arguments, answers)
    if arguments.enroll or arguments.remove:
        gallery.save(path)
        _say(f"{path}: {_counted(gallery)}, {gallery.recognizer.name}")
    for place in arguments.photos:
        answers.identify(gallery, Path(place), arguments.far, arguments.top)
    if arguments.csv:
        answers.write_csv(Path(arguments.csv))
    print_answers = answers.print_json if arguments.json else answers.print_lines
    print_answers(gallery, listed=arguments.list)
    return answers.exit_code


def _check(arguments: Namespace) -> None:
    if not (arguments.enroll or arguments.photos or arguments.list or arguments.remove):
        raise ValueError("recognize: expected --enroll PLACE, --photos PLACE ..., --list or --remove NAME")
    if not 0 < arguments.far < 1:
        raise ValueError(f"far: expected a false accept rate between 0 and 1, got {arguments.far}")
    if arguments.top < 1:
        raise ValueError(f"top: expected at least 1 person, got {arguments.top}")
    if (arguments.add or arguments.force or arguments.names) and not arguments.enroll:
        raise ValueError("recognize: expected --enroll PLACE with --add, --force or --names")
    if arguments.add and arguments.force:
        raise ValueError("recognize: expected --add or --force, got both")
    there = Path(arguments.gallery).exists()
    if arguments.enroll and there and not (arguments.add or arguments.force):
        raise ValueError(f"{arguments.gallery}: is there already; --add enrolls into it, --force replaces it")


def _made(arguments: Namespace, relighter: Callable[[], StatisticalRelighter]) -> Gallery:
    from facerelight.recognition.gallery.choice import default_recognizer, make_recognizer
    from facerelight.recognition.gallery.gallery import Gallery
    from facerelight.recognition.sface import REMEDY

    name = arguments.classifier or default_recognizer()
    if not arguments.classifier and name != "sface":
        _say(f"sface's weights are not installed ({REMEDY}): {name}, which is much weaker, instead")
    return Gallery(make_recognizer(name, relighter))


def _loaded(path: Path, arguments: Namespace, relighter: Callable[[], StatisticalRelighter]) -> Gallery:
    from facerelight.recognition.gallery.choice import make_recognizer
    from facerelight.recognition.gallery.file import load_templates
    from facerelight.recognition.gallery.gallery import Gallery

    name = load_templates(path)[0]["recognizer"]
    if arguments.classifier not in (None, name):
        raise ValueError(f"{path}: expected a gallery of {arguments.classifier}, got one of {name}; enroll anew")
    return Gallery.load(path, make_recognizer(name, relighter))


def _enroll(gallery: Gallery, arguments: Namespace, answers: Answers) -> None:
    from facerelight.photo.files.disk import find_people

    place = Path(arguments.enroll)
    if place.is_dir():
        if arguments.names:
            raise ValueError(f"names: expected with one photo, got the folder {place}")
        before = len(gallery.people)
        for name, photos in find_people(place).items():
            for photo in photos:
                answers.enroll(gallery, name, photo)
        if len(gallery.people) == before == 0:
            raise ValueError(f"{place}: expected photos with faces, got none that could be enrolled")
    else:
        answers.enroll_all(gallery, place, arguments.names)


def _counted(gallery: Gallery) -> str:
    people = gallery.people
    return f"{len(people)} people from {sum(people.values())} photos"


def _say(line: str) -> None:
    print(f"facerelight: {line}", file=sys.stderr, flush=True)
