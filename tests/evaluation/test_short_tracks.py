"""Tracks of two or three points beside the one that is scored."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.evaluation.report import evaluate_tracks
from sightline.geodesy import LocalPlane
from sightline.types import Fixes, Track

PLANE = LocalPlane(32.70297, -117.234631)
START = 1_601_494_584.0


def track(track_id: int, times: np.ndarray, north_m: float) -> Track:
    n = len(times)
    return Track(
        track_id=track_id,
        time_utc_s=times,
        east_m=2.0 * (times - START),
        north_m=np.full(n, north_m),
        velocity_east_mps=np.full(n, 2.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(np.diag([9.0, 9.0]), (n, 1, 1)),
        velocity_covariance_m2ps2=np.full((n, 2, 2), np.nan),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
    )


@pytest.mark.parametrize(
    "short",
    [
        np.array([START + 2.0, START + 3.0, START + 3.5]),
        np.array([START + 2.0]),
        np.array([START - 500.0, START - 499.0]),
        np.array([START - 500.0, START + 2.0]),
        np.array([START + 500.0]),
    ],
    ids=["three", "one", "before", "one before", "after"],
)
def test_a_short_track_beside_the_target_changes_nothing(short: np.ndarray) -> None:
    seconds = np.arange(60.0)
    log = Fixes(START + seconds, *PLANE.to_geographic(2.0 * seconds, np.full(len(seconds), 100.0)))
    target = track(1, START + np.arange(0.25, 59.0, 0.5), 120.0)
    report = evaluate_tracks([target, track(2, short, 700.0)], log)
    assert report.tracks is not None
    assert report.tracks.used == (1,)
    assert report.ape.rmse == pytest.approx(20.0, abs=0.01)
    assert report.ape.median == pytest.approx(20.0, abs=0.01)
