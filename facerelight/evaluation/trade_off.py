"""The plot of accuracy against time: the frontier on top, and below it small multiples, one panel a knob."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox

__all__ = ["Point", "Table", "draw_trade_off", "frontier"]

BLUE, RED, GREY, BAND = "#1f6fb4", "#c8361d", "#c4c4c4", "#f3e6d3"
TEXT, HEADING = 7.5, 10.0  # points
WIDTH, LEFT, COLUMNS = 10.8, 0.12, 3  # inches; panels side by side
ROW, WRAPPED = 0.175, 0.27  # inches of a value; of one whose name takes two lines
ABOVE, BELOW = 0.3, 0.34  # inches of a panel's title and of its ticks
LABELS, STRIP, GAP = 1.2, 0.98, 0.08  # inches: values, error or time, between them
FRONTIER = 2.1  # inches
LETTERS = 25  # of a value in one line
LEGEND = "star: the default; band: what it took, from least to most, each time that it was measured"
TIMES = tuple(digit * 10**power for power in range(5) for digit in (1, 2, 5))


class Point(NamedTuple):
    """A setting of a knob: its ``cost`` in milliseconds and its ``error``; whether it is the ``default``, and whether
    it was measured on ``fewer`` people than others."""

    knob: str
    value: str
    cost: float
    error: float
    default: bool
    fewer: bool = False


@dataclass(frozen=True)
class Table:
    """What one frontier and its panels show.

    Args:
        title: above all.
        rows: with ``knob``, ``value`` and ``default``, and ``people`` where some were measured on fewer.
        error: the column of errors, and what it is called, at length and in short.
        cost: the column of milliseconds, and what it is called.
        apart: knobs that change what is known of a face, and so have scales of their own.
    """

    title: str
    rows: Sequence[Mapping[str, object]]
    error: tuple[str, str, str]
    cost: tuple[str, str]
    apart: tuple[str, ...] = ()

    def points(self) -> list[Point]:
        """One a row; the first is the default of all knobs."""
        people = [int(str(row.get("people") or 0)) for row in self.rows]
        return [
            Point(
                str(row["knob"]),
                str(row["value"]),
                float(str(row[self.cost[0]])),
                float(str(row[self.error[0]])),
                bool(row["default"]),
                number < max(people),
            )
            for row, number in zip(self.rows, people, strict=True)
        ]


def frontier(points: Sequence[Point]) -> list[Point]:
    """Those that no cheaper one beats, from cheap to dear."""
    best, kept = float("inf"), []
    for point in sorted(points, key=lambda point: (point.cost, point.error)):
        if point.error < best:
            best = point.error
            kept.append(point)
    return kept


def draw_trade_off(tables: Sequence[Table], path: str | Path) -> None:
    """One table below the other, into a picture."""
    parts = [_Part(table) for table in tables]
    height = sum(part.height for part in parts)
    figure = Figure(figsize=(WIDTH, height), dpi=110)
    top = height
    for part in parts:
        part.draw(figure, top)
        top -= part.height
    figure.savefig(path)


class _Part:
    """A table's frontier and panels, and where they go."""

    def __init__(self, table: Table) -> None:
        self.table, self.points = table, table.points()
        self.knobs = {p.knob: [q for q in self.points if q.knob == p.knob] for p in self.points}
        fewer = {knob for knob, points in self.knobs.items() if any(point.fewer for point in points)}
        self.apart = fewer | set(table.apart)
        self.shared = [point for point in self.points if point.knob not in self.apart]
        self.columns = _columns({knob: _panel_height(points) for knob, points in self.knobs.items()})
        panels = max(sum(_panel_height(self.knobs[knob]) for knob in column) for column in self.columns)
        self.height = 0.75 + FRONTIER + 0.5 + panels + 0.1

    def draw(self, figure: Figure, top: float) -> None:
        """From ``top`` inches above the figure's foot downwards."""
        tall = figure.get_figheight()
        figure.text(LEFT / WIDTH, (top - 0.28) / tall, self.table.title, fontsize=13, weight="bold", va="center")
        told = LEGEND + ("; hollow: measured on fewer people" if any(p.fewer for p in self.points) else "")
        figure.text(1 - 0.18 / WIDTH, (top - 0.28) / tall, told, fontsize=TEXT + 0.5, ha="right", va="center")
        foot = top - 0.75 - FRONTIER
        axis = figure.add_axes((0.62 / WIDTH, foot / tall, (WIDTH - 0.8) / WIDTH, FRONTIER / tall))
        self._frontier(axis)
        for column, knobs in enumerate(self.columns):
            left, place = LEFT + column * (WIDTH - 2 * LEFT) / COLUMNS, foot - 0.5
            for knob in knobs:
                place -= _panel_height(self.knobs[knob])
                self._panel(figure, knob, left, place)

    def _frontier(self, axis: Axes) -> None:
        times = _span([point.cost for point in self.shared], 0.04)
        _times(axis, times)
        axis.set_ylim(*_span_linear([point.error for point in self.shared], 0.12))
        axis.grid(color="#eeeeee", linewidth=0.6)
        self._band(axis)
        best, start = frontier(self.shared), self.points[0]
        steps = [*best, best[-1]._replace(cost=times[1])]
        axis.plot([p.cost for p in self.shared], [p.error for p in self.shared], "o", color=GREY, markersize=4)
        axis.step([p.cost for p in steps], [p.error for p in steps], color=BLUE, where="post", linewidth=1.3)
        axis.plot([p.cost for p in best], [p.error for p in best], "o", color=BLUE, markersize=5.5, zorder=4)
        axis.plot(start.cost, start.error, "*", color=RED, markersize=13, zorder=5)
        axis.set_xlabel(self.table.cost[1], fontsize=TEXT + 1)
        axis.set_ylabel(self.table.error[1], fontsize=TEXT + 1)
        title = "every setting (grey) and the frontier (blue): what no cheaper setting beats"
        axis.set_title(title, fontsize=HEADING, loc="left", pad=4)
        names = [("default", start, RED)]
        names += [(f"{p.knob} {p.value}", p, BLUE) for p in best if (p.cost, p.error) != (start.cost, start.error)]
        _name_points(axis, names, self.shared, steps)

    def _band(self, axis: Axes) -> None:
        """From the least to the most that the default itself took, each time that it was measured."""
        taken = [p.cost for p in self.shared if p.default and p.error == self.points[0].error]
        axis.axvspan(min(taken), max(taken), color=BAND, linewidth=0, zorder=0)

    def _panel(self, figure: Figure, knob: str, left: float, foot: float) -> None:
        """Values below each other, and beside them error and time."""
        tall, points = figure.get_figheight(), self.knobs[knob]
        among = points if knob in self.apart else self.shared
        row = _row_height(points)
        axes = [
            figure.add_axes((x / WIDTH, (foot + BELOW) / tall, STRIP / WIDTH, row * len(points) / tall))
            for x in (left + LABELS + GAP, left + LABELS + STRIP + 3 * GAP)
        ]
        figure.text(
            (left + 0.15) / WIDTH,
            (foot + BELOW + row * len(points) + 0.06) / tall,
            knob,
            fontsize=HEADING,
            weight="bold",
        )
        places = range(len(points), 0, -1)
        for axis in axes:
            axis.set_ylim(0.4, len(points) + 0.6)
            axis.yaxis.set_major_locator(FixedLocator(list(places)))
            axis.grid(axis="y", color="#e6e6e6", linewidth=0.6)
        error, cost = axes
        error.set_yticklabels(["\n".join(textwrap.wrap(point.value, LETTERS)) for point in points], fontsize=TEXT)
        cost.set_yticklabels([])
        error.set_xlim(*_span_linear([point.error for point in among], 0.1, more=0.3))
        error.xaxis.set_major_locator(MaxNLocator(3))
        _times(cost, _span([point.cost for point in among], 0.1, more=0.36), few=True)
        if knob not in self.apart:
            self._band(cost)
        for axis in axes:
            axis.tick_params(labelsize=TEXT - 0.5, length=2, pad=2)
            axis.tick_params(axis="y", labelsize=TEXT, length=0)
            for side in ("top", "right"):
                axis.spines[side].set_visible(False)
        cost.set_xlabel("ms", fontsize=TEXT - 0.5, labelpad=1)
        error.set_xlabel(self.table.error[2], fontsize=TEXT - 0.5, labelpad=1)
        for point, place in zip(points, places, strict=True):
            colour = RED if point.default else BLUE
            texts = (f"{point.error:.1f}", _short(point.cost))
            for axis, value, text in zip(axes, (point.error, point.cost), texts, strict=True):
                mark, size = ("*", 9.0) if point.default else ("o", 4.5)
                face = "white" if point.fewer else colour
                axis.plot(value, place, mark, color=colour, markersize=size, markerfacecolor=face)
                axis.annotate(
                    text,
                    (value, place),
                    (6 if point.default else 5, 0),
                    textcoords="offset points",
                    va="center",
                    fontsize=TEXT,
                    color=colour,
                )


