"""A shore that distracts: what never moves gives no track that moves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sightline
from sightline import Scene, Tracks
from sightline.errors import InputError
from sightline.evaluation.report import pair_target
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.track import TrackSettings, track
from sightline.simulation import BoxNoise, Harbour
from sightline.simulation.paths import cast_off
from sightline.simulation.simulate import DETECTOR, Simulation, SimulationSettings, simulate
from sightline.types import NO_TRACK, Boxes, FloatArray, Track

_DETECTOR: BoxNoise = replace(DETECTOR, least_px=6.0)


def _shore(folder: Path, seed: int, duration_s: float = 240.0) -> Simulation:
    return simulate(
        folder,
        SimulationSettings(
            seed=seed, recordings=1, duration_s=duration_s, rate_hz=6.0, video=False, shore=True
        ),
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Simulation:
    return _shore(tmp_path_factory.mktemp("shore"), 1)


@pytest.fixture(scope="module")
def model(made: Simulation) -> Georeferencer:
    return sightline.fit(Scene.load(made.scene), model="camera")


def _found(harbour: Harbour, times: FloatArray, *, seed: int = 0) -> Boxes:
    """Boxes of all boats, and of what a detector takes for boats on the shore; without ids."""
    boats = harbour.boxes(times, noise=_DETECTOR, of="all", seed=seed)
    confidence = np.random.default_rng(seed).beta(8.0, 2.0, len(boats))
    boats = boats.with_columns(
        confidence=confidence, track_id=np.full(len(boats), NO_TRACK, dtype=np.int64)
    )
    boxes = Boxes.concatenate([boats, harbour.false_boxes(times, noise=_DETECTOR, seed=seed)])
    return boxes[np.argsort(boxes.time_utc_s, kind="stable")]


def _near_one_that_moves(harbour: Harbour, one: Track, rows: np.ndarray) -> float:
    """Share of points of a track beside a boat that is under way, as far as ranges tell."""
    times = one.time_utc_s[rows]
    bearing = np.arctan2(one.east_m[rows], one.north_m[rows])
    near = np.zeros(times.size, dtype=bool)
    for boat in harbour.boats:
        since = times - harbour.start_utc_s
        place, speed = boat.path.at(since), np.hypot(*boat.path.velocity(since).T)
        off = np.arctan2(place[:, 0], place[:, 1]) - bearing
        off = np.abs((off + np.pi) % (2.0 * np.pi) - np.pi)
        across_m = off * np.hypot(*place.T)
        near |= (across_m < boat.shape.length_m) & (speed > 0.05)
    return float(near.mean())


def _moving(tracks: Tracks) -> list[Track]:
    return [one for one in tracks if not (one.never_moves or one.untold)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_at_most_one_false_track_in_minutes_before_a_town(seed: int, tmp_path: Path) -> None:
    simulation = _shore(tmp_path, seed)
    fitted = sightline.fit(Scene.load(simulation.scene), model="camera")
    harbour = simulation.harbour
    boxes = _found(harbour, simulation.recordings[0].time_utc_s, seed=seed)
    tracks = track(boxes, fitted)
    false = [
        one
        for one in _moving(tracks)
        if _near_one_that_moves(harbour, one, ~np.asarray(one.moored)) < 0.5
    ]
    assert len(false) <= 1
    # Without the map there are dozens.
    before = track(boxes, fitted, settings=TrackSettings(tell_moored=False))
    assert all(not one.never_moves for one in before)
    assert sum(_near_one_that_moves(harbour, o, np.ones(len(o), bool)) < 0.5 for o in before) > 12


@pytest.mark.slow
def test_moored_boats_are_told_as_moored_and_others_are_not(
    made: Simulation, model: Georeferencer
) -> None:
    harbour, times = made.harbour, made.recordings[0].time_utc_s
    # With the true ids: what the tracker confuses is not the question here.
    boxes = harbour.boxes(times, noise=_DETECTOR, of="all")
    tracks = {one.track_id: one for one in track(boxes, model)}
    told = []
    for boat in harbour.boats:
        # Of who is hidden behind others most of the time nobody can tell.
        if (boxes.track_id == boat.identity).sum() < 0.3 * times.size:
            continue
        share = float(np.mean(tracks[boat.identity].moored))
        if boat.path.moves:
            assert share == 0.0, boat.name
        else:
            told.append(share)
    assert len(told) > 12
    assert np.mean(np.array(told) == 1.0) > 0.95


@pytest.mark.slow
def test_a_boat_that_casts_off_keeps_its_id_and_is_under_way(
    made: Simulation, model: Georeferencer
) -> None:
    harbour, times = made.harbour, made.recordings[0].time_utc_s
    leaves_s = 120.0
    still = [b for b in harbour.boats if not b.path.moves and b.shape.kind == "motorboat"]
    camera = np.radians(harbour.camera.heading_deg)
    boat = min(still, key=lambda b: abs(np.arctan2(*b.path.at([0.0])[0]) - camera))
    # Across the picture, in front of the others.
    bearing = float(np.degrees(np.arctan2(*boat.path.at([0.0])[0])))
    place = 0.5 * boat.path.at([0.0])[0]
    path = cast_off(place, bearing + 90.0, leaves_s, harbour.duration_s)
    changed = tuple(replace(b, path=path) if b is boat else b for b in harbour.boats)
    moved = replace(harbour, boats=changed)
    boxes = moved.boxes(times, noise=_DETECTOR, of="all")
    (own,) = [one for one in track(boxes, model) if one.track_id == boat.identity]
    since = own.time_utc_s - harbour.start_utc_s
    moored = np.asarray(own.moored)
    assert not own.never_moves
    assert moored[since < leaves_s].mean() > 0.99
    # From when it has moved by half its length.
    half_s = np.sqrt(boat.shape.length_m / 0.3)
    assert not moored[since > leaves_s + half_s + 2.0].any()


@pytest.mark.slow
def test_the_model_knows_the_place_from_the_first_frame(
    made: Simulation, model: Georeferencer, tmp_path: Path
) -> None:
    from sightline.camera.state import CameraHistory
    from sightline.pipeline.moored import learn_places

    harbour, times = made.harbour, made.recordings[0].time_utc_s
    boxes = harbour.boxes(times, noise=_DETECTOR, of="all")
    places = learn_places([[CameraHistory().observed(boxes)]], model)
    assert places is not None
    path = replace(model, static_places=places).save(tmp_path / "with.safetensors")
    again = sightline.load(path)
    assert again.static_places is not None
    assert np.array_equal(again.static_places.to_array(), places.to_array())
    assert sightline.load(model.save(tmp_path / "old.safetensors")).static_places is None
    short = boxes[boxes.time_utc_s < times[0] + 8.0]
    short = short.with_columns(time_utc_s=short.time_utc_s + 86400.0)
    still = {boat.identity for boat in harbour.boats if not boat.path.moves}
    alone = [one for one in track(short, model) if one.never_moves]
    known = {one.track_id for one in track(short, again) if one.never_moves}
    assert not alone
    assert known <= still
    seen, count = np.unique(short.track_id, return_counts=True)
    lasting = still & set(seen[count > 30].tolist())
    assert len(lasting) > 5
    assert len(known & lasting) >= 0.8 * len(lasting)


def test_a_log_under_way_is_of_nothing_that_never_moves() -> None:
    harbour = Harbour.random(0)
    fixes = harbour.fixes()
    truth = harbour.truth(fixes.time_utc_s[20:120])
    n = len(truth)
    moves = Track(
        1,
        truth.time_utc_s,
        truth.east_m + 30.0,
        truth.north_m,
        truth.velocity_east_mps,
        truth.velocity_north_mps,
        np.tile(100.0 * np.eye(2), (n, 1, 1)),
        np.tile(np.eye(2), (n, 1, 1)),
        np.zeros(n, dtype=np.int8),
        harbour.plane,
    )
    middle = np.median(np.stack([truth.east_m, truth.north_m]), axis=1)
    rests = replace(
        moves,
        track_id=2,
        east_m=np.full(n, middle[0]),
        north_m=np.full(n, middle[1]),
        covariance_m2=np.tile(1e6 * np.eye(2), (n, 1, 1)),
        moored=np.ones(n, dtype=bool),
    )
    assert pair_target([moves, rests], fixes)[1].used == (1,)
    assert pair_target([rests], fixes)[1].used == ()
    with pytest.raises(InputError, match="stays in its place"):
        sightline.evaluate(Tracks((rests,)), fixes=fixes)
    still = replace(fixes, latitude_deg=fixes.latitude_deg * 0 + fixes.latitude_deg[0])
    still = replace(still, longitude_deg=fixes.longitude_deg * 0 + fixes.longitude_deg[0])
    assert pair_target([rests], still)[1].used == (2,)
