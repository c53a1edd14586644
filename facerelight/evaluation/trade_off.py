"""The plot of accuracy against time: a frontier on top, and below it small multiples, one panel a knob."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.gridspec import GridSpec
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

__all__ = ["Point", "draw_trade_off", "frontier"]

Row = Mapping[str, object]

LINE, DEFAULT, CONTEXT, BAND = "#1f6fb4", "#c8361d", "#c9c9c9", "#f1e3cf"
SMALL = 7.0  # points, of all text but titles
COLUMNS = 4
TIMES = tuple(digit * 10**power for power in range(5) for digit in (1, 2, 5))
WIDE = "light unknown"  # the knob whose values have long names
OWN_SCALE = ("input images", "pixels a group", WIDE)
"""Knobs whose rows are not comparable with the others: several inputs, or fewer people."""


class Point(NamedTuple):
    """A setting: its knob's ``value``, ``cost`` in milliseconds, ``error``; whether it is a ``default``, or ``apart``:
    measured on fewer people."""

    knob: str
    value: str
    cost: float
    error: float
    default: bool
    apart: bool


def frontier(points: Sequence[Point]) -> list[Point]:
    """Those that no cheaper one beats, from cheap to dear."""
    best, kept = float("inf"), []
    for point in sorted(points, key=lambda point: (point.cost, point.error)):
        if point.error < best:
            best = point.error
            kept.append(point)
    return kept


def draw_trade_off(relighting: Sequence[Row], recognition: Sequence[Row], path: str | Path) -> None:
    """Draw the tables of ``scripts/measure/accuracy_vs_time.py``.

    Args:
        relighting: rows with ``knob``, ``value``, ``default``, ``rmse_side``, ``milliseconds`` and ``people``.
        recognition: rows with ``knob``, ``value``, ``default``, ``error`` and ``enrol_ms``.
        path: of the picture.
    """
    relit, known = _points(relighting, "milliseconds", "rmse_side"), _points(recognition, "enrol_ms", "error")
    shared = [point for point in relit if not point.apart and point.knob not in OWN_SCALE]
    knobs = list(dict.fromkeys(point.knob for point in shared))
    own = [knob for knob in OWN_SCALE if any(point.knob == knob for point in relit)]
    asked = list(dict.fromkeys(point.knob for point in known))
    rows = [2.0] + [1.0] * (-(-len(knobs) // COLUMNS)) + [1.0] * bool(own) + [0.28] + [1.0] * -(-(len(asked) + 3) // 4)
    figure = Figure(figsize=(10.5, 1.0 + 1.62 * sum(rows)), dpi=110)
    grid = GridSpec(len(rows), COLUMNS, figure, height_ratios=rows, hspace=0.55, wspace=0.16)
    top = 1 - 0.62 / figure.get_figheight()
    grid.update(left=0.055, right=0.985, top=top, bottom=0.5 / figure.get_figheight())
    figure.text(0.055, 1 - 0.25 / figure.get_figheight(), "Relighting", fontsize=12, weight="bold", va="center")

    start, band = relit[0], _band(relit)
    low, high = _limits([point.error for point in shared])
    times = _reach([point.cost for point in shared])
    axis = figure.add_subplot(grid[0, :])
    _frontier_panel(axis, shared, start, band, times, (low, high))
    axis.set_ylabel("RMSE from a side-lit input,\ngrey levels", fontsize=SMALL + 1)
    axis.set_xlabel("milliseconds for one image and twelve lights", fontsize=SMALL + 1)
    last = len(knobs) - COLUMNS
    for index, knob in enumerate(knobs):
        axis = figure.add_subplot(grid[1 + index // COLUMNS, index % COLUMNS])
        _knob_panel(axis, knob, shared, start, band, times, (low, high), context=shared)
        axis.tick_params(labelleft=index % COLUMNS == 0, labelbottom=index >= last)
    place, row = 0, 1 + -(-len(knobs) // COLUMNS)
    for knob in own:
        width = 2 if knob == WIDE else 1
        axis = figure.add_subplot(grid[row, place : place + width])
        place += width
        chosen = [point for point in relit if point.knob == knob]
        _knob_panel(
            axis, knob, chosen, start, band, _reach([p.cost for p in chosen]), _limits([p.error for p in chosen])
        )
    row += bool(own)

    title = figure.add_subplot(grid[row, :])
    title.axis("off")
    title.text(0, 0, "Recognition", fontsize=12, weight="bold", transform=title.transAxes)
    row += 1
    times, limits = _reach([point.cost for point in known]), _limits([point.error for point in known])
    axis = figure.add_subplot(grid[row, : COLUMNS - 1])
    _frontier_panel(axis, known, known[0], None, times, limits)
    axis.set_ylabel("rank-1 errors, percent", fontsize=SMALL + 1)
    axis.set_xlabel("milliseconds to enrol a person", fontsize=SMALL + 1)
    for index, knob in enumerate(asked, COLUMNS - 1):
        axis = figure.add_subplot(grid[row + index // COLUMNS, index % COLUMNS])
        _knob_panel(axis, knob, known, known[0], None, times, limits, context=known)
    figure.savefig(path)


def _points(rows: Sequence[Row], cost: str, error: str) -> list[Point]:
    most = max((int(str(row["people"])) for row in rows if row.get("people")), default=0)
    return [
        Point(
            str(row["knob"]),
            str(row["value"]),
            float(str(row[cost])),
            float(str(row[error])),
            bool(row["default"]),
            0 < int(str(row.get("people") or 0)) < most,
        )
        for row in rows
    ]


def _band(points: Sequence[Point]) -> tuple[float, float]:
    """From the least to the most that the default itself took, each time that it was measured."""
    taken = [point.cost for point in points if point.default and point.error == points[0].error]
    return min(taken), max(taken)


def _limits(values: Sequence[float]) -> tuple[float, float]:
    least, most = min(values), max(values)
    room = 0.12 * (most - least or 1)
    return least - room, most + room


def _reach(values: Sequence[float]) -> tuple[float, float]:
    """On a logarithmic axis, with room for labels at the right."""
    least, most = min(values), max(values)
    room = max(1.25, (most / least) ** 0.08)
    return least / room, most * room * (most / least) ** 0.12


def _axes(axis: Axes, times: tuple[float, float], errors: tuple[float, float]) -> None:
    axis.set_xscale("log")
    axis.set_xlim(*times)
    axis.set_ylim(*errors)
    ticks = [time for time in TIMES if times[0] <= time <= times[1]]
    if len(ticks) > 6:
        ticks = [time for time in ticks if str(time)[0] == "1"]
    axis.xaxis.set_major_locator(FixedLocator(ticks))
    axis.xaxis.set_minor_locator(NullLocator())
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
    axis.tick_params(labelsize=SMALL, length=2, pad=2)
    axis.grid(color="#eeeeee", linewidth=0.6)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _frontier_panel(
    axis: Axes,
    points: Sequence[Point],
    start: Point,
    band: tuple[float, float] | None,
    times: tuple[float, float],
    errors: tuple[float, float],
) -> None:
    _axes(axis, times, errors)
    if band:
        axis.axvspan(*band, color=BAND, linewidth=0, zorder=0)
    best = frontier(points)
    axis.plot([p.cost for p in points], [p.error for p in points], "o", color=CONTEXT, markersize=4, zorder=2)
    steps = [*best, best[-1]._replace(cost=times[1])]
    axis.step([p.cost for p in steps], [p.error for p in steps], color=LINE, where="post", linewidth=1.2, zorder=3)
    axis.plot([p.cost for p in best], [p.error for p in best], "o", color=LINE, markersize=5, zorder=4)
    axis.plot(start.cost, start.error, "*", color=DEFAULT, markersize=12, zorder=5)
    axis.set_title("the frontier: what no cheaper setting beats", fontsize=SMALL + 2, loc="left", pad=4)
    names = {(p.cost, p.error): f"{p.knob}: {p.value}" for p in best}
    names[start.cost, start.error] = "default"
    _label(axis, names)


def _knob_panel(
    axis: Axes,
    knob: str,
    points: Sequence[Point],
    start: Point,
    band: tuple[float, float] | None,
    times: tuple[float, float],
    errors: tuple[float, float],
    context: Sequence[Point] = (),
) -> None:
    _axes(axis, times, errors)
    if band:
        axis.axvspan(*band, color=BAND, linewidth=0, zorder=0)
    axis.plot([p.cost for p in context], [p.error for p in context], "o", color=CONTEXT, markersize=2, zorder=2)
    chosen = [point for point in points if point.knob == knob]
    if all(point.value.replace(".", "").isdigit() for point in chosen):
        axis.plot([p.cost for p in chosen], [p.error for p in chosen], color=LINE, linewidth=0.9, zorder=3)
    for point in chosen:
        face = "white" if point.apart else LINE
        mark: dict[str, object] = {"color": LINE, "markerfacecolor": face, "markersize": 4.5}
        if point.default:
            mark = {"color": DEFAULT, "markerfacecolor": "white" if point.apart else DEFAULT, "markersize": 9}
        axis.plot(point.cost, point.error, "*" if point.default else "o", zorder=4, **mark)  # type: ignore[arg-type]
    if not any(point.default for point in chosen) and context:
        axis.plot(start.cost, start.error, "*", color=DEFAULT, markersize=9, zorder=4)
    axis.set_title(knob, fontsize=SMALL + 1.5, loc="left", pad=3)
    _label(axis, {(p.cost, p.error): p.value for p in chosen})


def _label(axis: Axes, names: Mapping[tuple[float, float], str]) -> None:
    """Names beside their points, moved up and down until none lies on another; lines lead to those that moved far."""
    axis.figure.canvas.draw()
    scale = axis.figure.dpi / 72
    height, gap = SMALL * 1.15 * scale, 6 * scale
    box = axis.get_window_extent()
    placed: list[tuple[float, float, float, float, str]] = []
    for point, name in sorted(names.items(), key=lambda item: item[0][1]):
        x, y = axis.transData.transform(point)
        width = 0.52 * SMALL * scale * len(name)
        right = x + gap + width < box.x1 + 4 * scale
        left = x + gap if right else x - gap - width
        spot = y
        for _ in range(60):
            hits = [p for p in placed if abs(p[1] - spot) < height and p[0] < left + width and left < p[0] + p[2]]
            if not hits:
                break
            spot = max(p[1] for p in hits) + height
        placed.append((left, spot, width, y, name))
        back = axis.transData.inverted()
        axis.annotate(
            name,
            point,
            back.transform((left if right else left + width, spot)),
            fontsize=SMALL,
            va="center",
            ha="left" if right else "right",
            zorder=6,
            arrowprops={"arrowstyle": "-", "color": "#999999", "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2}
            if abs(spot - y) > height
            else None,
        )
