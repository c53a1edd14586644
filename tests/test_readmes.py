"""Every README, held to what it says: links resolve, commands and their flags exist, Python blocks run, and a figure in
a table is a figure in the file named beside it.

A Python block that cannot run has ``<!-- not run: why -->`` before it; a table that holds no measured figures
``<!-- no figures -->``, one whose first columns hold none ``<!-- figures from column N -->``, and one whose rows gather
figures of several rows of a file ``<!-- figures of several rows, from column N -->``.
"""

import contextlib
import csv
import importlib
import io
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from dataclasses import fields
from decimal import Decimal
from functools import cache
from pathlib import Path

import pytest
from test_hard_cases import CASES
from test_rooms import ROOMS

import facerelight
from facerelight import cli
from facerelight.config import TrainConfig

ROOT = Path(__file__).parents[1]
READMES = sorted((*ROOT.glob("README.md"), *ROOT.glob("[!.]*/README.md"), *(ROOT / ".github").glob("*.md")))
MOST_LINES, MOST_ROWS = 200, 30  # of the first README
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)
NUMBER = re.compile(r"(?<![A-Za-z.\d])[-+]?(?:\d{1,3}(?:,\d{3})+(?!\d)|\d+)(?:\.\d+)?(?:e[-+]?\d+)?|(?<!\d)[-+]?\.\d+")
every_readme = pytest.mark.parametrize("path", READMES, ids=lambda path: str(path.relative_to(ROOT)))


def prose(path: Path) -> str:
    """A README without its fenced blocks."""
    return FENCE.sub("", path.read_text())


