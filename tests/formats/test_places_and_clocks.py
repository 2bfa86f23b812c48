from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyproj
import pytest

from sightline.errors import InputError
from sightline.formats import read_clock, read_control_points

POINT = {"x_px": 1, "y_px": 2, "zone_utm": 32, "lon_utm": 5e5, "lat_utm": 5e6, "hemisphere": "N"}


def test_reference_points_of_otvision(data_dir: Path) -> None:
    path = data_dir / "otvision" / "Cars-Truck.otrfpts"
    points = read_control_points(path)
    written = json.loads(path.read_text())
    np.testing.assert_array_equal(
        points.pixel_px, [[p["x_px"], p["y_px"]] for p in written.values()]
    )
    zone = pyproj.Proj(proj="utm", zone=32, ellps="WGS84")
    easting, northing = zone(points.longitude_deg, points.latitude_deg)
    np.testing.assert_allclose(easting, [p["lon_utm"] for p in written.values()], atol=1e-3)
    np.testing.assert_allclose(northing, [p["lat_utm"] for p in written.values()], atol=1e-3)


def test_reference_points_of_the_southern_hemisphere(tmp_path: Path) -> None:
    path = tmp_path / "a.otrfpts"
    path.write_text(json.dumps({"1": POINT | {"hemisphere": "S"}}))
    # The false northing of the south is 10,000 km.
    expected = pyproj.Proj(proj="utm", zone=32, south=True, ellps="WGS84")(5e5, 5e6, inverse=True)
    points = read_control_points(path)
    np.testing.assert_allclose([points.longitude_deg[0], points.latitude_deg[0]], expected)
    assert points.latitude_deg[0] < 0.0


def test_a_table_of_control_points(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("x_px,y_px,latitude_deg,longitude_deg,note\n1.5,2,32.7,-117.2,buoy\n")
    points = read_control_points(path)
    np.testing.assert_array_equal(points.pixel_px, [[1.5, 2.0]])
    assert (points.latitude_deg[0], points.longitude_deg[0]) == (32.7, -117.2)


def test_clocks_of_whole_and_of_posix_seconds_agree(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("frame,utc\n0,2020-09-30T12:00:00Z\n1,2020-09-30T12:00:00.5Z\n")
    (tmp_path / "b.csv").write_text("frame,utc\n0,1601467200\n1,1601467200.5\n")
    for name in ("a.csv", "b.csv"):
        times = read_clock(tmp_path / name).time_utc_s([0, 1])
        np.testing.assert_array_equal(times, [1_601_467_200.0, 1_601_467_200.5])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("frame,time\n0,1\n", "lacks the column utc; found frame, time"),
        ("frame,utc\n", "one time a frame"),
        ("frame,utc\n0,5\n1,4\n", r"row 2 \(frame 1\) is earlier"),
        ("frame,utc\n0,5\n0,6\n", r"row 2 \(frame 0\) does not follow"),
        ("frame,utc\n0,noon\n", "line 2: noon is no time"),
        ("frame,utc\n0,\n", "line 2: nan is no time"),
    ],
)
def test_refused_clock_tables(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "clock.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_clock(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.otrfpts", json.dumps({"1": POINT})[:-9], "is damaged or cut short"),
        ("a.otrfpts", "{}", "holds no control point"),
        ("a.otrfpts", json.dumps({"7": {"x_px": 1}}), "point 7 is incomplete"),
        ("a.otrfpts", json.dumps({"7": 1}), "point 7 is incomplete"),
        ("a.otrfpts", json.dumps({"7": POINT | {"zone_utm": 61}}), "UTM zone 61 does not exist"),
        ("a.csv", "x_px,y_px,latitude_deg\n1,2,3\n", "lacks the column longitude_deg"),
        ("a.csv", "x_px,y_px,latitude_deg,longitude_deg\n1,2,-117,32\n", "is not on the earth"),
    ],
)
def test_refused_control_points(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_control_points(path)
    assert str(caught.value).startswith(str(path))


def test_true_and_false_are_no_numbers(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    for cells in ("TRUE,1.0,54.3,10.1", "1.0,2.0,True,10.1"):
        path.write_text(f"x_px,y_px,latitude_deg,longitude_deg\n{cells}\n")
        with pytest.raises(InputError, match=r"line 2: True is no number"):
            read_control_points(path)
