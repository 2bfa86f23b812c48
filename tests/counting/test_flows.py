"""Flows between lines and zones, and crossings that may be of one vessel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sightline.area import Area, Line, Polygon
from sightline.counting import CountReport, Flow, count
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.types import Track

PLANE = LocalPlane(54.3233, 10.1394)
START = 1_717_236_000.0


def eastward(number: int, north_m: float = 0.0, *, start_s: float = 0.0) -> Track:
    """From 200 m west to 200 m east of the middle at 4 m/s, known to 2 m."""
    time = START + start_s + np.arange(0.0, 101.0)
    n = len(time)
    return Track(
        track_id=number,
        time_utc_s=time,
        east_m=-200.0 + 4.0 * np.arange(n),
        north_m=np.full(n, north_m),
        velocity_east_mps=np.full(n, 4.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(4.0 * np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(0.01 * np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        label="boat",
    )


def degrees(*corners_m: tuple[float, float]) -> np.ndarray:
    latitude, longitude = PLANE.to_geographic(*np.array(corners_m).T)
    return np.column_stack([longitude, latitude])


def across(east_m: float) -> Line:
    return Line(degrees((east_m, -90.0), (east_m, 90.0)))


LINES = {"a": across(-100.0), "b": across(0.0), "c": across(100.0)}
BASIN = Area((Polygon((degrees((40.0, -90.0), (60.0, -90.0), (60.0, 90.0), (40.0, 90.0)),)),))


def counted(report: CountReport) -> dict[str, int]:
    return {str(row["name"]): int(row["count"] or 0) for row in report.flows}


def test_a_track_is_in_the_flow_that_takes_longest() -> None:
    flows = [Flow("short", "a", "b"), Flow("long", "a", "c"), Flow("back", "c", "a")]
    report = count([eastward(1)], lines=LINES, flows=flows)
    assert counted(report) == {"short": 0, "long": 1, "back": 0}
    (row,) = [row for row in report.flows if row["count"]]
    # 200 m at 4 m/s; each crossing is known to 2 m, which is half a second.
    assert row["travel_mean_s"] == pytest.approx(50.0, abs=0.1)
    assert row["travel_se_s"] == pytest.approx(np.hypot(0.5, 0.5), rel=0.1)
    assert counted(count([eastward(1)], lines=LINES, flows=flows[::2])) == {"short": 1, "back": 0}


def test_flows_begin_and_end_at_zones_as_well() -> None:
    flows = [Flow("in", "a", "basin"), Flow("through", "basin", "c")]
    report = count([eastward(1)], lines=LINES, zones={"basin": BASIN}, flows=flows)
    # 100 m west to 40 m east takes longer than 40 m to 100 m.
    assert counted(report) == {"in": 1, "through": 0}


def test_a_flow_to_nowhere_is_told() -> None:
    with pytest.raises(InputError, match="flow x: there is no line or zone 'd'"):
        count([eastward(1)], lines=LINES, flows=[Flow("x", "a", "d")])


def twice(*tracks: Track) -> int:
    report = count(tracks, lines={"b": LINES["b"]})
    return sum(int(row["maybe_twice"] or 0) for row in report.lines)


@pytest.mark.parametrize(
    ("north_m", "found"),
    # The difference of two tracks has a standard deviation of sqrt(8) m on each axis, and
    # chi squared with two degrees of freedom is below 5.991 in 95 %: 6.92 m.
    [(0.0, 1), (6.8, 1), (7.1, 0), (50.0, 0)],
)
def test_tracks_side_by_side_that_cannot_be_told_apart(north_m: float, found: int) -> None:
    assert twice(eastward(1), eastward(2, north_m)) == found


def test_tracks_one_after_the_other_are_two() -> None:
    assert twice(eastward(1), eastward(2, start_s=3.0)) == 0
    assert twice(eastward(1), eastward(2, start_s=1.0)) == 1
    # Of three in one place, two may be the first.
    assert twice(eastward(1), eastward(2), eastward(3)) == 2


def test_a_track_of_no_known_uncertainty_is_told_apart() -> None:
    unknown = np.full((101, 2, 2), np.nan)
    assert twice(eastward(1), replace(eastward(2), covariance_m2=unknown)) == 0