def anchors(path: Path) -> set[str]:
    """What headings are linked by."""
    titles = re.findall(r"^#+ (.*)$", prose(path), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(path: Path) -> Iterator[list[str]]:
    """The commands of a README, taken apart: of its shell blocks, and those within its lines."""
    lines = [line for kind, text in FENCE.findall(path.read_text()) if kind == "sh" for line in text.splitlines()]
    for line in lines + re.findall(r"`([^`\n]+)`", prose(path)):
        if re.match(r"(python scripts/|bash scripts/|facerelight )", line):
            yield shlex.split(line, comments=True)


def ended(run, *arguments: str) -> str:
    """What ``run`` prints before it leaves."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        run(*arguments)
    return said.getvalue()


@cache
def script_help(script: str) -> str:
    """What a script says of itself, asked in this process: torch is imported once."""
    given, paths, sys.argv = sys.argv, list(sys.path), [script, "--help"]
    sys.path.insert(0, str((ROOT / script).parent))
    try:
        return ended(lambda: runpy.run_path(str(ROOT / script), run_name="__main__"))
    finally:
        sys.argv, sys.path[:] = given, paths


def tables(path: Path) -> Iterator[tuple[str, list[list[str]]]]:
    """Tables of a README: the text before each, from the last heading or table on, and the cells of its rows."""
    before, rows = "", []
    for line in [*prose(path).splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip().strip("|").split("|")])
            continue
        if rows:
            yield before, rows[2:]
            before, rows = "", []
        before = line if line.startswith("#") else f"{before}\n{line}"


def numbers(text: str) -> list[Decimal]:
    return [Decimal(found.replace(",", "")) for found in NUMBER.findall(text)]


def occurs(shown: Decimal, known: list[Decimal]) -> bool:
    """Whether ``shown`` is one of the ``known`` numbers, rounded to its own digits."""
    half = Decimal(5).scaleb(int(shown.as_tuple().exponent) - 1)
    return any(abs(shown - number) <= half for number in known)


def result_rows(path: Path) -> list[list[Decimal]]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return [numbers(" ; ".join(row)) for row in csv.reader(lines[1:])]


@every_readme
def test_links_resolve(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(path)):
        place, _, anchor = target.partition("#")
        found = (path.parent / place).resolve() if place else path
        assert found.exists(), target
        assert found.is_relative_to(ROOT), target
        assert not anchor or anchor in anchors(found), target


@every_readme
def test_files_that_are_named_exist(path: Path) -> None:
    homes = (ROOT, path.parent, ROOT / "facerelight", ROOT / "facerelight" / "photo", ROOT / "scripts")
    for named in re.findall(r"`([\w.-]+/[\w./-]+\.(?:py|sh|yaml|yml|csv|txt))`", prose(path)):
        assert "NAME" in named or any((home / named).exists() for home in homes), named


@every_readme
def test_commands_and_flags_exist(path: Path) -> None:
    for words in commands(path):
        flags = {word.split("=")[0] for word in words if re.match(r"--\w", word)}
        if words[0] == "facerelight":
            known = ended(cli.main, [words[1], "--help"] if words[1] in cli.VERBS else ["--help"])
            assert words[1] in cli.VERBS or words[1].startswith("-"), words
        else:
            assert (ROOT / words[1]).is_file(), words
            known = script_help(words[1]) if words[1].endswith(".py") and flags else ""
        missing = [flag for flag in flags if not re.search(rf"{re.escape(flag)}\b(?![-\w])", known)]
        assert not missing, f"{' '.join(words)}: {missing}"


@every_readme
def test_python_blocks_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = re.split(r"^```python\n(.*?)^```", path.read_text(), flags=re.M | re.S)
    blocks = [block for before, block in zip(parts[::2], parts[1::2], strict=False) if "<!-- not run" not in before]
    if not blocks:
        pytest.skip("no Python here")
    if any("me.jpg" in block for block in blocks):
        from PIL import Image

        photo = pytest.importorskip("skimage.data", reason="scikit-image carries the photo").astronaut()
        Image.fromarray(photo).save(tmp_path / "me.jpg")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": "readme"}
    for block in blocks:
        exec(compile(block, str(path), "exec"), names)


@every_readme
def test_figures_in_tables_are_figures_in_files(path: Path) -> None:
    if path.parent.name == ".github":
        return
    for before, rows in tables(path):
        if "<!-- no figures" in before:
            continue
        files = [path.parent / name for name in re.findall(r"\(([\w./]*results/\w+\.csv)\)", before)]
        assert files, f"a table without a file of results beside it: {rows[0]}"
        known = [row for file in files for row in result_rows(file)]
        marked = re.search(r"<!-- figures (of several rows, )?from column (\d) -->", before)
        gathered, first = len(files) > 1 or bool(marked and marked[1]), int(marked[2]) - 1 if marked else 1
        known = [[number for row in known for number in row]] if gathered else known
        for row in rows:
            shown = numbers(" ; ".join(row[first:]))
            strange = min(([number for number in shown if not occurs(number, found)] for found in known), key=len)
            assert not strange, (row, strange)


def test_the_first_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= MOST_LINES
    assert sum(line.startswith("|") for line in lines) <= MOST_ROWS


@pytest.mark.parametrize("file", sorted((ROOT / "scripts" / "results").glob("*.csv")), ids=lambda file: file.stem)
def test_results_say_how_they_came_about_and_are_shown(file: Path) -> None:
    head = [line.split(":")[0] for line in file.read_text().splitlines()[:4]]
    assert head == ["# command", "# date", "# machine", "# commit"]
    command = file.read_text().splitlines()[0]
    for script in re.findall(r"scripts/[\w/]+\.py", command):
        assert (ROOT / script).is_file(), command
    assert any(f"results/{file.name})" in path.read_text() for path in READMES), "no README shows them"


def test_every_script_is_listed() -> None:
    text = (ROOT / "scripts" / "README.md").read_text()
    for script in (ROOT / "scripts").rglob("*.py"):
        assert f"({script.relative_to(ROOT / 'scripts').as_posix()})" in text, script.name


def test_rooms_are_listed_in_their_order() -> None:
    block = next(text for kind, text in FENCE.findall((ROOT / "facerelight" / "README.md").read_text()))
    assert tuple(line.split()[0] for line in block.splitlines()) == ROOMS[::-1]


def test_what_implements_the_thesis_exists() -> None:
    _, rows = next(tables(ROOT / "facerelight" / "README.md"))
    assert len(rows) > 20
    for row in rows:
        for name in re.findall(r"`([a-z_]+[\w.]*)`", row[-1]):
            found = f"facerelight.{name}"
            try:
                importlib.import_module(found)
            except ModuleNotFoundError:
                module, _, last = found.rpartition(".")
                assert hasattr(importlib.import_module(module), last), name


def test_every_knob_is_listed_with_its_default() -> None:
    config = TrainConfig()
    text = (ROOT / "configs" / "README.md").read_text()
    listed = dict(re.findall(r"^\| (`[^|]*`) \| ([^|]*) \|", text, re.M))
    pairs = [zip(_parts(names), _parts(values), strict=True) for names, values in listed.items()]
    known = {name: value for pair in pairs for name, value in pair}
    expected = {field.name: getattr(config, field.name) for field in fields(config)}
    expected |= {f"fit.{field.name}": getattr(config.fit, field.name) for field in fields(config.fit)}
    del expected["fit"], expected["domain"]
    assert known.keys() == expected.keys() | {"domain.*"}
    for name, value in expected.items():
        said = known[name]
        assert said == ("chosen" if value is None else str(value).lower()) or float(said) == float(value), name


def _parts(text: str) -> list[str]:
    return [part.strip(" `") for part in text.split(",")]


def test_the_table_of_hard_cases_is_that_of_the_tests() -> None:
    rows = list(tables(ROOT / "tests" / "README.md"))[-1][1]
    assert rows == [[name, promise] for name, (promise, _) in CASES.items()]


def test_one_version() -> None:
    version = facerelight.__version__
    assert f"version = {{{version}}}" in (ROOT / "README.md").read_text()
    assert f"## {version}" in (ROOT / ".github" / "CHANGELOG.md").read_text()
    assert ended(cli.main, ["--version"]).strip() == version
