"""The plot of accuracy against time."""

from pathlib import Path

from PIL import Image

from facerelight.evaluation.results import read_rows
from facerelight.evaluation.trade_off import Point, Table, draw_trade_off, frontier

RESULTS = Path(__file__).parents[2] / "scripts" / "results" / "accuracy_vs_time.csv"


def points(*pairs: tuple[float, float]) -> list[Point]:
    return [Point("knob", str(index), cost, error, False) for index, (cost, error) in enumerate(pairs)]


def test_the_frontier_is_what_no_cheaper_setting_beats() -> None:
    assert [p.value for p in frontier(points((3, 1), (1, 5), (2, 5), (2, 4), (4, 2)))] == ["1", "3", "0"]
    assert frontier([]) == []


def test_what_was_measured_is_drawn(tmp_path: Path) -> None:
    rows = [row for row in read_rows(RESULTS) if row["table"] == "relighting"]
    table = Table("Relighting", rows, ("rmse_side", "RMSE", "RMSE"), ("milliseconds", "ms"), ("input images",))
    found = table.points()
    assert sum(point.fewer for point in found) == 10
    assert found[0].default
    draw_trade_off([table, Table("One", rows[:2], table.error, table.cost)], tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.width > 1000
        assert len(picture.convert("RGB").getcolors(1 << 24) or []) > 50
