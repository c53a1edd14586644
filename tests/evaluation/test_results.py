"""What scripts keep of a run, and what it cost."""

import json
import sys
import time
from pathlib import Path

import pytest

from facerelight.evaluation.cost import paired, peak_memory_mb
from facerelight.evaluation.results import ScriptParser, joined_rows, markdown, read_rows

ROWS = [{"value": 1, "default": "yes"}, {"value": 2, "error": 0.5}]


@pytest.fixture
def parser(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ScriptParser:
    script = tmp_path / "scripts" / "measure" / "speed.py"
    script.parent.mkdir(parents=True)
    monkeypatch.setattr(sys, "argv", [str(script), "--data", "/somewhere/faces.npz", "--csv"])
    made = ScriptParser(str(script), "How fast.")
    made.add_faces()
    made.add_size(48, 42)
    made.add_results("csv", "json")
    return made


def test_results_are_kept_when_asked_for_and_say_where_they_come_from(parser: ScriptParser, tmp_path: Path) -> None:
    args = parser.parse_args()
    assert args.csv == tmp_path / "scripts" / "results" / "speed.csv"
    assert args.json is None
    parser.save_rows(args.csv, ROWS)
    lines = args.csv.read_text().splitlines()
    assert lines[0] == "# command: python scripts/measure/speed.py --data faces.npz --csv"
    assert [line.split(": ")[0] for line in lines[:4]] == ["# command", "# date", "# machine", "# commit"]
    assert read_rows(args.csv) == [
        {"value": "1", "default": "yes", "error": ""},
        {"value": "2", "default": "", "error": "0.5"},
    ]
    parser.save_rows(None, ROWS)
    parser.save_report(None, {})
    assert [path.name for path in args.csv.parent.iterdir()] == ["speed.csv"]


@pytest.mark.parametrize("report", [{"results": 3}, [{"results": 3}, {"results": 4}]])
def test_a_report_keeps_its_keys(parser: ScriptParser, tmp_path: Path, report: dict | list) -> None:
    args = parser.parse_args(["--data", "faces.npz", "--json", str(tmp_path / "new" / "report.json")])
    parser.save_report(args.json, report)
    found = json.loads(args.json.read_text())
    for part, before in zip(
        *((each if isinstance(each, list) else [each]) for each in (found, report)),
        strict=True,
    ):
        assert list(part.pop("made")) == ["command", "date", "machine", "commit"]
        assert part == before


def test_a_table_marks_the_default() -> None:
    assert markdown(ROWS, bold="value").splitlines() == [
        "| value | error |",
        "|---|---|",
        "| **1** |  |",
        "| 2 | 0.5 |",
    ]
    assert markdown([{"a_b": 1}]).splitlines()[0] == "| a b |"


def test_pairs_run_in_turn() -> None:
    ran = []
    cost = paired(lambda: ran.append("a") or time.sleep(2e-3), lambda: ran.append("b"), repeats=3, bares=2)
    assert ran == ["a", "b", *["a", "b", "b"] * 3]
    assert cost.ours >= 2e-3 > cost.bare
    assert cost.ratio > 1


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="needs Linux")
def test_memory_is_what_is_needed_on_top() -> None:
    assert 30 < peak_memory_mb(lambda: bytearray(40_000_000)) < 60


def test_rows_of_several_runs_are_joined(tmp_path: Path) -> None:
    first, second = tmp_path / "first.csv", tmp_path / "second.csv"
    first.write_text("# command: none\nname,count,error,share\nall,2,1.0,\nfront,1,4.00,0.5\n")
    second.write_text("name,count,error,share\nall,6,3.0,0.25\n")
    rows = joined_rows([first, second], ("name",), "count")
    assert rows == [
        {"name": "all", "count": 8, "error": 2.5, "share": 0.25},
        {"name": "front", "count": 1, "error": 4.0, "share": 0.5},
    ]
    with pytest.raises(ValueError, match="got none called missing"):
        joined_rows([first], ("missing",), "count")
    with pytest.raises(ValueError, match="expected files with rows"):
        joined_rows([], ("name",), "count")
