from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.evaluation.metrics import ScoredPairs, absolute_error, pair_positions
from sightline.evaluation.report import (
    evaluate_positions,
    evaluate_tracks,
    summarise,
    without_nan,
    write_json,
)
from sightline.geodesy import LocalPlane
from sightline.types import Fixes, FloatArray, Positions, Track

PLANE = LocalPlane(32.70297, -117.234631)
START = 1_601_494_584.0
TIMES = START + np.arange(0.0, 60.0, 0.5)


def log_between(start_s: float, stop_s: float) -> Fixes:
    """A boat that goes east at 2 m/s, 100 m north of the camera, from where it was at START."""
    times = START + np.arange(start_s, stop_s + 0.5, 1.0)
    east = 2.0 * (times - START)
    return Fixes(times, *PLANE.to_geographic(east, np.full(times.size, 100.0)))


def positions_off(error_m: float | FloatArray, times=TIMES) -> Positions:
    n = len(times)
    return Positions(
        east_m=2.0 * (np.asarray(times) - START),
        north_m=np.full(n, 100.0 + error_m),
        covariance_m2=np.tile(4.0 * np.eye(2), (n, 1, 1)),
        extrapolated=np.zeros(n, bool),
        plane=PLANE,
    )


def track_off(track_id: int, error_m: float | FloatArray, times=TIMES) -> Track:
    positions, n = positions_off(error_m, times), len(times)
    return Track(
        track_id=track_id,
        time_utc_s=times,
        east_m=positions.east_m,
        north_m=positions.north_m,
        velocity_east_mps=np.full(n, 2.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=positions.covariance_m2,
        velocity_covariance_m2ps2=np.tile(np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, np.int8),
        plane=PLANE,
    )


APE_KEYS = {"n", "rmse", "mse", "mean", "median", "p90", "max", "per_range"}


def test_the_json_has_the_keys_that_are_promised(tmp_path) -> None:
    recording = np.where(TIMES < START + 30.0, "07", "12")
    report = evaluate_positions(TIMES, positions_off(3.0), log_between(0, 60), recording=recording)
    report.write(tmp_path / "out" / "report.json")
    written = json.loads((tmp_path / "out" / "report.json").read_text())
    assert written == report.to_dict()
    assert set(written["recordings"]) == {"07", "12"}
    for part in (written, *written["recordings"].values()):
        assert set(part["ape"]) == APE_KEYS
        assert {"delta_s", "rmse", "mse"} <= set(part["rpe"])
        assert {"p50", "p95"} <= set(part["coverage"])
        assert part["ape"]["rmse"] == pytest.approx(3.0, abs=1e-3)
        assert part["rpe"]["rmse"] == pytest.approx(0.0, abs=1e-3)
        assert part["coverage"] == {
            "p50": 0.0,
            "p95": 1.0,
            "n": part["ape"]["n"],
            "log_sigma_m": 0.0,
            "p50_with_log": 0.0,
            "p95_with_log": 1.0,
        }
        assert part["matched"]["share"] == 1.0
        bias = part["bias"]
        assert np.hypot(bias["rmse_along"], bias["rmse_across"]) == pytest.approx(3.0, abs=1e-3)
    assert written["ape"]["n"] == sum(part["ape"]["n"] for part in written["recordings"].values())
    assert "recordings" not in written["recordings"]["07"]


def test_what_is_not_known_is_null(tmp_path) -> None:
    known = pair_positions(TIMES, positions_off(3.0), log_between(0, 60))
    report = summarise({"12": known, "13": ScoredPairs.concatenate([])})
    path = tmp_path / "report.json"
    report.write(path)
    text = path.read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    empty = json.loads(text)["recordings"]["13"]
    assert empty["ape"] == {key: 0 if key == "n" else None for key in APE_KEYS}
    assert empty["rpe"]["rmse"] is None
    assert {empty["coverage"][name] for name in ("p50", "p95", "p50_with_log")} == {None}
    assert empty["coverage"]["n"] == 0
    assert empty["matched"] == {"asked": 0, "matched": 0, "share": None, "without_position": 0}
    assert empty["by_range"] == []


def test_infinite_edges_of_ranges_are_null() -> None:
    far = ScoredPairs(
        *([START], [20_000.0], [0.0], np.full((1, 2, 2), np.nan), [20_001.0], [0.0], [0]), asked=1
    )
    assert summarise(far).to_dict()["by_range"] == [
        {"from_m": 10_000.0, "to_m": None, "n": 1, "rmse": 1.0, "median": 1.0}
    ]


def test_pooled_numbers_are_those_of_all_pairs_together() -> None:
    parts = {
        "a": pair_positions(TIMES, positions_off(1.0), log_between(0, 60)),
        "b": pair_positions(TIMES[:10], positions_off(7.0, TIMES[:10]), log_between(0, 60)),
    }
    report = summarise(parts)
    assert report.ape == absolute_error(ScoredPairs.concatenate(parts.values()))
    assert report.ape.mse == pytest.approx((120 * 1.0 + 10 * 49.0) / 130, rel=1e-4)
    assert report.matched.asked == 130


def test_a_file_is_not_touched_when_its_content_cannot_be_written(tmp_path) -> None:
    path = tmp_path / "report.json"
    path.write_text("before")
    with pytest.raises(TypeError):
        write_json(path, {"a": object()})
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_nan_is_found_however_deep_it_lies() -> None:
    assert without_nan({"a": [1.0, float("nan"), {"b": (float("inf"), 2)}], "c": "x"}) == {
        "a": [1.0, None, {"b": [None, 2]}],
        "c": "x",
    }


def test_the_track_that_follows_the_log_is_taken_for_the_target() -> None:
    tracks = [track_off(1, 40.0), track_off(2, 3.0), track_off(3, 15.0)]
    report = evaluate_tracks(tracks, log_between(0, 60))
    assert report.ape.rmse == pytest.approx(3.0, abs=1e-3)
    assert report.tracks is not None
    assert report.tracks.used == (2,)
    assert report.tracks.overlapping == 3
    assert report.to_dict()["tracks"] == {
        "used": [2],
        "overlapping": 3,
        "chosen_by": "smallest median error",
    }


def test_a_scrap_of_a_track_near_the_target_is_not_taken_for_it() -> None:
    scrap = track_off(9, 0.5, TIMES[40:44])
    report = evaluate_tracks([track_off(1, 4.0), scrap], log_between(0, 60))
    assert report.tracks is not None
    assert report.tracks.used == (1,)
    # Nor where its ellipses hold the log and those of the long track do not.
    far = evaluate_tracks([track_off(1, 30.0), scrap], log_between(0, 60))
    assert far.tracks is not None
    assert far.tracks.used == (1,)
    alone = evaluate_tracks([scrap], log_between(0, 60))
    assert alone.tracks is not None
    assert alone.tracks.used == (9,)
    assert alone.ape.n == 4


@pytest.mark.parametrize(("half", "used"), [(51, 2), (50, 1)])
def test_a_nearer_track_is_the_target_where_it_is_half_as_long(half: int, used: int) -> None:
    """Both hold the log in their ellipses, of 2 m; the first is 50 s long, the other 25 or 24.5."""
    tracks = [track_off(1, 3.0, TIMES[:101]), track_off(2, 0.5, TIMES[:half])]
    report = evaluate_tracks(tracks, log_between(0, 60))
    assert report.tracks is not None
    assert report.tracks.used == (used,)


@pytest.mark.parametrize(("stop", "used"), [(51, 2), (50, 1)])
def test_a_nearer_track_is_the_target_where_it_meets_the_log_for_long_enough(
    stop: int, used: int
) -> None:
    """None holds the log in its ellipses; the second meets it for 5 s, or for 4.5 s."""
    tracks = [track_off(1, 30.0), track_off(2, 20.0, TIMES[40:stop])]
    report = evaluate_tracks(tracks, log_between(0, 60), least_overlap_s=5.0)
    assert report.tracks is not None
    assert report.tracks.used == (used,)


@pytest.mark.parametrize(("right", "used"), [(50, 1), (51, 2)])
def test_a_track_whose_ellipses_hold_the_log_for_most_of_its_time_is_the_target(
    right: int, used: int
) -> None:
    """It is the farther one, and right in half of its times, or in one more; the other never."""
    off = np.full(100, 30.0)
    off[:right] = 4.0
    tracks = [track_off(2, off, TIMES[:100]), track_off(1, 3.0, TIMES[:100])]
    tracks[1] = replace(tracks[1], covariance_m2=0.01 * tracks[1].covariance_m2)
    report = evaluate_tracks(tracks, log_between(0, 60))
    assert report.tracks is not None
    assert report.tracks.used == (used,)


@pytest.mark.parametrize(
    ("others", "used"),
    [
        # As near, and of another time: before or after.
        ([track_off(2, 2.1, TIMES[80:])], (1, 2)),
        ([track_off(2, 2.1, TIMES[:20])], (1, 2)),
        ([track_off(2, 2.1, TIMES[:20]), track_off(3, 2.1, TIMES[70:])], (1, 3, 2)),
        # At most twice as far.
        ([track_off(2, 3.9, TIMES[80:])], (1, 2)),
        ([track_off(2, 4.1, TIMES[80:])], (1,)),
        # Seen beside the target, if only for a moment.
        ([track_off(2, 2.1, TIMES[69:])], (1,)),
        ([track_off(2, 2.1, TIMES[:31])], (1,)),
        # Seen beside one that continues it.
        ([track_off(2, 2.1, TIMES[80:]), track_off(3, 2.1, TIMES[75:90])], (1, 2)),
    ],
)
def test_tracks_of_other_times_that_are_as_near_continue_the_target(
    others: list[Track], used: tuple[int, ...]
) -> None:
    tracks = [*others, track_off(1, 2.0, TIMES[30:70])]
    report = evaluate_tracks(tracks, log_between(0, 60))
    assert report.tracks is not None
    assert report.tracks.used == used


def test_what_its_own_ellipses_deny_does_not_continue_the_target() -> None:
    precise = track_off(2, 2.1, TIMES[80:])
    precise = replace(precise, covariance_m2=0.01 * precise.covariance_m2)
    report = evaluate_tracks([track_off(1, 2.0, TIMES[:70]), precise], log_between(0, 60))
    assert report.tracks is not None
    assert report.tracks.used == (1,)


def test_a_named_track_is_scored_however_far_it_is() -> None:
    tracks = [track_off(1, 40.0), track_off(2, 3.0)]
    report = evaluate_tracks(tracks, log_between(0, 60), track_id=1)
    assert report.ape.rmse == pytest.approx(40.0, abs=1e-2)
    assert report.tracks is not None
    assert report.tracks.chosen_by == "track_id"
    both = evaluate_tracks(tracks, log_between(0, 60), track_id=[1, 2])
    assert both.ape.n == 2 * report.ape.n
    assert both.ape.mse == pytest.approx((1600.0 + 9.0) / 2, rel=1e-3)
    # Each keeps to itself in the relative error: neither moves against the log.
    assert both.rpe.rmse == pytest.approx(0.0, abs=1e-3)


def test_tracks_of_several_recordings_are_chosen_in_each() -> None:
    late = TIMES + 100.0
    report = evaluate_tracks(
        {"07": [track_off(1, 2.0), track_off(2, 9.0)], "08": [track_off(1, 5.0, late)]},
        {"07": log_between(0, 60), "08": log_between(100, 160)},
    )
    assert report.recordings["07"].ape.median == pytest.approx(2.0, abs=1e-3)
    assert report.recordings["08"].ape.median == pytest.approx(5.0, abs=1e-3)
    assert report.recordings["07"].tracks.used == (1,)
    assert report.tracks.used == (1, 1)
    assert report.tracks.overlapping == 3


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: evaluate_tracks([], log_between(0, 60)), "there is no track"),
        (
            lambda: evaluate_tracks([track_off(4, 1.0)], log_between(0, 60), track_id=5),
            "no track 5; known are 4",
        ),
        (
            lambda: evaluate_tracks([track_off(4, 1.0), track_off(4, 2.0)], log_between(0, 60)),
            "two tracks have the id 4; give each one of its own",
        ),
        (
            lambda: evaluate_tracks([track_off(4, 1.0)], log_between(500, 600)),
            "to 2020-09-30T19:37:23Z, the log from 2020-09-30T19:44:44Z to 2020-09-30T19:46:24Z",
        ),
        (
            # The logs of several recordings are told as one, from the first fix to the last.
            lambda: evaluate_tracks(
                {"a": [track_off(4, 1.0)], "b": [track_off(4, 1.0)], "c": [track_off(4, 1.0)]},
                {"a": log_between(700, 760), "b": log_between(500, 900), "c": Fixes([], [], [])},
            ),
            (
                "from 2020-09-30T19:36:24Z to 2020-09-30T19:37:23Z, "
                "the log from 2020-09-30T19:44:44Z to 2020-09-30T19:51:24Z"
            ),
        ),
        (
            lambda: evaluate_tracks({"07": [track_off(4, 1.0)]}, {"08": log_between(0, 60)}),
            "recording 07: there is no log; logs are known for 08",
        ),
        (
            lambda: evaluate_positions(TIMES, positions_off(1.0), Fixes([], [], [])),
            "the log has no fixes",
        ),
        (
            lambda: evaluate_positions(
                np.full(TIMES.size, np.nan), positions_off(1.0), log_between(0, 60)
            ),
            "no position has a time",
        ),
        (
            lambda: evaluate_positions(
                TIMES,
                replace(
                    positions_off(1.0),
                    east_m=np.full(TIMES.size, np.nan),
                    north_m=np.full(TIMES.size, np.nan),
                ),
                log_between(0, 60),
            ),
            "none of the 120 boxes has a position",
        ),
        (
            lambda: evaluate_positions(TIMES, positions_off(1.0), {"07": log_between(0, 60)}),
            "needs the recording of each position",
        ),
        (
            lambda: evaluate_positions(
                TIMES, positions_off(1.0), log_between(0, 60), recording=["07"]
            ),
            "120 positions need as many recordings",
        ),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(call, message: str) -> None:
    with pytest.raises(InputError) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_json_shows_what_has_no_width(tmp_path: Path) -> None:
    name = "b\u202eta\u200bo\x9b\U000e0041\ud800 Möwe"
    write_json(tmp_path / "a.json", {name: name})
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert text.isprintable() or text.replace("\n", "").isprintable()
    assert "Möwe" in text
    read = name.replace("\ud800", "\ufffd")
    assert json.loads(text) == {read: read}
