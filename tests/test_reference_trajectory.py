"""Where a logged vessel was between its reports."""

import numpy as np
import pytest

from sightline.geodesy import LocalPlane
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.types import Fixes

PLANE = LocalPlane(54.0, 10.0)


def circle(times):
    """A vessel on a circle of 200 m at 5 m/s: place and velocity in closed form."""
    turn = 5.0 / 200.0 * np.asarray(times, dtype=float)
    place = 200.0 * np.stack([np.sin(turn), np.cos(turn)], axis=1)
    return place, 5.0 * np.stack([np.cos(turn), -np.sin(turn)], axis=1)


def log_of(times):
    place, velocity = circle(times)
    latitude, longitude = PLANE.to_geographic(place[:, 0], place[:, 1])
    return Fixes(times, latitude, longitude, name="211000001"), velocity


def test_reports_with_course_and_speed_bridge_long_gaps_along_the_curve():
    fixes, velocity = log_of(np.arange(0.0, 301.0, 30.0))
    path = ReferenceTrajectory.of(fixes, PLANE, velocity)
    asked = np.arange(0.0, 300.0, 1.7)
    truth, moving = circle(asked)
    at = path.at(asked)
    # A cubic over an arc of 0.75 radians is off by at most h⁴/384 of the fourth derivative.
    bound = 30.0**4 / 384.0 * 200.0 * (5.0 / 200.0) ** 4
    assert np.hypot(*(at.east_north_m - truth).T).max() < 1.5 * bound
    assert np.hypot(*(at.velocity_mps - moving).T).max() < 0.1


def test_without_course_and_speed_lines_are_straight_in_short_gaps():
    fixes, _ = log_of(np.array([0.0, 4.0, 40.0, 44.0]))
    at = ReferenceTrajectory.of(fixes, PLANE).at([2.0, 42.0])
    for found, ends in zip(at.east_north_m, ([0.0, 4.0], [40.0, 44.0]), strict=True):
        np.testing.assert_allclose(found, circle(ends)[0].mean(axis=0), atol=1e-6)


def test_without_course_and_speed_a_motion_model_bridges_long_gaps():
    times = np.arange(0.0, 301.0, 20.0)
    fixes, _ = log_of(times)
    asked = np.arange(60.5, 240.0, 1.7)
    truth, moving = circle(asked)
    at = ReferenceTrajectory.of(fixes, PLANE).at(asked)
    off = np.hypot(*(at.east_north_m - truth).T)
    # A straight line is off by the sagitta of the arc, up to 6 m.
    assert off.max() < 1.0
    assert (off < 3.0 * at.sigma_m).all()
    assert np.hypot(*(at.velocity_mps - moving).T).max() < 0.5
    assert (at.fix_time_utc_s[:, 0] == 20.0 * (asked // 20.0)).all()
    # The middle of a gap is less certain than its ends.
    middle = np.abs(asked % 20.0 - 10.0)
    assert at.sigma_m[middle < 1.0].min() > 2.0 * at.sigma_m[middle > 9.0].max()


def test_beyond_the_longest_gap_a_log_without_course_tells_nothing():
    fixes, _ = log_of(np.array([0.0, 10.0, 20.0, 150.0, 160.0]))
    at = ReferenceTrajectory.of(fixes, PLANE).at([15.0, 80.0, 155.0])
    assert np.isfinite(at.east_north_m[:, 0]).tolist() == [True, False, True]


@pytest.mark.parametrize("count", [0, 1])
def test_a_log_of_less_than_two_fixes_tells_nothing(count):
    times = np.arange(float(count))
    fixes, velocity = log_of(times)
    at = ReferenceTrajectory.of(fixes, PLANE, velocity).at([0.0, 1.0])
    assert np.isnan(at.east_north_m).all()


def test_outside_the_log_and_beyond_the_longest_gap_nothing_is_known():
    fixes, velocity = log_of(np.array([0.0, 10.0, 400.0]))
    at = ReferenceTrajectory.of(fixes, PLANE, velocity).at([-1.0, 5.0, 200.0, 401.0])
    assert np.isfinite(at.east_north_m[:, 0]).tolist() == [False, True, False, False]
