"""Counts as a figure: by interval, class and direction, in zones, and from where to where."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import datetime

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from sightline.counting import CountReport
from sightline.counting.count import LEFT_TO_RIGHT, Row
from sightline.errors import InputError
from sightline.reporting.plots import SERIES_COLOURS, new_figure, tidy, title_panel
from sightline.text import figure_text
from sightline.types import FloatArray

_MOST_PANELS = 12
_MOST_PLACES = 20
_OTHER = "others"
_INK, _FAINT = "#333333", "#8a8a8a"


def counts_figure(report: CountReport) -> Figure:
    """Counts: a panel each line and zone, and a matrix of origins and destinations.

    A line's bars go up from left to right and down from right to left, its whiskers one standard
    deviation of what is expected around it. A zone's steps are its mean occupancy, with one
    standard deviation shaded.

    Raises:
        InputError: Nothing was counted that could be drawn.
    """
    lines, zones = _by_name(report.lines), _by_name(report.zones)
    panels = [*lines.items(), *zones.items()]
    trips = report.journeys or [row for row in report.flows if row["count"]]
    if not panels:
        raise InputError("there is no line and no zone, so there is no figure of counts")
    if len(panels) > _MOST_PANELS:
        raise InputError(
            f"a figure of {len(panels)} lines and zones cannot be read; draw at most "
            f"{_MOST_PANELS} at a time"
        )
    classes = _classes([*report.lines, *report.zones])
    rows = len(panels) + (1 if trips else 0)
    heights = [1.0] * len(panels) + ([1.4] if trips else [])
    figure = new_figure(8.0, 2.2 * sum(heights) + 0.9)
    grid = figure.subplots(rows, 1, squeeze=False, gridspec_kw={"height_ratios": heights})[:, 0]
    for axes, (name, found) in zip(grid, panels, strict=False):
        if name in lines and found is lines[name]:
            _draw_line(axes, found, classes)
            title_panel(axes, f"line {name}", fontsize=10)
            axes.set_title(_bounds(found), loc="right", fontsize=9, color=_FAINT)
        else:
            _draw_zone(axes, found, classes)
            title_panel(axes, f"zone {name}", fontsize=10)
        locator = AutoDateLocator()  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        formatter = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_formatter(formatter)
        tidy(axes)
    grid[len(panels) - 1].set_xlabel("UTC")
    if trips:
        _draw_matrix(grid[-1], trips)
    figure.legend(
        handles=[Patch(fc=_colour(k), label=figure_text(name)) for k, name in enumerate(classes)],
        loc="outside lower center",
        ncols=max(min(len(classes), 4), 1),
        frameon=False,
    )
    return figure


def _by_name(rows: Iterable[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(str(row["name"]), []).append(row)
    return found


def _classes(rows: Iterable[Row]) -> list[str]:
    """The classes by how often they were counted; what has no colour of its own is together."""
    total: dict[str, float] = {}
    for row in rows:
        counted = float(row.get("count") or 0.0) + float(row.get("occupancy_mean") or 0.0)
        total[str(row["class"])] = total.get(str(row["class"]), 0.0) + counted
    names = sorted(total, key=lambda name: (-total[name], name))
    most = len(SERIES_COLOURS) - 1
    return names if len(names) <= most else [*names[: most - 1], _OTHER]


def _colour(k: int) -> str:
    return SERIES_COLOURS[k % len(SERIES_COLOURS)]


def _times(rows: Sequence[Row]) -> tuple[FloatArray, FloatArray]:
    """Begins of the intervals, and their length; days since 1970, as Matplotlib has them."""
    begins = sorted({(str(row["begin_utc"]), str(row["end_utc"])) for row in rows})
    edges = np.array(
        [[datetime.fromisoformat(text).timestamp() / 86400.0 for text in pair] for pair in begins]
    )
    return edges[:, 0], edges[:, 1] - edges[:, 0]


def _column(
    rows: Sequence[Row], key: str, classes: Sequence[str], *, squared: bool = False
) -> FloatArray:
    """(classes, intervals) sums of a column; unknown as 0."""
    begins = sorted({str(row["begin_utc"]) for row in rows})
    number = {text: i for i, text in enumerate(begins)}
    table = np.zeros((len(classes), len(begins)))
    for row in rows:
        name = str(row["class"])
        k = classes.index(name) if name in classes else len(classes) - 1
        value = float(row[key] or 0.0)
        table[k, number[str(row["begin_utc"])]] += value * value if squared else value
    return table


def _draw_line(axes: Axes, rows: Sequence[Row], classes: Sequence[str]) -> None:
    begin, width = _times(rows)
    for right in (True, False):
        own = [row for row in rows if (row["direction"] == LEFT_TO_RIGHT) == right]
        sign = 1.0 if right else -1.0
        base = np.zeros(len(begin))
        for k, values in enumerate(_column(own, "count", classes)):
            axes.bar(
                begin + 0.5 * width,
                sign * values,
                0.86 * width,
                bottom=sign * base,
                color=_colour(k),
                edgecolor="white",
                linewidth=0.6,
            )
            base += values
        expected = _column(own, "expected", classes).sum(axis=0)
        sigma = np.sqrt(_column(own, "sigma", classes, squared=True).sum(axis=0))
        # Fewer than none are not to be expected.
        below = np.minimum(sigma, expected)
        unsure = sigma > 0.02
        axes.errorbar(
            (begin + 0.5 * width)[unsure],
            sign * expected[unsure],
            np.stack([below, sigma] if right else [sigma, below])[:, unsure],
            fmt="none",
            ecolor=_INK,
            elinewidth=1.2,
            capsize=3.0,
        )
    axes.axhline(0.0, color=_INK, lw=0.8)
    axes.set_xlim(begin[0], begin[-1] + width[-1])
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{abs(value):g}"))
    axes.set_ylabel("crossings")


def _bounds(rows: Sequence[Row]) -> str:
    up = next(str(row["bound"]) for row in rows if row["direction"] == LEFT_TO_RIGHT)
    down = next(str(row["bound"]) for row in rows if row["direction"] != LEFT_TO_RIGHT)
    return f"{up} up, {down} down"


def _draw_zone(axes: Axes, rows: Sequence[Row], classes: Sequence[str]) -> None:
    begin, width = _times(rows)
    edges = np.r_[begin, begin[-1] + width[-1]]
    sigmas = _column(rows, "occupancy_sigma", classes)
    for k, values in enumerate(_column(rows, "occupancy_mean", classes)):
        if not values.any():
            continue
        axes.stairs(values, edges, color=_colour(k), lw=1.8)
        low, high = (np.r_[one, one[-1]] for one in (values - sigmas[k], values + sigmas[k]))
        axes.fill_between(
            edges, np.maximum(low, 0.0), high, step="post", color=_colour(k), alpha=0.18, lw=0.0
        )
    axes.set_xlim(edges[0], edges[-1])
    axes.set_ylim(bottom=0.0)
    axes.set_ylabel("mean occupancy")


def _draw_matrix(axes: Axes, rows: Sequence[Row]) -> None:
    """Journeys by origin and destination, over all intervals and classes."""
    names = sorted({str(row[key]) for row in rows for key in ("origin", "destination")})
    names = names[:_MOST_PLACES]
    table = np.zeros((len(names), len(names)))
    for row in rows:
        if row["origin"] in names and row["destination"] in names:
            at = names.index(str(row["origin"])), names.index(str(row["destination"]))
            table[at] += float(row["count"] or 0.0)
    axes.imshow(table, cmap="Blues", vmin=0.0, vmax=max(2.0 * float(table.max()), 1.0))
    for (i, j), value in np.ndenumerate(table):
        if value:
            axes.text(j, i, f"{value:g}", ha="center", va="center", color=_INK, fontsize=10)
    shown = [figure_text(name) for name in names]
    for ticks in (
        axes.set_xticks(range(len(names)), shown),
        axes.set_yticks(range(len(names)), shown),
    ):
        for tick in ticks:
            tick.label1.set_parse_math(False)
    axes.set_xlabel("to")
    axes.set_ylabel("from")
    title_panel(axes, "journeys", fontsize=10)
    tidy(axes)
    axes.grid(visible=False)
