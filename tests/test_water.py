"""How high the water stands at a time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_water_levels
from sightline.water import WaterLevels

HOUR_S = 3600.0
START_S = 1_700_000_000.0


def test_a_gauge_is_followed_straight_from_row_to_row() -> None:
    levels = WaterLevels(START_S + 600.0 * np.arange(4), np.array([0.2, 0.3, 0.5, 0.4]))
    asked = START_S + np.array([0.0, 300.0, 600.0, 1500.0, 1800.0])
    np.testing.assert_allclose(levels.at(asked), [0.2, 0.25, 0.3, 0.45, 0.4], atol=1e-12)
    # A little beyond its ends it holds.
    np.testing.assert_allclose(levels.at(START_S + np.array([-900.0, 3000.0])), [0.2, 0.4])


def test_between_high_and_low_water_the_tide_is_half_a_cosine() -> None:
    """Rows at the turns of a tide of 12.4 h give the tide itself."""
    period_s = 12.4 * HOUR_S
    turns_s = START_S + 0.5 * period_s * np.arange(6)
    levels = WaterLevels(turns_s, 1.0 + 0.8 * (-1.0) ** np.arange(6))
    asked = np.linspace(turns_s[0], turns_s[-1], 200)
    tide = 1.0 + 0.8 * np.cos(2.0 * np.pi * (asked - START_S) / period_s)
    np.testing.assert_allclose(levels.at(asked), tide, atol=1e-9)


def test_one_level_holds_at_all_times() -> None:
    levels = WaterLevels.constant(1.3)
    np.testing.assert_array_equal(levels.at([0.0, START_S, np.nan]), 1.3)


@pytest.mark.parametrize(
    ("asked_s", "told"),
    [
        (START_S - HOUR_S, "say nothing of 2023-11-14 21:13:20"),
        (START_S + 30.0 * HOUR_S, "say nothing of 2023-11-16 04:13:20"),
        (START_S + 10.0 * HOUR_S, "no gap may be longer than 8 h"),
        (np.nan, "say nothing of a frame without a time"),
    ],
    ids=["before", "after", "in a gap", "no time"],
)
def test_a_time_of_which_levels_say_nothing_is_refused(asked_s: float, told: str) -> None:
    levels = WaterLevels(START_S + HOUR_S * np.array([0.0, 6.0, 20.0]), np.array([0.0, 1.0, 0.5]))
    with pytest.raises(InputError, match=told) as caught:
        levels.at([START_S + HOUR_S, asked_s])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("times", "levels"),
    [([], []), ([1.0, 1.0], [0.0, 0.0]), ([2.0, 1.0], [0.0, 0.0]), ([1.0], [np.nan]), ([1.0], [])],
)
def test_levels_that_cannot_be_are_refused(times: list[float], levels: list[float]) -> None:
    with pytest.raises(InputError, match="water levels"):
        WaterLevels(np.array(times), np.array(levels))


def test_a_table_is_read_as_it_stands(tmp_path: Path) -> None:
    path = tmp_path / "tide.csv"
    path.write_text(
        "time_utc,water_level_m,station\n2024-06-01T10:00:00Z,0.4,pier\n"
        "2024-06-01T10:30:00Z,0.6,pier\n",
        encoding="utf-8",
    )
    levels = read_water_levels(path)
    np.testing.assert_array_equal(levels.time_utc_s, [1717236000.0, 1717237800.0])
    np.testing.assert_array_equal(levels.level_m, [0.4, 0.6])


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("time_utc,water_level_m\n", "holds 0 levels"),
        ("time_utc,water_level_m\n2024-06-01T10:00:00Z,0.4\n", "holds 1 levels"),
        ("time_utc,level\n2024-06-01T10:00:00Z,0.4\n", "water_level_m"),
        ("time_utc,water_level_m\n2024-06-01T10:00:00Z,high\n2024-06-01T11:00:00Z,1\n", "high"),
        ("time_utc,water_level_m\nnoon,1\n2024-06-01T11:00:00Z,1\n", "noon"),
        (
            "time_utc,water_level_m\n2024-06-01T11:00:00Z,1\n2024-06-01T10:00:00Z,1\n",
            "times must increase",
        ),
        ("", "empty"),
    ],
    ids=["none", "one", "no column", "no number", "no time", "backwards", "empty"],
)
def test_a_table_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, content: str, told: str
) -> None:
    path = tmp_path / "tide.csv"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=told) as caught:
        read_water_levels(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
