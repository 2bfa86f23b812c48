from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.evaluation.forecast import forecast_errors, pair_forecasts
from sightline.evaluation.metrics import ScoredPairs
from sightline.evaluation.report import Report, summarise
from sightline.geodesy import LocalPlane
from sightline.trajectory.forecast import MotionModel, MotionState
from sightline.types import Fixes, FloatArray

PLANE = LocalPlane(54.0, 10.0)
STILL = MotionModel(straight_share=1.0, straight_s=1e9, straight_m2ps3=1e-9)


def states(times: FloatArray, place: FloatArray, velocity: FloatArray) -> MotionState:
    n = times.size
    mean = np.concatenate([place, np.broadcast_to(velocity, (n, 2))], axis=1)
    return MotionState.of_moments(times, mean, np.tile(np.eye(4), (n, 1, 1)), PLANE, STILL)


def log_of(times: FloatArray, place: FloatArray) -> Fixes:
    return Fixes(times, *PLANE.to_geographic(place[:, 0], place[:, 1]))


def straight(times: FloatArray) -> FloatArray:
    return np.stack([3.0 * times, np.full(times.size, 80.0)], axis=1)


def test_errors_are_those_of_straight_lines() -> None:
    fix_s = np.arange(0.0, 101.0, 2.0)
    seen_s = np.arange(1.0, 40.0, 4.0)
    # 0.5 m/s too fast, and 2 m too far north.
    known = states(seen_s, straight(seen_s) + np.array([0.0, 2.0]), np.array([3.5, 0.0]))
    got = forecast_errors([(known, log_of(fix_s, straight(fix_s)))], (0.5, 10.0, 60.0))
    assert list(got) == ["0.5", "10", "60"]
    for key, ahead in (("0.5", 0.5), ("10", 10.0), ("60", 60.0)):
        error = np.hypot(0.5 * ahead, 2.0)
        one = got[key]
        # The first state knows no velocity, so it is not asked.
        assert one.n == seen_s.size - 1
        assert (one.rmse, one.mean, one.median, one.p90) == pytest.approx((error,) * 4, rel=1e-4)
        assert one.beside_log.n == one.n
        assert one.beside_log.rmse == pytest.approx(error, rel=1e-4)
        assert one.beside_log.log_rmse == pytest.approx(0.0, abs=1e-4)
        assert one.coverage_p95 == 1.0


def test_the_log_foretells_by_its_last_two_fixes_alone() -> None:
    fix_s = np.array([0.0, 2.0, 4.0, 11.0, 12.0, 14.0, 20.0, 22.0])
    place = np.stack([fix_s**2, np.full(fix_s.size, 50.0)], axis=1)
    seen_s = np.array([0.5, 5.0, 10.5, 13.0])
    known = states(seen_s, np.stack([seen_s**2, np.full(4, 50.0)], axis=1), np.array([0.0, 0.0]))
    got = pair_forecasts(known, log_of(fix_s, place), 8.0, largest_gap_s=6.0)
    np.testing.assert_allclose(got.pairs.time_utc_s, [13.0, 18.5, 21.0])
    # At 5 s: fixes at 2 and 4 s, 6 m/s; the truth at 13 s lies between those of 12 and 14 s.
    truth = 0.5 * (144.0 + 196.0)
    assert got.log_error_m[0] == pytest.approx(truth - (16.0 + 6.0 * 9.0), rel=1e-6)
    # At 10.5 s the last fix is 6.5 s old; at 13 s there are fixes at 11 and 12 s.
    assert np.isnan(got.log_error_m[1])
    assert got.log_error_m[2] == pytest.approx(0.5 * (400.0 + 484.0) - (144.0 + 23.0 * 9.0))


def test_fixes_that_are_old_or_far_apart_foretell_nothing() -> None:
    fix_s = np.array([0.0, 1.0, 30.0, 31.0, 45.0, 46.0])
    known = states(np.array([0.5, 25.0, 30.5]), straight(np.array([0.5, 25.0, 30.5])), np.zeros(2))
    got = pair_forecasts(known, log_of(fix_s, straight(fix_s)), 5.5)
    assert np.isnan(got.log_error_m).all()
    assert got.pairs.asked == 2
    assert (
        forecast_errors([(known, log_of(fix_s, straight(fix_s)))], [5.5])["5.5"].beside_log.n == 0
    )


def test_the_log_foretells_from_its_second_fix_on_up_to_the_longest_gap() -> None:
    """Fixes 4 s apart, and one 5 s after: what is as old, or as far apart, as the gap counts."""
    fix_s = np.array([0.0, 4.0, 8.0, 13.0, 17.0])
    place = np.stack([fix_s**2, np.full(fix_s.size, 50.0)], axis=1)
    seen_s = np.array([0.0, 2.0, 4.0, 6.0, 12.0, 12.5, 14.0])
    known = states(seen_s, np.stack([seen_s, np.full(7, 50.0)], axis=1), np.array([0.0, 0.0]))
    got = pair_forecasts(known, log_of(fix_s, place), 1.5, largest_gap_s=4.0)
    np.testing.assert_allclose(got.pairs.time_utc_s, [3.5, 5.5, 7.5, 13.5, 14.0, 15.5])

    def truth(time_s: float) -> float:
        return float(np.interp(time_s, fix_s, place[:, 0]))

    expected = [
        # One fix alone.
        np.nan,
        # 16 m at 4 m/s, at the fix and 2 s after it.
        abs(16.0 + 4.0 * 1.5 - truth(5.5)),
        abs(16.0 + 4.0 * 3.5 - truth(7.5)),
        # 64 m at 12 m/s, 4 s old.
        abs(64.0 + 12.0 * 5.5 - truth(13.5)),
        # It is older, then the last two lie further apart.
        np.nan,
        np.nan,
    ]
    np.testing.assert_allclose(got.log_error_m, expected, rtol=1e-5)


def test_nothing_to_compare_is_no_number() -> None:
    one = forecast_errors([], (5.0,))["5"]
    assert one.n == one.beside_log.n == 0
    assert np.isnan([one.rmse, one.median, one.coverage_p95, one.beside_log.log_rmse]).all()


def test_a_report_tells_forecasts_where_there_are_any(tmp_path: Path) -> None:
    plain = summarise(ScoredPairs.concatenate([]))
    assert "forecast" not in plain.to_dict()
    report = Report(**{**vars(plain), "forecast": forecast_errors([], (5.0, 10.0))})
    report.write(tmp_path / "report.json")
    written = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert list(written["forecast"]) == ["5", "10"]
    assert {"n", "rmse", "mean", "median", "p90", "coverage_p95"} <= set(written["forecast"]["5"])


def test_a_forecast_over_no_time_is_refused() -> None:
    known = states(np.zeros(1), np.ones((1, 2)), np.zeros(2))
    for horizon_s in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="cannot be scored"):
            pair_forecasts(known, log_of(np.zeros(1), np.ones((1, 2))), horizon_s)