def _columns(heights: Mapping[str, float]) -> list[list[str]]:
    """Panels in columns of about one height, in the order of the table."""
    columns: list[list[str]] = [[]]
    share, filled = sum(heights.values()) / COLUMNS, 0.0
    for knob, height in heights.items():
        if len(columns) < COLUMNS and columns[-1] and filled + height / 2 > share * len(columns):
            columns.append([])
        columns[-1].append(knob)
        filled += height
    return columns


def _row_height(points: Sequence[Point]) -> float:
    return WRAPPED if any(len(point.value) > LETTERS for point in points) else ROW


def _panel_height(points: Sequence[Point]) -> float:
    return ABOVE + _row_height(points) * len(points) + BELOW


def _short(milliseconds: float) -> str:
    """Milliseconds, or seconds with their unit, of two or three digits."""
    return f"{milliseconds / 1000:.3g} s" if milliseconds >= 1000 else f"{milliseconds:.0f}"


def _span_linear(values: Sequence[float], room: float, more: float = 0.0) -> tuple[float, float]:
    """Limits of an axis, with a share of room at both ends, and more at the upper."""
    least, most = min(values), max(values)
    width = most - least or 1.0
    return least - room * width, most + (room + more) * width


def _span(values: Sequence[float], room: float, more: float = 0.0) -> tuple[float, float]:
    """The same on a logarithmic axis."""
    low, high = _span_linear([float(np.log(value)) for value in values], room, more)
    return float(np.exp(low)), float(np.exp(high))


