"""A table of what was done with every photo of a batch: a row is written when its photo ends, so that an interrupted
run can be gone on with."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterable, Sequence
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
    """

    def __init__(self, folder: Path, request: Request) -> None:
        self.path = folder / MANIFEST
        self.light = "; ".join(" + ".join(map(_described, scene.lamps)) for scene in request.scenes)
        self.settings = hashlib.sha256(repr(request).encode()).hexdigest()[:12]

    def left(self, jobs: Iterable[Job]) -> list[Job]:
        """The jobs that are not done yet: no row says so, a result is gone, or the photo has changed since."""
        done: dict[str, bool] = {}
        if self.path.exists():
            with self.path.open(newline="", encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    done[row["photo"]] = row["status"] == "done" and row["settings"] == self.settings
        return [job for job in jobs if not (done.get(str(job.photo)) and _fresh(job.photo, job.outputs))]

    def add(self, outcome: Outcome) -> None:
        """Write a row; it is on disk when this returns."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        new = not self.path.exists()
        with self.path.open("a", newline="", encoding="utf-8") as file:
            table = csv.DictWriter(file, COLUMNS, restval="", lineterminator="\n")
            if new:
                table.writeheader()
            table.writerow(self._row(outcome))

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


def _described(lamp: Any) -> str:
    return f"{lamp.azimuth:g},{lamp.elevation:g},size={lamp.size:g},power={lamp.power:g}"


def _fresh(photo: Path, outputs: Sequence[Path]) -> bool:
    """Whether all results are there, and not older than the photo."""
    try:
        taken = photo.stat().st_mtime
        return all(output.stat().st_mtime >= taken for output in outputs)
    except OSError:
        return False
