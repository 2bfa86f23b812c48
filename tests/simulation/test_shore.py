"""A shore that distracts is behind the water, and what is on it is where its boxes say."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, Renderer
from sightline.simulation.paths import cast_off
from sightline.simulation.simulate import SimulationSettings, simulate
from sightline.types import NO_TRACK

_EXACT = BoxNoise(std_px=0.0, source="simulated", least_px=6.0)


@pytest.fixture(scope="module")
def harbour() -> Harbour:
    return Harbour.random(1, HarbourSettings(duration_s=60.0, shore=True))


def test_all_boats_lie_and_go_before_the_quay(harbour: Harbour) -> None:
    assert harbour.shore is not None
    times = np.arange(0.0, 60.0, 0.5)
    for boat in harbour.boats:
        assert np.hypot(*boat.path.at(times).T).max() < harbour.shore.range_m
    moored = [boat for boat in harbour.boats if not boat.path.moves]
    # Two lie at anchor as in every harbour.
    assert len(moored) == 30 + 2
    for feature in harbour.shore.features:
        assert feature.range_m >= harbour.shore.range_m
        assert feature.ground_m >= harbour.shore.quay_m


def test_without_a_shore_the_harbour_is_as_ever(harbour: Harbour) -> None:
    plain = Harbour.random(1, HarbourSettings(duration_s=60.0))
    assert plain.shore is None
    assert len(plain.false_boxes(plain.times(1.0), noise=_EXACT)) == 0
    assert plain.camera == harbour.camera


def test_a_false_box_stays_where_its_thing_stands(harbour: Harbour) -> None:
    assert harbour.shore is not None
    times = harbour.times(5.0)
    boxes = harbour.false_boxes(times, noise=_EXACT, count=12)
    places, counts = np.unique(boxes.xyxy_px.round(6), axis=0, return_counts=True)
    assert len(places) == 12
    parts = []
    for feature in harbour.shore.features:
        pixels = harbour.camera.project(feature.part_enu_m())
        parts.append(np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]))
    off = np.abs(places[:, None] - np.array(parts)[None]).max(axis=2).min(axis=1)
    assert off.max() < 1e-5
    assert (boxes.track_id == NO_TRACK).all()
    # Each in a share of the frames of its own.
    share = counts / times.size
    assert share.min() < 0.5 < share.max()


@pytest.mark.slow
def test_what_is_painted_is_where_the_boxes_are(harbour: Harbour) -> None:
    assert harbour.shore is not None
    image = Renderer(harbour).image(harbour.start_utc_s + 10.0).astype(float)
    bare = replace(harbour, shore=None)
    without = Renderer(bare).image(harbour.start_utc_s + 10.0).astype(float)
    changed = np.abs(image - without).max(axis=2) > 12.0
    painted = []
    for feature in harbour.shore.features:
        if feature.kind not in ("house", "block", "shed"):
            continue
        pixels = harbour.camera.project(feature.outline_enu_m())
        left, top = np.ceil(pixels.min(axis=0)).astype(int)
        right, bottom = np.floor(pixels.max(axis=0)).astype(int)
        if not (0 <= left < right < 1280 and 0 <= top < bottom < 720):
            continue
        painted.append(float(changed[top:bottom, left:right].mean()))
    # Some are behind a post or a boat, which are there in both.
    assert len(painted) > 60
    assert np.mean(np.array(painted) > 0.5) > 0.9
    # Sky above the town, and water before it, are as they were.
    feet = harbour.camera.project(
        [0.0, 0.0, 0.0]
        + np.array([[np.sin(b), np.cos(b), 0.0] for b in np.radians([harbour.camera.heading_deg])])
        * 0.9
        * harbour.shore.range_m
    )
    row = int(feet[0, 1])
    assert changed[row + 30 :].mean() < 0.01
    assert changed[: row - 260].mean() < 0.01


def test_a_boat_casts_off_when_it_is_said_to() -> None:
    path = cast_off([10.0, 200.0], 90.0, 20.0, 60.0, speed_mps=3.0)
    assert path.at([0.0, 19.9]) == pytest.approx(np.array([[10.0, 200.0]] * 2), abs=1e-2)
    # At 0.3 m/s² for 10 s: 15 m, and 3 m/s from then on.
    assert path.at([30.0, 40.0]) == pytest.approx(
        np.array([[25.0, 200.0], [55.0, 200.0]]), abs=0.05
    )
    assert path.course_deg([0.0, 40.0]) == pytest.approx([90.0, 90.0], abs=0.1)


def test_files_say_who_is_moored(tmp_path: Path) -> None:
    made = simulate(
        tmp_path,
        SimulationSettings(
            seed=2, recordings=1, duration_s=4.0, rate_hz=5.0, video=False, shore=True, moored=12
        ),
    )
    with (tmp_path / "truth-boxes" / "01.csv").open() as file:
        rows = list(csv.DictReader(file))
    moves = {str(boat.identity): boat.path.moves for boat in made.harbour.boats}
    assert {row["state"] for row in rows} == {"moored", "moving"}
    assert all((row["state"] == "moving") == moves[row["track_id"]] for row in rows)
    facts = json.loads((tmp_path / "truth.json").read_text())
    assert sum(boat["moored"] for boat in facts["boats"]) == 12 + 2
    with (tmp_path / "detections" / "01.csv").open() as file:
        found = len(list(csv.DictReader(file)))
    large = made.harbour.boxes(made.recordings[0].time_utc_s, of="all", noise=_EXACT)
    assert found > 0.9 * len(large)


def test_a_town_before_a_vessel_under_way_is_refused() -> None:
    with pytest.raises(InputError, match="stands still"):
        HarbourSettings(shore=True, moving=True)