def _times(axis: Axes, limits: tuple[float, float], few: bool = False) -> None:
    """A logarithmic axis with whole numbers."""
    axis.set_xscale("log")
    axis.set_xlim(*limits)
    ticks = [time for time in TIMES if limits[0] <= time <= limits[1]]
    if few and len(ticks) > 3:
        ticks = [time for time in ticks if str(time)[0] == "1"]
    axis.xaxis.set_major_locator(FixedLocator(ticks))
    axis.xaxis.set_minor_locator(NullLocator())
    shown = _short if few else "{:,.0f}".format
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: shown(value)))
    axis.tick_params(labelsize=TEXT)
    axis.set_axisbelow(True)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)


def _name_points(
    axis: Axes, names: Sequence[tuple[str, Point, str]], points: Sequence[Point], steps: Sequence[Point]
) -> None:
    """Write names near their points where they cover neither points, nor the frontier, nor each other."""
    scale = axis.figure.dpi / 72
    corners = [p for a, b in pairwise(steps) for p in ((a.cost, a.error), (b.cost, a.error))]
    line = axis.transData.transform([*corners, (steps[-1].cost, steps[-1].error)])
    pieces = [a + (b - a) * t for a, b in pairwise(line) for t in np.linspace(0, 1, 100)]
    taken = np.vstack([axis.transData.transform([(p.cost, p.error) for p in points]), *[p[None] for p in pieces]])
    placed: list[Bbox] = []
    inside = axis.bbox
    for name, point, colour in names:
        at = axis.transData.transform((point.cost, point.error))
        width, height = 0.56 * TEXT * scale * len(name), 1.25 * TEXT * scale
        for x, y in _around(width, height, scale):
            box = Bbox.from_bounds(at[0] + x - width / 2, at[1] + y - height / 2, width, height)
            grown = Bbox.from_extents(box.x0 - 3, box.y0 - 3, box.x1 + 3, box.y1 + 3)
            within = inside.x0 < box.x0 and box.x1 < inside.x1 and inside.y0 < box.y0 and box.y1 < inside.y1
            if within and not grown.count_contains(taken) and not any(grown.overlaps(other) for other in placed):
                break
        placed.append(box)
        far = float(np.hypot(x, y)) > 2.2 * height
        axis.annotate(
            name,
            (point.cost, point.error),
            (x / scale, y / scale),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=TEXT + 0.5,
            color=colour,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6, "shrinkB": 4} if far else None,
        )


def _around(width: float, height: float, scale: float) -> Iterator[tuple[float, float]]:
    """Places of a name's middle, in pixels from its point, near ones first."""
    for away in (9, 16, 24, 34, 46, 60):
        reach = away * scale
        for x, y in ((0, -1), (0, 1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
            yield x * (reach + width / 2), y * (reach + height / 2 if not x else reach)
