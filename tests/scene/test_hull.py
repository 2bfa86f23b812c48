"""Stated hulls: the log of an antenna as that of the middle of the hull."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyais
import pytest

from sightline.errors import InputError
from sightline.formats import read_ais_vessel
from sightline.scene import Scene
from sightline.scene.hull import Hull
from sightline.types import Fixes, FloatArray

LATITUDE, LONGITUDE = 54.0, 10.0
# Of WGS 84 at 54 degrees north.
LATITUDE_M, LONGITUDE_M = 111_305.0, 65_576.0


def fixes_of(east: FloatArray, north: FloatArray) -> Fixes:
    return Fixes(
        time_utc_s=1.7e9 + np.arange(east.size, dtype=float),
        latitude_deg=LATITUDE + north / LATITUDE_M,
        longitude_deg=LONGITUDE + east / LONGITUDE_M,
    )


def moved(hull: Hull, east: FloatArray, north: FloatArray) -> FloatArray:
    fixes = fixes_of(east, north)
    middle = hull.middle_of(fixes)
    np.testing.assert_array_equal(middle.time_utc_s, fixes.time_utc_s)
    return np.stack(
        [
            (middle.longitude_deg - fixes.longitude_deg) * LONGITUDE_M,
            (middle.latitude_deg - fixes.latitude_deg) * LATITUDE_M,
        ],
        axis=1,
    )


SHIP = Hull.of(None, None, [80.0, 20.0, 4.0, 10.0])
"""100 m by 14 m; its middle lies 30 m ahead of the antenna and 3 m to starboard."""


@pytest.mark.parametrize(
    ("course_deg", "expected"),
    [
        (0.0, (3.0, 30.0)),
        (90.0, (30.0, -3.0)),
        (180.0, (-3.0, -30.0)),
        (270.0, (-30.0, 3.0)),
    ],
)
def test_the_middle_lies_ahead_and_to_starboard(
    course_deg: float, expected: tuple[float, float]
) -> None:
    assert SHIP.size_m == (100.0, 14.0)
    along = 5.0 * np.arange(120.0)
    course = np.radians(course_deg)
    off = moved(SHIP, along * np.sin(course), along * np.cos(course))
    np.testing.assert_allclose(off, np.tile(expected, (120, 1)), atol=0.02)


def test_one_that_stops_keeps_its_course() -> None:
    east = np.concatenate([np.zeros(60), 4.0 * np.arange(60.0), np.full(60, 236.0)])
    off = moved(SHIP, east, np.zeros(180))
    np.testing.assert_allclose(off[:40], np.tile((30.0, -3.0), (40, 1)), atol=0.02)
    np.testing.assert_allclose(off[140:], np.tile((30.0, -3.0), (40, 1)), atol=0.02)


def test_one_that_comes_back_is_turned_round() -> None:
    east = np.concatenate([4.0 * np.arange(60.0), 236.0 - 4.0 * np.arange(60.0)])
    off = moved(SHIP, east, np.zeros(120))
    np.testing.assert_allclose(off[:50], np.tile((30.0, -3.0), (50, 1)), atol=0.02)
    np.testing.assert_allclose(off[-50:], np.tile((-30.0, 3.0), (50, 1)), atol=0.02)


@pytest.mark.parametrize(
    "hull", [Hull(), Hull.of(100.0, 14.0, None), Hull.of(None, None, [0.0, 0.0, 0.0, 0.0])]
)
def test_without_an_antenna_the_log_stays_as_it_is(hull: Hull) -> None:
    assert not hull.antenna_known
    assert not moved(hull, 5.0 * np.arange(60.0), np.zeros(60)).any()


def test_one_that_never_goes_stays_where_it_is() -> None:
    assert not moved(SHIP, np.zeros(60), np.zeros(60)).any()


def test_what_is_not_stated() -> None:
    assert math.isnan(Hull().length_m)
    assert Hull.of(12.0, None, None).size_m[0] == 12.0
    # Zero to both sides says nothing of them.
    bare = Hull.of(None, None, [10.0, 2.0, 0.0, 0.0])
    assert (bare.length_m, bare.ahead_m, bare.starboard_m) == (12.0, 4.0, 0.0)
    assert math.isnan(bare.beam_m)


def load(folder: Path, recording: str) -> Scene:
    return prepared(folder, recording)()


def prepared(folder: Path, recording: str) -> Callable[[], Scene]:
    """A scene, to be read once the rest of its files is there."""
    (folder / "log.csv").write_text("time_utc,latitude_deg,longitude_deg\n1e9,54,10\n")
    (folder / "boxes.csv").write_text("frame,x1,y1,x2,y2,time_utc\n0,1,1,2,2,1e9\n")
    path = folder / "scene.toml"
    path.write_text(
        '[camera]\nimage_size_px = [640, 480]\n[[recordings]]\nname = "a"\nboxes = "boxes.csv"\n'
        + recording
    )
    return lambda: Scene.load(path)


def test_a_scene_states_hulls(tmp_path: Path) -> None:
    text = 'fixes = "log.csv"\nlength_m = 101\nantenna_m = [80, 20, 4, 10]\n'
    hull = load(tmp_path, text)["a"].hull()
    assert hull.size_m == (101.0, 14.0)
    assert (hull.ahead_m, hull.starboard_m) == (30.0, 3.0)


SIDES = ("to_bow", "to_stern", "to_port", "to_starboard")


def sentences(mmsi: int, *static: dict[str, object]) -> str:
    """A vessel that goes north at 5 m/s, with its static reports among those of its place."""
    lines = []
    for i in range(60):
        told: list[dict[str, object]] = [
            {"type": 1, "lat": LATITUDE + 5.0 * i / LATITUDE_M, "lon": LONGITUDE, "speed": 9.7}
        ]
        if i % 20 == 5:
            told += static
        for report in told:
            parts = pyais.encode_dict({"mmsi": mmsi, "course": 0.0, **report})
            lines += [f"2024-06-01T10:00:{i:02d}Z {part}" for part in parts]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("static", "size", "ahead"),
    [
        ({"type": 5, **dict(zip(SIDES, (80, 20, 4, 10), strict=True))}, (100.0, 14.0), 30.0),
        (
            {"type": 24, "partno": 1, **dict(zip(SIDES, (9, 3, 2, 2), strict=True))},
            (12.0, 4.0),
            3.0,
        ),
        # Length and beam, of an antenna that is nobody knows where.
        ({"type": 5, **dict(zip(SIDES, (0, 100, 0, 14), strict=True))}, (100.0, 14.0), math.nan),
        ({"type": 5, **dict.fromkeys(SIDES, 0)}, (math.nan, math.nan), math.nan),
    ],
)
def test_ais_tells_hulls(
    tmp_path: Path, static: dict[str, object], size: tuple[float, float], ahead: float
) -> None:
    other = {"type": 5, **dict(zip(SIDES, (200, 50, 20, 20), strict=True))}
    scene = prepared(tmp_path, 'fixes = "log.nmea"\nmmsi = 211000001\n')
    feed = sentences(211000001, static) + sentences(211000002, other)
    (tmp_path / "log.nmea").write_text(feed)
    recording = scene()["a"]
    hull = recording.hull()
    np.testing.assert_array_equal(hull.size_m, size)
    np.testing.assert_array_equal(hull.ahead_m, ahead)
    # The vessel goes north, and so does what is ahead of its antenna.
    antenna = read_ais_vessel(tmp_path / "log.nmea", 211000001)
    north = (recording.fixes().latitude_deg - antenna.latitude_deg) * LATITUDE_M
    np.testing.assert_allclose(north, np.nan_to_num(ahead), atol=0.05)


def test_what_is_stated_goes_before_what_ais_tells(tmp_path: Path) -> None:
    static = {"type": 5, **dict(zip(SIDES, (80, 20, 4, 10), strict=True))}
    scene = prepared(tmp_path, 'fixes = "log.nmea"\nlength_m = 110\n')
    (tmp_path / "log.nmea").write_text(sentences(211000001, static))
    hull = scene()["a"].hull()
    assert hull.size_m == (110.0, 14.0)
    assert hull.ahead_m == 30.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("length_m = 5", "of the vessel that fixes names; give fixes"),
        ('fixes = "log.csv"\nlength_m = -5', r"recordings\[1\]\.length_m: .* greater than 0"),
        ('fixes = "log.csv"\nantenna_m = [1, 2]', r"recordings\[1\]\.antenna_m: "),
        ('fixes = "log.csv"\nantenna_m = [1, 2, -3, 4]', r"recordings\[1\]\.antenna_m\[3\]: "),
        (
            'fixes = "log.csv"\nlength_m = 50\nantenna_m = [80, 20, 4, 10]',
            "stern, port and starboard, which make length_m 100; it is 50",
        ),
        ('fixes = "log.csv"\nbeam_m = 40\nantenna_m = [80, 20, 4, 10]', "which make beam_m 14"),
    ],
)
def test_refused_hulls(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load(tmp_path, text)
