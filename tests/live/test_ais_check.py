"""AIS says where vessels are, and so whether the model of the camera still holds."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.camera.state import CameraHistory
from sightline.formats import AisReport
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.live.ais import AisMatcher
from sightline.live.ais_check import AisCheck, ModelCheck
from sightline.live.state import LiveState
from sightline.live.store import Store
from sightline.live.view import View
from sightline.moment import Moment
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, SimulatedCamera
from sightline.video.mask import Mask

LASTING = BoxNoise(std_px=1.5, correlation_time_s=0.8, miss_probability=0.05, source="first")


@pytest.fixture(scope="module")
def model(fitted: Callable[[str], Georeferencer]) -> Georeferencer:
    return fitted("camera")


def watched(
    model: Georeferencer, camera: SimulatedCamera, matcher: AisMatcher, *, silent: int = 0
) -> tuple[Harbour, list[Moment]]:
    """A minute and a half before a camera, where all boats but the first ``silent`` have AIS."""
    settings = HarbourSettings(duration_s=90.0, camera=camera, plane=model.plane, gulls=0)
    harbour = Harbour.random(5, settings)
    times = harbour.times(5.0)
    boxes = harbour.boxes(times, noise=LASTING, of="all")
    reports = []
    for boat in harbour.boats[silent:]:
        fixes = harbour.fixes(boat=boat)
        truth = harbour.truth(fixes.time_utc_s, [boat])
        velocity = np.gradient(np.stack([truth.east_m, truth.north_m]), fixes.time_utc_s, axis=1)
        reports += [
            AisReport(
                mmsi=211000000 + boat.identity,
                time_utc_s=float(fixes.time_utc_s[k]),
                latitude_deg=float(fixes.latitude_deg[k]),
                longitude_deg=float(fixes.longitude_deg[k]),
                velocity_mps=(float(velocity[0, k]), float(velocity[1, k])),
            )
            for k in range(boat.identity % 5, len(fixes), 5)
        ]
    reports.sort(key=lambda one: one.time_utc_s)
    state, history, moments = LiveState(model, "quay"), CameraHistory(), []
    for time in times.tolist():
        while reports and reports[0].time_utc_s <= time:
            matcher.take(reports.pop(0))
        here = boxes[boxes.time_utc_s == time]
        moments.append(matcher.identify(state.update(history.observed(here), time), "first"))
    return harbour, moments


@pytest.mark.slow
@pytest.mark.parametrize("turned_deg", [0.0, 1.0])
def test_a_camera_that_was_turned_is_told_and_one_that_was_not_is_not(
    turned_deg: float, model: Georeferencer, small_camera: SimulatedCamera
) -> None:
    told: list[tuple[str, str]] = []
    check = ModelCheck(model, told=lambda kind, text: told.append((kind, text)))
    matcher = AisMatcher(model.plane, check=check)
    camera = replace(small_camera, heading_deg=small_camera.heading_deg + turned_deg)
    watched(model, camera, matcher)
    figures = check.figures()
    day = figures["day"]
    assert isinstance(day, dict)
    assert day["passages"] >= 3
    if not turned_deg:
        assert told == []
        assert figures["doubt"] is None
        assert day["inside_ellipse_share"] > 0.8
        return
    assert [kind for kind, _ in told] == ["camera-moved"]
    assert "degrees in heading" in told[0][1]
    # It was told once, as soon as three passages said so, and is known better by now.
    doubt = str(figures["doubt"])
    heading_deg = float(doubt.split("by ")[1].split(" ")[0])
    assert heading_deg == pytest.approx(turned_deg, abs=0.15)


def test_identities_are_told_and_vessels_that_nobody_sees(
    model: Georeferencer, small_camera: SimulatedCamera
) -> None:
    told: list[tuple[str, str]] = []
    matcher = AisMatcher(
        model.plane, view=View(model), told=lambda kind, text: told.append((kind, text))
    )
    place = np.array(model.plane.to_geographic(*_ahead(small_camera, 150.0, 10.0)), dtype=float)
    # It says that it lies before the camera, where there is water.
    ghost = AisReport(211999999, 0.0, float(place[0]), float(place[1]), (0.0, 0.0), "GHOST")
    aft = np.array(model.plane.to_geographic(*_ahead(small_camera, -150.0, 0.0)), dtype=float)
    behind = AisReport(211999998, 0.0, float(aft[0]), float(aft[1]), (0.0, 0.0), "BEHIND")
    far = np.array(model.plane.to_geographic(*_ahead(small_camera, 3000.0, 0.0)), dtype=float)
    distant = AisReport(211999997, 0.0, float(far[0]), float(far[1]), (0.0, 0.0), "FAR")

    settings = HarbourSettings(duration_s=1.0, camera=small_camera, plane=model.plane)
    start_s = Harbour.random(5, settings).start_utc_s
    for report in (ghost, behind, distant):
        matcher.take(replace(report, time_utc_s=start_s))
    _, moments = watched(model, small_camera, matcher, silent=1)
    last = moments[-1]
    identities = {one.identity for moment in moments[100:] for one in moment.targets}
    assert {"identified", "unidentified"} <= identities
    for one in last.targets:
        assert (one.identity == "identified") is (one.mmsi is not None)
    assert last.unseen is not None
    ghosts = [one.name for one in last.unseen]
    assert "GHOST" in ghosts
    assert not {"BEHIND", "FAR"} & set(ghosts)
    assert [text for kind, text in told if "GHOST" in text]
    assert len([text for kind, text in told if "GHOST" in text]) == 1
    message = json.loads(last.text)
    assert "GHOST" in [one["name"] for one in message["vessels_without_target"]]
    figures = matcher.figures()
    assert figures["without_target"] == len(last.unseen)
    # Where nothing is looked for, nobody is missed.
    matcher.change(View(model, mask=Mask(np.ones((720, 1280), dtype=bool))))
    later = matcher.identify(replace(last, time_utc_s=last.time_utc_s + 3.0, unseen=None))
    assert later.unseen == ()
    assert figures["in_view"] >= 1  # type: ignore[operator]


def _ahead(camera: SimulatedCamera, ahead_m: float, right_m: float) -> tuple[float, float]:
    heading = np.radians(camera.heading_deg)
    east = ahead_m * np.sin(heading) + right_m * np.cos(heading)
    north = ahead_m * np.cos(heading) - right_m * np.sin(heading)
    return float(east), float(north)


def _check(number: int, passage: int, off_m: float) -> AisCheck:
    return AisCheck(
        time_utc_s=1.7e9 + 600.0 * passage + 10.0 * number,
        target_id=passage,
        mmsi=211000000 + passage % 3,
        place_m=(50.0, 100.0),
        velocity_mps=(0.0, 2.0),
        off_m=(off_m, 0.0),
        covariance_m2=(4.0, 0.0, 9.0),
        box_xyxy_px=(600.0, 400.0, 640.0, 420.0),
        source="first",
    )


class _NoCamera:
    calibrated = None


def _judged(offs_m: list[float]) -> list[str]:
    told: list[str] = []
    checks = [_check(k, passage, off) for passage, off in enumerate(offs_m) for k in range(5)]
    check = ModelCheck(
        _NoCamera(),  # type: ignore[arg-type]
        before=checks,
        told=lambda kind, text: told.append(f"{kind}: {text}"),
    )
    check.judge()
    check.judge()
    return told


def test_errors_that_grow_are_told_once_and_those_that_do_not_are_not() -> None:
    # By the ellipse and the hull: sqrt(4 + 25) m, so that 5.4 m is one standard deviation.
    for seed in range(10):
        usual = (5.4 * np.random.default_rng(seed).standard_normal(40)).tolist()
        assert _judged(usual) == []
    assert _judged([*usual[:30], 20.0, *usual[30:39]]) == []
    (said,) = _judged(usual[:20] + [20.0] * 10)
    assert said.startswith("errors-grown: of the last 10 passages with AIS 10 lie outside")
    # Inside of their ellipses, but not as they were.
    (said,) = _judged([1.0 + 0.1 * k for k in range(20)] + [9.0] * 10)
    assert "times what they were in the 20 passages before" in said


def test_comparisons_are_kept_for_their_model_alone(tmp_path: Path, model: Georeferencer) -> None:
    path = tmp_path / "quay.db"
    checks = [_check(k, 3, 2.0) for k in range(4)]
    store = Store(path, camera="quay", plane=model.plane, model="first")
    store.keep([], rows=checks)
    assert store.checks() == checks
    # They outlive the retention of tracks by a month.
    store.forget(1.7e9 + 20 * 86_400.0)
    assert len(store.checks()) == 4
    store.forget(1.7e9 + 40 * 86_400.0)
    assert store.checks() == []
    store.keep([], rows=checks)
    store.close()
    other = Store(path, camera="quay", plane=model.plane, model="second")
    assert other.checks() == []
    other.close()


def test_a_store_of_version_1_is_carried_on(tmp_path: Path, model: Georeferencer) -> None:
    path = tmp_path / "quay.db"
    Store(path, camera="quay", plane=model.plane).close()
    with sqlite3.connect(path) as file:
        file.executescript("DROP TABLE event; DROP TABLE passage; PRAGMA user_version = 1;")
    file.close()
    store = Store(path, camera="quay", plane=model.plane, model="first")
    store.keep([], rows=[_check(1, 1, 1.0)])
    assert len(store.checks()) == 1
    store.close()
