"""Tracks of the last minutes as GeoJSON, as another library and the standard read them."""

from __future__ import annotations

import json
from datetime import datetime

import numpy as np
import pytest
from web_moments import HOSTILE, START, moment, target

from sightline.web.memory import TrackMemory


def features(memory: TrackMemory, minutes: float = 30.0) -> list[dict]:
    document = json.loads(memory.geojson(minutes))
    assert document["type"] == "FeatureCollection"
    return document["features"]


def test_nothing_is_an_empty_collection() -> None:
    assert features(TrackMemory()) == []


def test_a_track_is_a_line_with_its_newest_state() -> None:
    memory = TrackMemory()
    for i in range(50):
        memory.add(moment(0.2 * i, target(longitude_deg=10.0 + 1e-5 * i, name="BOAT")))
    (one,) = features(memory)
    assert one["geometry"]["type"] == "LineString"
    line, times = one["geometry"]["coordinates"], one["properties"]["coordTimes"]
    assert len(line) == len(times) == 6
    seconds = [datetime.fromisoformat(time).timestamp() - START for time in times]
    assert seconds == pytest.approx([0.0, 2.0, 4.0, 6.0, 8.0, 9.8], abs=1e-3)
    np.testing.assert_allclose(line[-1], [10.00049, 54.3233], atol=1e-9)
    np.testing.assert_allclose([x for x, _ in line], 10.0 + 5e-5 * np.array(seconds), atol=1e-7)
    properties = one["properties"]
    assert (properties["name"], properties["state"]) == ("BOAT", "measured")
    # Of [[4, 1], [1, 9]]: eigenvalues 6.5 +- sqrt(7.25).
    assert properties["semi_major_m"] == pytest.approx(2.44775 * 9.1926**0.5, abs=2e-3)
    assert properties["semi_minor_m"] == pytest.approx(2.44775 * 3.8074**0.5, abs=2e-3)


def test_only_the_minutes_that_were_asked_for_are_told() -> None:
    memory = TrackMemory()
    for i in range(120):
        memory.add(moment(10.0 * i, target(1), *((target(2),) if i < 60 else ())))
    assert [one["id"] for one in features(memory, 5.0)] == [1]
    assert len(features(memory, 5.0)[0]["geometry"]["coordinates"]) == 31
    assert {one["id"] for one in features(memory, 15.0)} == {1, 2}


def test_memory_has_a_bound_and_the_oldest_goes_first() -> None:
    memory = TrackMemory(points=100)
    for i in range(1000):
        memory.add(moment(2.0 * i, target(i % 10)))
    assert len(memory) == 100
    lines = [len(one["geometry"]["coordinates"]) for one in features(memory, 1440.0)]
    assert lines == [10] * 10


def test_what_lies_still_takes_little() -> None:
    memory = TrackMemory()
    for i in range(600):
        memory.add(moment(1.0 * i, target(state="moored")))
    assert len(memory) == 20


def test_a_clock_that_is_set_back_goes_on_being_remembered() -> None:
    memory = TrackMemory()
    for i in range(10):
        memory.add(moment(2.0 * i))
    for i in range(10):
        memory.add(moment(2.0 * i - 5000.0))
    assert len(memory) == 20
    assert features(memory, 1.0) != []


def test_a_line_over_the_antimeridian_is_cut_there() -> None:
    """RFC 7946, 3.1.9: no part crosses it, and both end on it at the same latitude."""
    memory = TrackMemory()
    memory.add(moment(0.0, target(latitude_deg=-16.0, longitude_deg=179.9)))
    memory.add(moment(4.0, target(latitude_deg=-16.2, longitude_deg=-179.7)))
    (one,) = features(memory)
    assert one["geometry"] == {
        "type": "MultiLineString",
        "coordinates": [
            [[179.9, -16.0], [180.0, -16.05]],
            [[-180.0, -16.05], [-179.7, -16.2]],
        ],
    }


def test_geopandas_reads_it(tmp_path) -> None:
    geopandas = pytest.importorskip("geopandas")
    memory = TrackMemory()
    for i in range(5):
        memory.add(moment(2.0 * i, target(1, name=HOSTILE), target(2)))
    (tmp_path / "tracks.geojson").write_text(memory.geojson(30.0), encoding="utf-8")
    table = geopandas.read_file(tmp_path / "tracks.geojson")
    assert table["name"][0] == HOSTILE
    assert list(table["name"].isna()) == [False, True]
    assert set(table.geometry.geom_type) == {"LineString"}
