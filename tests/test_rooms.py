"""The package's rooms: imports run downwards only, and every room can be taken in at a glance."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "facerelight"
ROOMS = (
    "numerics",
    "geometry",
    "model",
    "light",
    "inference",
    "bootstrap",
    "config",
    "photo",
    "train",
    "augment",
    "viewpoint",
    "recognition",
    "evaluation",
    "cli",
)
"""From the ground up: a room knows those below it."""
MOST_MODULES = 12
LONGEST_LINE = 120
SOURCES = sorted(path for top in ("facerelight", "scripts", "tests") for path in (ROOT / top).rglob("*.py"))


def imported(path: Path) -> set[str]:
    """Modules of the package that a file imports, wherever it does: ``{"facerelight.numerics.gaussian", ...}``."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: expected absolute imports, got a relative one"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] == "facerelight"}


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_downwards_only(room: str) -> None:
    files = (PACKAGE / room).rglob("*.py") if (PACKAGE / room).is_dir() else [PACKAGE / f"{room}.py"]
    allowed = (*ROOMS[: ROOMS.index(room) + 1], "__version__")
    climbs = {f"{path.name}: {name}" for path in files for name in imported(path) if name.split(".")[1] not in allowed}
    assert not climbs, f"{room} may import {', '.join(allowed)}"


def test_the_top_level_holds_the_rooms_and_nothing_else() -> None:
    entries = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert entries == {"__init__", *ROOMS}


@pytest.mark.parametrize("folder", sorted({path.parent for path in PACKAGE.rglob("*.py")}), ids=lambda path: path.name)
def test_a_room_is_small_and_says_what_it_holds(folder: Path) -> None:
    modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
    assert len(modules) <= MOST_MODULES
    assert ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))


def test_tests_mirror_the_rooms() -> None:
    folders = {path.parent.name for path in (ROOT / "tests").rglob("test_*.py")} - {"tests"}
    assert folders <= set(ROOMS)


def test_no_line_is_too_long() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in SOURCES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if len(line) > LONGEST_LINE
    ]
    assert not long, f"expected at most {LONGEST_LINE} columns"
