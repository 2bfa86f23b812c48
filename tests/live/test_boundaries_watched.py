"""Lines and zones that are watched while targets move."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from sightline.area import Area, Line, Polygon
from sightline.geodesy import LocalPlane
from sightline.live.boundaries import BoundaryLimits, BoundaryWatch
from sightline.live.store import Store
from sightline.moment import Moment, State, TargetState

PLANE = LocalPlane(54.32, 10.14)
START_S = 1_717_236_000.0


def _corners(*places: tuple[float, float]) -> np.ndarray:
    east, north = np.array(places, dtype=float).T
    latitude, longitude = PLANE.to_geographic(east, north)
    return np.stack([longitude, latitude], axis=1)


# From south to north: east of it is its right side.
GATE = {"gate": Line(_corners((0.0, 0.0), (0.0, 100.0)))}
BASIN = {
    "basin": Area((Polygon((_corners((50.0, 0.0), (150.0, 0.0), (150.0, 100.0), (50.0, 100.0)),)),))
}


def _target(
    east: float, north: float, *, number: int = 1, sigma_m: float = 2.0, **more: object
) -> TargetState:
    latitude, longitude = PLANE.to_geographic(east, north)
    told: dict[str, object] = {
        "speed_mps": 4.0,
        "course_deg": 90.0,
        "state": "measured",
        "velocity_sigma_mps": 0.3,
    }
    return TargetState(
        id=number,
        latitude_deg=float(latitude),
        longitude_deg=float(longitude),
        covariance_m2=sigma_m**2 * np.eye(2),
        **{**told, **more},  # type: ignore[arg-type]
    )


def _seen(watch: BoundaryWatch, paths: list[list[TargetState]], every_s: float = 1.0) -> Moment:
    alerts: list = []
    moment = None
    for k, targets in enumerate(paths):
        moment = watch.update(Moment(START_S + every_s * k, "sender", "quay", tuple(targets)))
        alerts += moment.alerts
    assert moment is not None
    return Moment(
        moment.time_utc_s, "sender", "quay", moment.targets, None, None, None, moment.boundaries,
        tuple(alerts),
    )  # fmt: skip


def test_a_boat_crosses_the_line_and_stays_in_the_zone() -> None:
    watch = BoundaryWatch(
        PLANE, lines=GATE, zones=BASIN, limits=BoundaryLimits(speed_mps=3.0, dwell_s=20.0)
    )
    # At 4 m/s to the east, from 100 m before the line to 100 m beyond the zone.
    path = [[_target(-100.0 + 4.0 * k, 50.0, name="ANNA", mmsi=211000001)] for k in range(88)]
    seen = _seen(watch, path)
    told = [(one.kind, one.boundary, one.direction) for one in seen.alerts]
    assert told == [
        ("cross", "gate", "left to right"),
        ("enter", "basin", None),
        ("speed", "basin", None),
        ("dwell", "basin", None),
        ("leave", "basin", None),
    ]
    times = {one.kind: one.time_utc_s - START_S for one in seen.alerts}
    # It is there when its place is, however long that takes to be known.
    assert times["cross"] == pytest.approx(25.0, abs=0.01)
    assert times["enter"] == pytest.approx(37.5, abs=0.01)
    assert times["leave"] == pytest.approx(62.5, abs=0.01)
    assert times["dwell"] == pytest.approx(57.5, abs=1.1)
    assert {one.name for one in seen.alerts} == {"ANNA"}
    assert seen.boundaries is not None
    gate, basin = seen.boundaries
    assert (gate.left_to_right, gate.right_to_left) == (1, 0)
    assert (basin.entries, basin.exits, basin.inside) == (1, 1, 0)
    assert basin.mean_dwell_s == pytest.approx(25.0, abs=0.01)
    message = json.loads(seen.text)
    assert message["boundaries"][0] == {
        "name": "gate",
        "kind": "line",
        "left_to_right": 1,
        "right_to_left": 0,
    }
    assert message["alerts"][0]["kind"] == "cross"


def test_one_that_goes_back_and_one_beyond_the_end_of_the_line() -> None:
    watch = BoundaryWatch(PLANE, lines=GATE)
    back = [*range(-30, 31, 3), *range(30, -31, -3)]
    paths = [[_target(x, 50.0), _target(x, 130.0, number=2)] for x in map(float, back)]
    seen = _seen(watch, paths)
    assert [one.direction for one in seen.alerts] == ["left to right", "right to left"]
    assert {one.target_id for one in seen.alerts} == {1}


@pytest.mark.parametrize("state", ["moored", "measured"])
def test_noise_at_the_border_is_no_traffic(state: State) -> None:
    rng = np.random.default_rng(3)
    watch = BoundaryWatch(PLANE, lines=GATE, zones=BASIN)
    # Its place wanders by half of what it is not sure of, as that of a filter does.
    paths = [
        [
            _target(2.0 + float(rng.standard_normal()), 50.0, sigma_m=4.0, state=state),
            _target(50.0 + float(rng.standard_normal()), 50.0, number=2, sigma_m=4.0, state=state),
        ]
        for _ in range(400)
    ]
    assert len(_seen(watch, paths).alerts) <= (0 if state == "moored" else 1)


def test_what_lies_still_crosses_nothing_however_its_place_is_corrected() -> None:
    for state, count in (("moored", 0), ("measured", 2)):
        watch = BoundaryWatch(PLANE, lines=GATE, zones=BASIN)
        places = [-20.0] * 5 + [100.0] * 5
        paths = [[_target(x, 50.0, state=state)] for x in places]
        assert len(_seen(watch, paths).alerts) == count


def test_what_appears_inside_has_not_entered_and_what_vanishes_has_not_left() -> None:
    watch = BoundaryWatch(PLANE, zones=BASIN)
    paths = [[_target(100.0, 50.0)] for _ in range(30)]
    seen = _seen(watch, paths)
    assert seen.boundaries is not None
    (basin,) = seen.boundaries
    assert (basin.inside, basin.entries, basin.longest_dwell_s) == (1, 0, 29.0)
    moment = watch.update(Moment(START_S + 35.0, "sender", "quay", ()))
    assert moment.boundaries is not None
    (basin,) = moment.boundaries
    assert (basin.inside, basin.longest_dwell_s, basin.mean_dwell_s) == (0, None, None)
    # It comes back, and has been there all the time.
    moment = watch.update(Moment(START_S + 40.0, "sender", "quay", (_target(100.0, 50.0),)))
    assert moment.boundaries is not None
    (basin,) = moment.boundaries
    assert (basin.inside, basin.longest_dwell_s) == (1, 40.0)
    moment = watch.update(Moment(START_S + 120.0, "sender", "quay", ()))
    assert moment.alerts == ()
    assert moment.boundaries is not None
    (basin,) = moment.boundaries
    assert (basin.inside, basin.exits, basin.mean_dwell_s) == (0, 0, 40.0)


def test_a_speed_that_is_not_sure_is_not_told() -> None:
    watch = BoundaryWatch(PLANE, zones=BASIN, limits=BoundaryLimits(speed_mps=3.0))
    unsure = _target(100.0, 50.0, velocity_sigma_mps=1.0)
    assert _seen(watch, [[unsure]] * 3).alerts == ()
    assert [one.kind for one in _seen(watch, [[_target(100.0, 50.0)]] * 3).alerts] == ["speed"]


def test_counts_go_on_where_a_boundary_stays_as_it_is() -> None:
    first = BoundaryWatch(PLANE, lines=GATE, zones=BASIN)
    _seen(first, [[_target(float(x), 50.0)] for x in range(-20, 21, 4)])
    elsewhere = {"gate": Line(_corners((5.0, 0.0), (5.0, 100.0)))}
    for lines, count in ((GATE, 1), (elsewhere, 0)):
        second = BoundaryWatch(PLANE, lines=lines)
        second.carry_on(first)
        (gate,) = second.states()
        assert gate.left_to_right == count


def test_the_map_is_given_what_the_files_say() -> None:
    drawn = BoundaryWatch(PLANE, lines=GATE, zones=BASIN).geojson()
    line, zone = drawn["features"]  # type: ignore[misc]
    assert line["properties"] == {"name": "gate", "kind": "line"}
    np.testing.assert_allclose(line["geometry"]["coordinates"], GATE["gate"].corners, atol=1e-7)
    ring = zone["geometry"]["coordinates"][0][0]
    assert ring[0] == ring[-1]


def test_alerts_are_kept(tmp_path: Path) -> None:
    watch = BoundaryWatch(PLANE, lines=GATE)
    seen = _seen(watch, [[_target(float(x), 50.0)] for x in range(-20, 21, 4)])
    store = Store(tmp_path / "quay.db", camera="quay", plane=PLANE)
    store.keep([], rows=seen.alerts)
    rows = store._file.execute("SELECT target_id, kind, boundary, direction FROM event").fetchall()
    assert rows == [(1, "cross", "gate", "left to right")]
    store.close()
