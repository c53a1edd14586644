"""A table of what was done with every photo of a batch: a row is written when its photo ends, so that an interrupted
run can be gone on with."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from facerelight.photo.batch import Job, Request
from facerelight.photo.folder.work import Outcome

__all__ = ["MANIFEST", "Manifest"]

MANIFEST = "manifest.csv"
COLUMNS = (
    "photo", "status", "output", "light", "settings", "landmarks", "source_azimuth", "source_elevation", "yaw", "pitch",
    "roll", "seconds", "warnings", "error",
)  # fmt: skip


class Manifest:
    """``manifest.csv`` in the folder of a batch's results; rows are added, the last one of a photo counts.

    Args:
        folder: made where there is none.
        request: what is asked for; with another request a photo counts as not done yet.
        rank: of several processes the first writes ``manifest.csv`` and the others ``manifest.RANK.csv``, until
            :meth:`merge`.
    """

    def __init__(self, folder: Path, request: Request, rank: int = 0) -> None:
        self.path = folder / (MANIFEST if rank == 0 else f"manifest.{rank}.csv")
        self.light = "; ".join(" + ".join(map(_described, scene.lamps)) for scene in request.scenes)
        self.settings = hashlib.sha256(repr(request).encode()).hexdigest()[:12]

    def left(self, jobs: Iterable[Job]) -> list[Job]:
        """The jobs that are not done yet: no row says so, a result is gone, or the photo has changed since."""
        done: dict[str, bool] = {}
        for path in (self.path.with_name(MANIFEST), *self._others()):
            for row in _rows(path):
                done[row["photo"]] = row["status"] == "done" and row["settings"] == self.settings
        return [job for job in jobs if not (done.get(str(job.photo)) and _fresh(job.photo, job.outputs))]

    def add(self, outcome: Outcome) -> None:
        """Write a row; it is on disk when this returns."""
        self._write([self._row(outcome)])

    def merge(self) -> None:
        """Add the rows of other processes, which have ended or were interrupted, and remove their tables."""
        for path in self._others():
            self._write(_rows(path))
            path.unlink()

    def _others(self) -> list[Path]:
        return sorted(self.path.parent.glob("manifest.[0-9]*.csv"))

    def _write(self, rows: Sequence[Mapping[str, Any]]) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = not self.path.exists()
        with self.path.open("a", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
            if new:
                table.writeheader()
            table.writerows(rows)

    def _row(self, outcome: Outcome) -> dict[str, Any]:
        report = outcome.report
        row = {"photo": outcome.job.photo, "light": self.light, "settings": self.settings}
        if outcome.code:
            return {**row, "status": "failed", "error": report["error"]}
        pose, source = report["pose"] or {}, report["source_light"]
        return {
            **row,
            **pose,
            "status": "done",
            "output": " ".join(report["output"]),
            "landmarks": json.dumps(report["landmarks"]),
            "source_azimuth": source["azimuth"],
            "source_elevation": source["elevation"],
            "seconds": report["seconds"],
            "warnings": " | ".join(report["warnings"]),
        }


def _rows(path: Path) -> list[dict[str, str]]:
    """Of a table; none where there is none."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def _described(lamp: Any) -> str:
    return f"{lamp.azimuth:g},{lamp.elevation:g},size={lamp.size:g},power={lamp.power:g}"


def _fresh(photo: Path, outputs: Sequence[Path]) -> bool:
    """Whether all results are there, and not older than the photo."""
    try:
        taken = photo.stat().st_mtime
        return all(output.stat().st_mtime >= taken for output in outputs)
    except OSError:
        return False
