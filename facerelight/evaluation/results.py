"""What the scripts share: how results are asked for, shown as a table, and kept together with how they came about."""

from __future__ import annotations

import csv
import datetime
import json
import os
import platform
import shlex
import subprocess
import sys
from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from facerelight.bootstrap.domain import Domain

__all__ = ["ScriptParser", "found_domain", "found_domains", "joined_rows", "machine", "markdown", "read_rows"]

FACES = "yaleb_192x168.npz or a CroppedYale folder"


class ScriptParser(ArgumentParser):
    """Options of a script, and its results.

    ``--csv`` and ``--json`` take a file; without one they mean ``scripts/results/NAME.csv`` and ``NAME.json``, NAME
    being the script's. Whatever is saved says by which command, when, on which machine and at which commit it came
    about; the commit is that of the start.

    Args:
        file: ``__file__`` of the script.
        doc: its docstring.
    """

    def __init__(self, file: str, doc: str | None) -> None:
        super().__init__(prog=Path(file).name, description=doc, formatter_class=RawDescriptionHelpFormatter)
        self.file = Path(file).resolve()
        self.commit = _commit(self.file.parent)

    def add_faces(self, required: bool = True, more: str = "") -> None:
        """``--data``: Extended Yale B."""
        self.add_argument("--data", type=Path, required=required, default=None, help=FACES + more)

    def add_size(self, height: int, width: int) -> None:
        """``--height`` and ``--width`` of the images in pixels."""
        self.add_argument("--height", type=int, default=height)
        self.add_argument("--width", type=int, default=width)

    def add_domain(self) -> None:
        """``--domain``, the rendered world's settings; see :func:`found_domain`."""
        what = "what search_domain.py --json wrote; default: the package's domain"
        self.add_argument("--domain", type=Path, default=None, help=what)

    def add_results(self, *kinds: str) -> None:
        """``--csv``, ``--json`` or both."""
        for kind in kinds:
            place = self.file.parents[1] / "results" / f"{self.file.stem}.{kind}"
            what = f"keep the results; without a file in scripts/results/{place.name}"
            self.add_argument(f"--{kind}", type=Path, nargs="?", const=place, default=None, metavar="FILE", help=what)

    def made(self) -> dict[str, str]:
        """How results came about: ``command``, ``date``, ``machine``, ``commit``."""
        script = self.file.relative_to(self.file.parents[2]).as_posix()
        return {
            "command": f"python {script} {' '.join(map(_shown, sys.argv[1:]))}".strip(),
            "date": str(datetime.date.today()),
            "machine": machine(),
            "commit": self.commit,
        }

    def save_rows(self, path: Path | None, rows: Sequence[Mapping[str, object]]) -> None:
        """Rows as CSV under ``# command: ...`` and so on, a column a key of any row; nothing where there is no path."""
        if path is None:
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="") as file:
            file.writelines(f"# {name}: {value}\n" for name, value in self.made().items())
            columns = dict.fromkeys(key for row in rows for key in row)
            writer = csv.DictWriter(file, list(columns), restval="", lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)

    def print_rows(self, rows: Sequence[Mapping[str, object]], path: Path | None) -> None:
        """The table of ``rows`` on the screen, and in ``path`` as Markdown where one is named."""
        table = markdown(rows)
        print(table)
        if path:
            path.write_text(table + "\n")

    def save_report(self, path: Path | None, report: dict | list) -> None:
        """A report as JSON, with :meth:`made` as its ``made``, or as that of each of its parts where it is a list.
        Nothing where there is no path."""
        if path is None:
            return
        made = {"made": self.made()}
        whole = [part | made for part in report] if isinstance(report, list) else report | made
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(whole, indent=2) + "\n")


def read_rows(path: str | Path) -> list[dict[str, str]]:
    """The rows that :meth:`ScriptParser.save_rows` wrote, as text."""
    with Path(path).open(newline="") as file:
        return list(csv.DictReader(line for line in file if not line.startswith("# ")))


def joined_rows(paths: Sequence[Path], keys: Sequence[str], count: str) -> list[dict[str, object]]:
    """Rows of several files as one: those that agree in ``keys`` become their mean, weighted by the column ``count``,
    which adds up; in the order in which they first occur.

    Raises:
        ValueError: no file, or one without a column.
    """
    found: dict[tuple[str, ...], list[dict[str, str]]] = {}
    for path in paths:
        for row in read_rows(path):
            missing = [name for name in (*keys, count) if name not in row]
            if missing:
                raise ValueError(f"{path}: expected columns {', '.join((*keys, count))}, got none called {missing[0]}")
            found.setdefault(tuple(row[key] for key in keys), []).append(row)
    if not found:
        raise ValueError("join: expected files with rows, got none")
    joined = []
    for key, rows in found.items():
        counts = [float(row[count]) for row in rows]
        one: dict[str, object] = dict(zip(keys, key, strict=True)) | {count: round(sum(counts))}
        for name in rows[0]:
            if name not in one:
                known = [(weight, row[name]) for weight, row in zip(counts, rows, strict=True) if row[name]]
                digits = max((len(text.partition(".")[2]) for _, text in known), default=0)
                mean = sum(weight * float(text) for weight, text in known) / max(sum(w for w, _ in known), 1e-12)
                one[name] = round(mean, digits) if known else ""
        joined.append(one)
    return joined


def markdown(rows: Sequence[Mapping[str, object]], bold: str | None = None) -> str:
    """Rows as a Markdown table; of the column ``bold`` what has a ``default`` in its row stands out, and the column
    ``default`` is left out."""
    columns = [key for key in dict.fromkeys(key for row in rows for key in row) if not (bold and key == "default")]
    lines = ["| " + " | ".join(column.replace("_", " ") for column in columns) + " |", "|" + "---|" * len(columns)]
    for row in rows:
        shown = {**row, bold: f"**{row[bold]}**"} if bold and row.get("default") else row
        lines.append("| " + " | ".join(str(shown.get(column, "")) for column in columns) + " |")
    return "\n".join(lines)


def machine() -> str:
    """The processor, how many cores there are, and how many threads this process uses."""
    return f"{_processor()}, {os.cpu_count()} cores, threads used: {torch.get_num_threads()}"


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as file:
            return next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _commit(folder: Path) -> str:
    asked = ["git", "describe", "--always", "--dirty", "--abbrev=7"]
    try:
        said = subprocess.run(asked, cwd=folder, capture_output=True, text=True).stdout.strip()
    except OSError:
        said = ""
    return said or "unknown"


def _shown(word: str) -> str:
    """An argument as it is told: of an absolute path, which means nothing elsewhere, the last part."""
    return shlex.quote(Path(word).name if Path(word).is_absolute() else word)


def found_domain(path: Path | None) -> Domain:
    """The rendered world that ``scripts/data/search_domain.py`` found for everybody, or the package's own."""
    return Domain(**json.loads(path.read_text())["all"]) if path else Domain()


def found_domains(path: Path) -> list[Domain]:
    """The rendered worlds that ``scripts/data/search_domain.py`` found for each of n folds, on the other people."""
    return [Domain(**values) for values in json.loads(path.read_text())["folds"]]
