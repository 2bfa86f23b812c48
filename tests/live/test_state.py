from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest

from sightline.camera.state import CameraHistory
from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.filter import TargetFilter
from sightline.live.state import LiveState, SmoothedPart, StateSettings
from sightline.moment import Moment
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera
from sightline.types import Boxes

LASTING = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="first")


class Run:
    """A state that is given the boxes of a harbour, moment by moment."""

    def __init__(self, state: LiveState) -> None:
        self.state = state
        self.moments: list[Moment] = []
        self.parts: list[SmoothedPart] = []

    def see(self, boxes: Boxes, times: np.ndarray) -> None:
        history = CameraHistory()
        for time in times.tolist():
            here = boxes[boxes.time_utc_s == time]
            self.moments.append(self.state.update(history.observed(here), time))
            self.parts += self.state.smooth_next(time)

    def ids(self) -> set[int]:
        return {target.id for moment in self.moments for target in moment.targets}


def _harbour(camera: SimulatedCamera, model: Georeferencer, seed: int = 5) -> Harbour:
    settings = HarbourSettings(duration_s=90.0, camera=camera, plane=model.plane, gulls=0)
    return Harbour.random(seed, settings)


@pytest.fixture(scope="module")
def model(fitted: Callable[[str], Georeferencer]) -> Georeferencer:
    return fitted("camera")


@pytest.fixture(scope="module")
def harbour(small_camera: SimulatedCamera, model: Georeferencer) -> Harbour:
    return _harbour(small_camera, model)


@pytest.fixture(scope="module")
def watched(harbour: Harbour, model: Georeferencer) -> Run:
    """All boats of the harbour, ten times a second."""
    times = harbour.times(10.0)
    run = Run(LiveState(model, "quay", first_id=41))
    run.see(harbour.boxes(times, noise=LASTING, of="all"), times)
    run.parts += run.state.finish()
    return run


@pytest.mark.slow
def test_positions_are_those_of_the_boats_and_ellipses_hold_them(
    watched: Run, harbour: Harbour, model: Georeferencer
) -> None:
    everywhere = harbour.truth(harbour.times(10.0), harbour.boats)
    held, relative = [], []
    for moment in watched.moments[50:]:
        now = np.abs(everywhere.time_utc_s - moment.time_utc_s) < 1e-6
        true = np.stack([everywhere.east_m[now], everywhere.north_m[now]], axis=1)
        for target in moment.targets:
            if target.state == "predicted":
                continue
            east, north = model.plane.to_plane(target.latitude_deg, target.longitude_deg)
            off = true - [float(east), float(north)]
            nearest = int(np.argmin(np.hypot(*off.T)))
            d2 = off[nearest] @ np.linalg.solve(target.covariance_m2, off[nearest])
            held.append(d2 < 5.991)
            relative.append(np.hypot(*off[nearest]) / np.hypot(*true[nearest]))
    assert len(held) > 3000
    # An error of a pixel at these ranges is some percent of them.
    assert np.median(relative) < 0.06
    assert np.mean(held) > 0.9


def test_no_number_is_used_twice_and_they_go_on_from_before(watched: Run, harbour: Harbour) -> None:
    ids = watched.ids()
    assert min(ids) == 41
    # Boats pass behind one another, and each is one target for the most part.
    assert len(harbour.boats) <= len(ids) <= 2 * len(harbour.boats)
    for moment in watched.moments:
        numbers = [target.id for target in moment.targets]
        assert numbers == sorted(set(numbers))


@pytest.mark.slow
def test_the_smoothed_track_is_a_few_seconds_behind_and_then_final(watched: Run) -> None:
    early = [part for part in watched.parts if not part.final]
    final = [part for part in watched.parts if part.final]
    assert len(early) > 20
    assert final
    for number in {part.track.track_id for part in early}:
        times = np.concatenate([p.track.time_utc_s for p in early if p.track.track_id == number])
        assert (np.diff(times) > 0.0).all()
    assert {part.track.track_id for part in early} <= {part.track.track_id for part in final}


def _passing(model: Georeferencer, times: np.ndarray, *, still: bool = False) -> Boxes:
    """A boat that crosses the picture at 100 px in ten seconds, or lies at its place."""
    x = 500.0 + (0.0 if still else 10.0) * (times - times[0])
    rng = np.random.default_rng(3)
    jitter = 0.3 * rng.standard_normal(times.size)
    y = np.full(times.size, 420.0) + jitter
    return Boxes.of(
        np.stack([x, y - 20.0, x + 60.0, y], axis=1),
        time_utc_s=times,
        confidence=np.full(times.size, 0.9),
        source="first",
    )


