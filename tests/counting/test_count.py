"""Counts against closed forms: the error of a track at a line is one normal number."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from sightline.area import Area, Line, Polygon
from sightline.counting import CountReport, CountSettings, count
from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.types import Track

PLANE = LocalPlane(54.3233, 10.1394)
START = 1_717_236_000.0
"""10:00 UTC, where an interval of any usual length begins."""


def line(*corners_m: tuple[float, float]) -> Line:
    latitude, longitude = PLANE.to_geographic(*np.array(corners_m).T)
    return Line(np.column_stack([longitude, latitude]))


def zone(*corners_m: tuple[float, float]) -> Area:
    latitude, longitude = PLANE.to_geographic(*np.array(corners_m).T)
    return Area((Polygon((np.column_stack([longitude, latitude]),)),))


def straight(
    begin_m: tuple[float, float],
    velocity_mps: tuple[float, float],
    seconds: float = 100.0,
    *,
    covariance: tuple[float, float] | None = (4.0, 4.0),
    start_s: float = 0.0,
    number: int = 1,
    label: str = "boat",
    step_s: float = 1.0,
) -> Track:
    time = np.arange(0.0, seconds + 1e-9, step_s)
    n = len(time)
    known = np.diag([np.nan, np.nan] if covariance is None else covariance)
    return Track(
        track_id=number,
        time_utc_s=START + start_s + time,
        east_m=begin_m[0] + velocity_mps[0] * time,
        north_m=begin_m[1] + velocity_mps[1] * time,
        velocity_east_mps=np.full(n, velocity_mps[0]),
        velocity_north_mps=np.full(n, velocity_mps[1]),
        covariance_m2=np.tile(known if covariance else np.full((2, 2), np.nan), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(np.diag([0.16, 0.09]), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        label=label,
    )


# Due north, so that from west to east is from left to right.
NORTHWARD = line((0.0, -500.0), (0.0, 500.0))


def counted(*tracks: Track, over: Line = NORTHWARD, every_s: float = 900.0) -> CountReport:
    return count(tracks, lines={"gate": over}, settings=CountSettings(every_s))


def total(report: CountReport, direction: str, column: str = "count") -> float:
    return sum(float(r[column] or 0.0) for r in report.lines if r["direction"] == direction)


@pytest.mark.parametrize(
    ("corners", "direction", "bound"),
    [
        (((0.0, -500.0), (0.0, 500.0)), "left to right", "eastbound"),
        (((0.0, 500.0), (0.0, -500.0)), "right to left", "eastbound"),
    ],
)
def test_side_is_that_seen_along_the_line(
    corners: tuple[tuple[float, float], ...], direction: str, bound: str
) -> None:
    report = counted(straight((-200.0, 0.0), (4.0, 0.0)), over=line(*corners))
    (row,) = [row for row in report.lines if row["count"]]
    assert (row["direction"], row["bound"], row["class"]) == (direction, bound, "boat")
    assert row["expected"] == pytest.approx(1.0, abs=1e-6)
    assert row["sigma"] == pytest.approx(0.0, abs=1e-6)
    assert row["speed_mean_mps"] == pytest.approx(4.0)
    # Of the velocity's covariance only the part along the course, here east, is the speed's.
    assert row["speed_se_mps"] == pytest.approx(0.4)


@pytest.mark.parametrize("sigmas", [-1.5, -0.4, 0.0, 0.7, 2.0])
@pytest.mark.parametrize("sigma_east_m", [1.0, 5.0])
def test_a_track_that_ends_near_the_line_has_crossed_it_with_a_normal_probability(
    sigmas: float, sigma_east_m: float
) -> None:
    covariance = (sigma_east_m**2, 900.0)
    track = straight((-400.0 + sigmas * sigma_east_m, 0.0), (4.0, 0.0), covariance=covariance)
    report = counted(track)
    chance = norm.cdf(sigmas)
    assert total(report, "left to right", "expected") == pytest.approx(chance, abs=1e-5)
    assert total(report, "left to right", "sigma") == pytest.approx(
        np.sqrt(chance * (1.0 - chance)), abs=1e-5
    )
    if sigmas:
        assert total(report, "left to right") == (sigmas > 0.0)
    assert total(report, "right to left", "expected") == 0.0


def test_a_track_that_comes_near_and_turns_back_may_have_crossed_twice() -> None:
    there = straight((-402.0, 0.0), (4.0, 0.0))
    east = np.r_[there.east_m, there.east_m[-2::-1]]
    both = straight((-402.0, 0.0), (4.0, 0.0), 200.0)
    report = counted(replace(both, east_m=east))
    for direction in ("left to right", "right to left"):
        assert total(report, direction) == 0
        assert total(report, direction, "expected") == pytest.approx(norm.cdf(-1.0), abs=1e-5)


def test_past_the_end_of_a_line_nothing_is_crossed() -> None:
    for off_m, chance in ((-20.0, 1.0), (-2.0, norm.cdf(1.0)), (2.0, norm.cdf(-1.0)), (20.0, 0.0)):
        track = straight((-200.0, 500.0 + off_m), (4.0, 0.0))
        report = counted(track)
        assert total(report, "left to right", "expected") == pytest.approx(chance, abs=1e-4)
        spread = np.sqrt(chance * (1.0 - chance))
        assert total(report, "left to right", "sigma") == pytest.approx(spread, abs=1e-3)
        assert total(report, "left to right") == (off_m < 0.0)


def test_a_crossing_at_the_edge_of_two_intervals_is_half_in_each() -> None:
    report = counted(straight((-240.0, 0.0), (4.0, 0.0)), every_s=60.0)
    rows = [row for row in report.lines if row["direction"] == "left to right"]
    assert [row["begin_utc"] for row in rows] == ["2024-06-01T10:00:00Z", "2024-06-01T10:01:00Z"]
    for row in rows:
        assert row["expected"] == pytest.approx(0.5, abs=1e-4)
        assert row["sigma"] == pytest.approx(0.5, abs=1e-4)
    assert sum(int(row["count"] or 0) for row in rows) == 1


def test_variances_of_vessels_add_up_and_classes_are_apart() -> None:
    tracks = [straight((-400.0, 9.0 * i), (4.0, 0.0), number=i) for i in range(9)]
    report = counted(*tracks, straight((200.0, 0.0), (-4.0, 0.0), number=9, label=""))
    (boats,) = [
        row
        for row in report.lines
        if row["class"] == "boat" and row["direction"] == "left to right"
    ]
    assert boats["expected"] == pytest.approx(4.5, abs=1e-4)
    assert boats["sigma"] == pytest.approx(1.5, abs=1e-4)
    (other,) = [row for row in report.lines if row["class"] == "unlabelled" and row["count"]]
    assert other["direction"] == "right to left"


def test_the_mean_speed_of_several_is_surer_than_that_of_one() -> None:
    tracks = [straight((-200.0, 9.0 * i), (3.0 + i, 0.0), number=i) for i in range(3)]
    (row,) = [row for row in counted(*tracks).lines if row["count"]]
    assert row["speed_mean_mps"] == pytest.approx(4.0)
    assert row["speed_std_mps"] == pytest.approx(1.0)
    assert row["speed_se_mps"] == pytest.approx(0.4 / np.sqrt(3.0), abs=1e-6)


def test_a_track_without_a_covariance_counts_without_an_uncertainty() -> None:
    report = counted(straight((-200.5, 0.0), (4.0, 0.0), covariance=None))
    (row,) = [row for row in report.lines if row["count"]]
    assert row["count"] == 1
    assert row["expected"] == pytest.approx(1.0, abs=1e-6)
    assert row["sigma"] is None
    assert report.without_covariance == 1


def test_what_is_moored_crosses_nothing() -> None:
    track = straight((-1.0, 0.0), (0.02, 0.0), covariance=(0.01, 0.01))
    assert total(counted(track), "left to right") == 1
    moored = replace(track, moored=np.ones(len(track), dtype=bool))
    report = counted(moored)
    assert total(report, "left to right") == total(report, "left to right", "expected") == 0
    assert report.moored == 1


def test_jitter_on_a_line_is_no_crossing() -> None:
    track = straight((0.0, -100.0), (0.0, 2.0))
    jitter = 0.3 * np.sin(np.arange(len(track)))
    report = counted(replace(track, east_m=jitter))
    assert total(report, "left to right") == total(report, "right to left") == 0


@pytest.mark.parametrize("step_s", [0.5, 5.0, 45.0])
def test_a_bent_line_is_crossed_where_it_is(step_s: float) -> None:
    # A gate open to the south: who goes through it from west to east crosses both of its sides.
    gate = line((-50.0, 0.0), (-50.0, 100.0), (50.0, 100.0), (50.0, 0.0))
    through = straight((-150.0, 50.0), (2.0, 0.0), 180.0, step_s=step_s)
    above = straight((-150.0, 110.0), (2.0, 0.0), 180.0, step_s=step_s)
    below = straight((-150.0, -10.0), (2.0, 0.0), 180.0, step_s=step_s)
    report = counted(through, over=gate)
    assert total(report, "left to right") == total(report, "right to left") == 1
    for track in (above, below):
        report = counted(track, over=gate)
        assert total(report, "left to right") == total(report, "right to left") == 0


SQUARE = zone((0.0, -50.0), (100.0, -50.0), (100.0, 50.0), (0.0, 50.0))


@pytest.mark.parametrize("step_s", [1.0, 30.0])
def test_a_stay_lasts_as_long_as_the_way_through(step_s: float) -> None:
    track = straight((-100.0, 0.0), (2.5, 0.0), 150.0, step_s=step_s)
    report = count([track], zones={"basin": SQUARE}, settings=CountSettings(300.0))
    (row,) = report.zones
    assert (row["entries_count"], row["exits_count"], row["stays"]) == (1, 1, 1)
    assert row["entries_expected"] == pytest.approx(1.0, abs=1e-5)
    assert row["dwell_mean_s"] == pytest.approx(40.0, abs=0.01)
    # Each edge is crossed at a time of ±σ / v; quantiles lack a little of the tails.
    assert row["dwell_se_s"] == pytest.approx(np.sqrt(2.0) * 2.0 / 2.5, rel=0.02)
    # Over the 150 s that there are tracks of, not the 300 s of the interval.
    assert row["occupancy_mean"] == pytest.approx(40.0 / 150.0, rel=1e-3)
    assert row["occupancy_most"] == 1


def test_a_target_on_the_edge_of_a_zone_is_half_in_it() -> None:
    track = straight((0.0, -25.0), (0.0, 0.5))
    (row,) = count([track], zones={"basin": SQUARE}).zones
    assert row["occupancy_mean"] == pytest.approx(0.5, abs=1e-4)
    assert row["occupancy_sigma"] == pytest.approx(0.5, abs=1e-4)


def test_time_inside_is_the_integral_of_the_probability_between_far_points() -> None:
    # In one step from a standard deviation before the western edge to three behind it.
    track = straight((-2.0, 0.0), (0.08, 0.0), 100.0, step_s=100.0)
    (row,) = count([track], zones={"basin": SQUARE}).zones
    mean = quad(norm.cdf, -1.0, 3.0)[0] / 4.0
    assert row["occupancy_mean"] == pytest.approx(mean, abs=1e-4)


def test_most_targets_at_once_and_moored_ones_apart() -> None:
    tracks = [
        straight((-100.0, 10.0 * i), (2.5, 0.0), 150.0, start_s=begin, number=i, label=label)
        for i, (begin, label) in enumerate(((0.0, "a"), (30.0, "a"), (35.0, "b"), (75.0, "a")))
    ]
    moored = straight((50.0, 0.0), (0.0, 0.0), 225.0, number=9, label="a")
    moored = replace(moored, moored=np.ones(len(moored), dtype=bool))
    report = count([*tracks, moored], zones={"basin": SQUARE})
    rows = {row["class"]: row for row in report.zones}
    # Inside from 40 to 80, 70 to 110, 75 to 115 and 115 to 155 s.
    assert (rows["a"]["occupancy_most"], rows["b"]["occupancy_most"]) == (2, 1)
    assert rows["a"]["occupancy_most_of_all"] == rows["b"]["occupancy_most_of_all"] == 3
    assert rows["a"]["occupancy_moored"] == pytest.approx(1.0, abs=1e-6)
    assert rows["b"]["occupancy_moored"] == 0.0
    assert rows["a"]["entries_count"] == 3


def test_a_zone_without_covariances_is_counted_without_uncertainties() -> None:
    track = straight((-100.5, 0.0), (2.5, 0.0), 150.0, covariance=None)
    alone = straight((50.0, 0.0), (1.0, 0.0), 0.0, number=2, covariance=None)
    report = count([track, alone], zones={"basin": SQUARE}, settings=CountSettings(900.0, 500.0))
    (row,) = report.zones
    assert (row["entries_count"], row["stays"]) == (1, 1)
    assert row["dwell_mean_s"] == pytest.approx(40.0, abs=0.01)
    unknown = ("entries_sigma", "exits_sigma", "dwell_se_s", "occupancy_sigma")
    assert [row[name] for name in unknown] == [None] * 4
    (near,) = report.near_misses
    assert near["distance_m"] == pytest.approx(150.5, abs=1e-3)
    assert (near["distance_sigma_m"], near["probability"]) == (None, None)


def test_a_hole_is_no_part_of_a_zone() -> None:
    corners = [(-100.0, -100.0), (200.0, -100.0), (200.0, 100.0), (-100.0, 100.0)]
    hole = [(0.0, -50.0), (100.0, -50.0), (100.0, 50.0), (0.0, 50.0)]
    rings = []
    for ring in (corners, hole):
        latitude, longitude = PLANE.to_geographic(*np.array(ring).T)
        rings.append(np.column_stack([longitude, latitude]))
    ring_zone = Area((Polygon(tuple(rings)),))
    (row,) = count([straight((-150.0, 0.0), (4.0, 0.0))], zones={"ring": ring_zone}).zones
    assert (row["entries_count"], row["exits_count"]) == (2, 2)


def test_journeys_lead_from_the_first_line_to_the_last() -> None:
    lines = {name: line((x, -99.0), (x, 99.0)) for name, x in (("c", 90.0), ("a", 0), ("b", 50.0))}
    tracks = [straight((-100.0, 9.0 * i), (2.5, 0.0), number=i) for i in range(3)]
    tracks.append(straight((150.0, 50.0), (-2.5, 0.0), 50.0, number=4))
    report = count(tracks, lines=lines)
    (there, back) = report.journeys
    assert (there["origin"], there["destination"], there["count"]) == ("a", "c", 3)
    assert there["travel_mean_s"] == pytest.approx(36.0, abs=0.01)
    assert there["travel_se_s"] == pytest.approx(np.sqrt(2.0 / 3.0) * 2.0 / 2.5, rel=0.02)
    assert (back["origin"], back["destination"], back["count"]) == ("c", "b", 1)


def test_the_closest_point_of_approach_is_that_of_two_straight_ways() -> None:
    # At t they are (-150 + 3 t, 40) and (60, -100 + 2 t): 210 - 3 t and 2 t - 140 apart.
    first = straight((-150.0, 40.0), (3.0, 0.0), covariance=(4.0, 9.0), step_s=20.0)
    second = straight((60.0, -96.0), (0.0, 2.0), covariance=(1.0, 16.0), number=2, step_s=7.0)
    report = count([first, second], settings=CountSettings(closest_m=20.0))
    (row,) = report.near_misses
    # Apart (210 - 3 t, 2 t - 136): closest at t = (630 + 272) / 13.
    at = (3.0 * 210.0 + 2.0 * 136.0) / 13.0
    apart = np.array([210.0 - 3.0 * at, 2.0 * at - 136.0])
    distance = np.hypot(*apart)
    sigma = np.sqrt(apart @ np.diag([5.0, 25.0]) @ apart) / distance
    assert row["distance_m"] == pytest.approx(distance, abs=1e-3)
    assert row["distance_sigma_m"] == pytest.approx(sigma, abs=1e-3)
    assert row["probability"] == pytest.approx(norm.cdf((20.0 - distance) / sigma), abs=1e-4)
    assert row["time_utc"] == f"2024-06-01T10:01:{at - 60.0:06.3f}"[:-1] + f"{int(at * 1e3) % 10}Z"
    assert not count([first, second], settings=CountSettings(closest_m=1.0)).near_misses


def test_who_was_there_earlier_is_no_near_miss() -> None:
    first = straight((-100.0, 0.0), (2.0, 0.0))
    later = straight((-100.0, 0.0), (2.0, 0.0), start_s=200.0, number=2)
    assert not count([first, later], settings=CountSettings(closest_m=50.0)).near_misses


def test_two_moored_boats_side_by_side_miss_nothing() -> None:
    first, second = (straight((4.0 * i, 0.0), (0.0, 0.0), number=i) for i in range(2))
    still = np.ones(len(first), dtype=bool)
    settings = CountSettings(closest_m=50.0)
    assert len(count([first, second], settings=settings).near_misses) == 1
    first = replace(first, moored=still)
    assert len(count([first, second], settings=settings).near_misses) == 1
    assert not count([first, replace(second, moored=still)], settings=settings).near_misses


def test_too_many_intervals_are_refused() -> None:
    late = straight((0.0, 0.0), (1.0, 0.0), start_s=1e9, number=2)
    with pytest.raises(InputError, match="longer intervals"):
        counted(straight((0.0, 0.0), (1.0, 0.0)), late, every_s=1.0)
    with pytest.raises(InputError, match="nothing can be counted"):
        count([])
