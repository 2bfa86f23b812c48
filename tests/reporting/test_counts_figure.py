from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes

from sightline.counting import CountReport
from sightline.errors import InputError
from sightline.reporting.counts_figure import counts_figure

HOURS = ("2024-06-01T10:00:00Z", "2024-06-01T11:00:00Z", "2024-06-01T12:00:00Z")


def line_row(i: int, label: str, direction: str, n: int) -> dict[str, str | int | float | None]:
    return {
        "begin_utc": HOURS[i],
        "end_utc": HOURS[i + 1],
        "name": "gate",
        "class": label,
        "direction": direction,
        "bound": "eastbound" if direction == "left to right" else "westbound",
        "count": n,
        "expected": float(n),
        "sigma": 0.5,
    }


def report() -> CountReport:
    lines = [
        line_row(i, label, direction, 10 * i + 2 * (label == "boat") + (direction < "m"))
        for i in (0, 1)
        for label in ("boat", "ferry")
        for direction in ("left to right", "right to left")
    ]
    zones: list[dict[str, str | int | float | None]] = [
        {
            "begin_utc": HOURS[i],
            "end_utc": HOURS[i + 1],
            "name": "basin",
            "class": "boat",
            "occupancy_mean": 1.5 + i,
            "occupancy_sigma": 0.25,
        }
        for i in (0, 1)
    ]
    journey: dict[str, str | int | float | None] = {
        "origin": "gate",
        "destination": "p$ier",
        "count": 3,
    }
    return CountReport(lines=lines, zones=zones, journeys=[journey])


def heights(axes: Axes) -> list[float]:
    return sorted(round(float(bar.get_height()), 6) for bar in axes.patches)


def test_bars_are_the_counts_up_in_one_direction_and_down_in_the_other() -> None:
    gate, _, _ = counts_figure(report()).axes
    wanted = [
        sign * float(row["count"] or 0.0)
        for row in report().lines
        for sign in (1.0 if row["direction"] == "left to right" else -1.0,)
    ]
    assert heights(gate) == sorted(wanted)
    assert gate.get_title(loc="right") == "eastbound up, westbound down"
    # Two classes on each other, and a whisker of both together: sqrt(0.5^2 + 0.5^2).
    tops = [bar.get_y() + bar.get_height() for bar in gate.patches]
    assert max(tops) == pytest.approx(13.0 + 11.0)
    (low, high), *_ = gate.collections[0].get_segments()[1:2]
    assert (high[1] - low[1]) == pytest.approx(2.0 * np.sqrt(0.5))


def test_zones_and_journeys_have_panels_of_their_own() -> None:
    _, basin, journeys = counts_figure(report()).axes
    (steps,) = basin.patches
    assert steps.get_data().values.tolist() == [1.5, 2.5]  # type: ignore[attr-defined]
    assert [text.get_text() for text in journeys.texts] == ["3"]
    assert [tick.get_text() for tick in journeys.get_xticklabels()] == ["gate", "p$ier"]


def test_what_cannot_be_drawn_is_told() -> None:
    with pytest.raises(InputError, match="no line and no zone"):
        counts_figure(CountReport())
    rows = [{**row, "name": f"{row['name']}-{k}"} for k in range(13) for row in report().lines]
    with pytest.raises(InputError, match="13 lines and zones cannot be read"):
        counts_figure(CountReport(lines=rows))