def test_a_target_that_lies_still_is_moored(model: Georeferencer) -> None:
    times = 1.7e9 + np.arange(0.0, 60.0, 0.2)
    for still in (True, False):
        run = Run(LiveState(model, "quay"))
        run.see(_passing(model, times, still=still), times)
        (target,) = run.moments[-1].targets
        assert (target.state == "moored") is still
        if still:
            assert target.speed_mps == 0.0
            assert target.course_deg is None
        else:
            assert target.speed_mps is not None
            assert target.speed_mps > 0.5
            assert target.course_deg is not None


def test_what_is_hidden_is_predicted_with_growing_doubt_and_then_gone(
    model: Georeferencer,
) -> None:
    times = 1.7e9 + np.arange(0.0, 45.0, 0.1)
    boxes = _passing(model, times)
    seen = boxes.time_utc_s < times[0] + 15.0
    run = Run(LiveState(model, "quay"))
    run.see(boxes[seen], times)
    states = [[(t.state, float(np.trace(t.covariance_m2))) for t in m.targets] for m in run.moments]
    assert states[140][0][0] == "measured"
    hidden = [states[i][0] for i in range(152, 245)]
    assert {state for state, _ in hidden} == {"predicted"}
    assert (np.diff([doubt for _, doubt in hidden]) > 0.0).all()
    assert states[-1] == []
    assert len(run.state) == 0
    assert [part.final for part in run.parts][-1]


def test_an_identity_outlives_a_pause_a_restart_and_a_clock_that_is_set(
    model: Georeferencer,
) -> None:
    times = 1.7e9 + np.arange(0.0, 30.0, 0.1)
    boxes = _passing(model, times)
    before = Run(LiveState(model, "quay", first_id=7))
    before.see(boxes, times[:100])
    kept = json.loads(json.dumps(before.state.to_json()))
    after = Run(LiveState(model, "quay", first_id=12))
    assert after.state.carry_on(kept, float(times[130]))
    # Three seconds later, under a clock that was set back by an hour.
    after.see(boxes, times[130:160])
    after.state.shift(-3600.0)
    later = boxes.with_columns(time_utc_s=boxes.time_utc_s - 3600.0)
    after.see(later, later.time_utc_s[160:])
    assert before.ids() == {7}
    assert after.ids() == {7}
    new = Run(LiveState(model, "quay", first_id=12))
    assert not new.state.carry_on(kept, float(times[0]) + 600.0)
    assert not new.state.carry_on({"tracker": {"version": 1}, "time_utc_s": 1.7e9}, 1.7e9)
    new.see(boxes, times[:30])
    assert new.ids() == {12}


def test_what_leaves_the_picture_is_not_predicted_for_long(model: Georeferencer) -> None:
    times = 1.7e9 + np.arange(0.0, 20.0, 0.1)
    x = 1120.0 + 20.0 * (times - times[0])
    boxes = _passing(model, times)[x < 1270.0]
    xyxy = boxes.xyxy_px.copy()
    xyxy[:, 0], xyxy[:, 2] = x[x < 1270.0], np.minimum(x[x < 1270.0] + 60.0, 1280.0)
    run = Run(LiveState(model, "quay"))
    run.see(boxes.with_columns(xyxy_px=xyxy), times)
    last_seen_s = times[x < 1270.0][-1]
    shown = [m.time_utc_s for m in run.moments if m.targets]
    assert last_seen_s < shown[-1] < last_seen_s + 3.0


def test_frames_that_go_back_in_time_are_refused(model: Georeferencer) -> None:
    state = LiveState(model, "quay")
    nothing = CameraHistory().observed(Boxes.of([]))
    state.update(nothing, 10.0)
    with pytest.raises(InputError, match="before the one seen last"):
        state.update(nothing, 9.0)


def test_settings_are_checked() -> None:
    with pytest.raises(InputError, match="lag_s is -1"):
        StateSettings(lag_s=-1.0)


def test_errors_that_last_are_not_averaged_away() -> None:
    """Of a target that stands still: the doubt is that of as many boxes as there are errors."""
    rng = np.random.default_rng(0)
    rate, tau, sigma = 25.0, 0.8, 2.0
    kept = np.exp(-1.0 / rate / tau)
    squared = []
    for _ in range(60):
        found, error = TargetFilter(), rng.standard_normal(2)
        for k in range(250):
            error = kept * error + np.sqrt(1.0 - kept**2) * rng.standard_normal(2)
            found.predict(k / rate)
            place = np.array([[30.0, 100.0]]) + sigma * error
            found.update([1], place, sigma**2 * np.eye(2)[None], np.zeros((1, 2, 2)))
        mean, covariance = found.moments()
        off = mean[0, :2] - [30.0, 100.0]
        squared.append(off @ np.linalg.solve(covariance[0, :2, :2], off))
    assert np.mean(np.array(squared) < 5.991) > 0.85
    assert np.mean(squared) == pytest.approx(2.0, rel=0.5)
