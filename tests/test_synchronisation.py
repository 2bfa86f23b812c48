from __future__ import annotations

import numpy as np
import pytest

from sightline.geodesy import LocalPlane
from sightline.synchronisation import distinct, log_summary, spread_times, synchronise
from sightline.types import Fixes

START_S = 1_717_236_000.0


def log(time_s: list[float], latitude_deg: list[float], longitude_deg: list[float]) -> Fixes:
    return Fixes(START_S + np.array(time_s), latitude_deg, longitude_deg, name="Anna")


def line(n: int) -> tuple[list[float], list[float], list[float]]:
    """A fix a second, a hundred-thousandth of a degree further north each."""
    return [float(i) for i in range(n)], [54.0 + 1e-5 * i for i in range(n)], [10.0] * n


@pytest.mark.parametrize("again", [[7], [0, 7, 39], list(range(40))])
def test_a_fix_that_stands_twice_says_nothing_new(again: list[int]) -> None:
    columns = line(40)
    rows = sorted([*range(40), *again])
    twice = log(*([column[row] for row in rows] for column in columns))
    plain = distinct(log(*columns))
    read = distinct(twice)
    assert read.name == "Anna"
    for name in ("time_utc_s", "latitude_deg", "longitude_deg"):
        np.testing.assert_array_equal(getattr(read, name), getattr(plain, name))


def test_one_time_that_repeats_moves_no_other_fix() -> None:
    times, north, east = line(40)
    times[8] = times[7]
    read = distinct(log(times, north, east))
    np.testing.assert_array_equal(read.time_utc_s - START_S, [*range(8), *range(9, 40)])
    assert read.latitude_deg[7] == pytest.approx((north[7] + north[8]) / 2.0, abs=1e-12)
    np.testing.assert_array_equal(read.latitude_deg[8:], north[9:])


def test_fractions_that_were_cut_off_are_given_back() -> None:
    # Five fixes a second, of which only whole seconds were written.
    truth = np.arange(0.1, 20.0, 0.2)
    cut = START_S + np.floor(truth)
    np.testing.assert_allclose(spread_times(cut) - START_S, truth, rtol=0, atol=3e-7)


def test_a_receiver_that_wanders_about_a_second_has_cut_off_its_fractions() -> None:
    truth = np.cumsum(np.random.default_rng(0).uniform(0.75, 1.25, 300))
    given_back = spread_times(START_S + np.floor(truth)) - START_S
    # Half a second of each is unknown; on the whole it is not late.
    assert abs(np.mean(given_back - truth)) < 0.05
    assert np.abs(given_back - truth).max() <= 0.75


def test_times_with_fractions_stay() -> None:
    times = START_S + np.array([0.0, 0.5, 0.5, 1.0])
    np.testing.assert_array_equal(spread_times(times), times)


def test_fixes_of_one_time_across_the_date_line_lie_between_them() -> None:
    read = distinct(log([0.0, 0.25, 0.25, 1.0], [0.0] * 4, [179.98, 179.99, -179.97, -179.9]))
    assert read.longitude_deg[1] == pytest.approx(-179.99, abs=1e-9)
    # And what is between two fixes on either side is near neither zero nor Greenwich.
    fixes = log([0.0, 1.0], [0.0, 0.0], [179.9999, -179.9999])
    plane = LocalPlane(0.0, 180.0)
    place = synchronise(fixes, [START_S + 0.25], plane)
    # A quarter of the way: 0.0001° west of the line is 11.13 m, half of that is left.
    assert place.east_m[0] == pytest.approx(-5.566, abs=0.01)


def test_the_summary_of_a_log() -> None:
    times, north, east = line(40)
    times[20:] = [time + 30.0 for time in times[20:]]
    summary = log_summary(log(times, north, east))
    assert summary.n == 40
    assert summary.first_utc_s == START_S
    assert summary.last_utc_s == START_S + 69.0
    assert summary.interval_s == 1.0
    assert (summary.gaps, summary.longest_gap_s) == (1, 31.0)
    alone = log_summary(log([0.0], [1.0], [2.0]))
    assert (alone.n, alone.gaps) == (1, 0)
    assert np.isnan(alone.interval_s)
    assert np.isnan(log_summary(log([], [], [])).first_utc_s)
