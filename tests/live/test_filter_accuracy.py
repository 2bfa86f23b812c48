"""How much is lost by not waiting: what is published at once beside what is smoothed later.

Of a target whose velocity is a random walk and whose place is measured with white noise, the
variance of the place is four times as large at once (Kalman and Bucy) as it is when all that
follows is known: the stationary solutions are sqrt(2) q^(1/4) r^(3/4) and a quarter of that. So its
error is twice as large, whatever the noise. Errors that both have in common bring them closer.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from sightline.camera.state import CameraHistory
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.state import LiveState, SmoothedPart
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera

LASTING = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="first")
NEAR_M = 250.0


def test_nobody_does_better_at_once_than_twice_the_error() -> None:
    q, r = 0.3, 4.0
    # The stationary covariance of the filter, and of the smoother from both directions.
    drift = np.array([[0.0, 1.0], [0.0, 0.0]])
    measured = np.array([[1.0, 0.0]])
    ahead = solve_continuous_are(drift.T, measured.T, np.diag([0.0, q]), np.array([[r]]))
    back = ahead * np.array([[1.0, -1.0], [-1.0, 1.0]])
    both = np.linalg.inv(np.linalg.inv(ahead) + np.linalg.inv(back))
    assert ahead[0, 0] == pytest.approx(np.sqrt(2.0) * q**0.25 * r**0.75)
    assert np.sqrt(ahead[0, 0] / both[0, 0]) == pytest.approx(2.0)


@pytest.mark.slow
def test_published_places_are_as_good_as_they_say_and_as_can_be(
    fitted: Callable[[str], Georeferencer], small_camera: SimulatedCamera
) -> None:
    model = fitted("camera")
    at_once, later, squared = [], [], []
    for seed in (5, 9):
        settings = HarbourSettings(duration_s=70.0, camera=small_camera, plane=model.plane, gulls=0)
        harbour = Harbour.random(seed, settings)
        times = harbour.times(5.0)
        boxes = harbour.boxes(times, noise=LASTING, of="all", seed=seed)
        state, history = LiveState(model, "quay"), CameraHistory()
        published: dict[int, list[tuple[float, float, float, np.ndarray]]] = {}
        parts: list[SmoothedPart] = []
        for time in times.tolist():
            seen = state.update(history.observed(boxes[boxes.time_utc_s == time]), time)
            for one in seen.targets:
                if one.state == "measured":
                    east, north = model.plane.to_plane(one.latitude_deg, one.longitude_deg)
                    row = (time, float(east), float(north), np.asarray(one.covariance_m2))
                    published.setdefault(one.id, []).append(row)
            parts += state.smooth_next(time)
        parts += state.finish()
        paths = [harbour.truth(times, [boat]) for boat in harbour.boats]
        for part in parts:
            track = part.track
            if not part.final or len(track) < 50:
                continue
            # Whose it is: the boat that was nearest for most of the time.
            off = [
                np.median(
                    np.hypot(
                        track.east_m - np.interp(track.time_utc_s, times, path.east_m),
                        track.north_m - np.interp(track.time_utc_s, times, path.north_m),
                    )
                )
                for path in paths
            ]
            boat = paths[int(np.argmin(off))]
            for time, east, north, covariance in published[track.track_id]:
                early = time < track.time_utc_s[0] + 5.0
                true = np.array([np.interp(time, times, c) for c in (boat.east_m, boat.north_m)])
                if early or time > track.time_utc_s[-1] or np.hypot(*true) > NEAR_M:
                    continue
                error = np.array([east, north]) - true
                columns = (track.east_m, track.north_m)
                smooth = np.array([np.interp(time, track.time_utc_s, c) for c in columns]) - true
                at_once.append(error @ error)
                later.append(smooth @ smooth)
                squared.append(error @ np.linalg.solve(covariance, error))
    assert len(at_once) > 1000
    assert np.sqrt(np.mean(at_once) / np.mean(later)) < 2.0
    assert 0.9 < np.mean(np.array(squared) < 5.991) < 0.98
