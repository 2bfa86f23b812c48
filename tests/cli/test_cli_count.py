"""`sightline count` as somebody at the shell sees it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sightline.cli import main
from sightline.formats import write_tracks
from sightline.geodesy import LocalPlane
from sightline.types import Track

PLANE = LocalPlane(54.3233, 10.1394)
START = 1_717_236_000.0


def eastward(number: int, start_s: float, label: str = "boat") -> Track:
    time = START + start_s + np.arange(0.0, 101.0)
    n = len(time)
    return Track(
        track_id=number,
        time_utc_s=time,
        east_m=-200.0 + 4.0 * np.arange(n),
        north_m=np.full(n, 10.0 * number),
        velocity_east_mps=np.full(n, 4.0),
        velocity_north_mps=np.zeros(n),
        covariance_m2=np.tile(4.0 * np.eye(2), (n, 1, 1)),
        velocity_covariance_m2ps2=np.tile(0.01 * np.eye(2), (n, 1, 1)),
        kind=np.zeros(n, dtype=np.int8),
        plane=PLANE,
        label=label,
    )


def geojson(path: Path, kind: str, corners_m: list[tuple[float, float]], name: str) -> None:
    latitude, longitude = PLANE.to_geographic(*np.array(corners_m).T)
    corners = np.column_stack([longitude, latitude]).tolist()
    geometry = {"type": kind, "coordinates": [corners] if kind == "Polygon" else corners}
    feature = {"type": "Feature", "properties": {"name": name}, "geometry": geometry}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    tracks = [eastward(1, 0.0), eastward(2, 3.0, "=ferry"), eastward(3, 1000.0)]
    for ending in ("geojson", "csv", "parquet"):
        write_tracks(tracks, tmp_path / f"tracks.{ending}")
    geojson(tmp_path / "lines.geojson", "LineString", [(0.0, -90.0), (0.0, 90.0)], "gate")
    square = [(0.0, -50.0), (80.0, -50.0), (80.0, 50.0), (0.0, 50.0)]
    geojson(tmp_path / "zones.geojson", "Polygon", square, "basin")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def call(line: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(line.split())
    return int(stopped.value.code or 0)


@pytest.mark.parametrize("ending", ["geojson", "csv", "parquet"])
def test_counts_of_any_file_of_tracks(
    ending: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = f"count tracks.{ending} --lines lines.geojson --zones zones.geojson --closest 30"
    asked += " -o c.csv -o c.parquet -o c.json --json result.json"
    assert call(asked) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "line gate, left to right (eastbound): 3 crossings, expected 3.00" in said.out
    result = json.loads((folder / "c.json").read_text())
    assert result == json.loads((folder / "result.json").read_text())
    table = pd.read_csv(folder / "c.csv")
    lines = table[table["what"] == "line"]
    counts = lines[lines["direction"] == "left to right"].groupby("begin_utc")["count"].sum()
    assert counts.to_dict() == {"2024-06-01T10:00:00Z": 2, "2024-06-01T10:15:00Z": 1}
    # What a spreadsheet would take for a formula is a text.
    assert set(lines["class"]) == {"boat", "'=ferry"}
    zones = table[table["what"] == "zone"]
    assert zones["dwell_mean_s"].dropna().tolist() == pytest.approx([20.0] * 3, abs=0.01)
    (near,) = result["near_misses"]
    # 12 m behind and 10 m beside.
    assert near["distance_m"] == pytest.approx(np.hypot(12.0, 10.0), abs=1e-3)
    # GeoJSON has the ellipse in place of the covariance, which of two such is a circle as well.
    assert near["distance_sigma_m"] == pytest.approx(np.sqrt(8.0), rel=1e-3)
    parquet = pd.read_parquet(folder / "c.parquet")
    assert parquet["count"].sum() == table["count"].sum() == 3
    # Results of before are replaced, and others are not.
    assert call(asked) == 0


def test_another_file_is_not_replaced(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "c.csv").write_text("a,b\n1,2\n")
    assert call("count tracks.csv --lines lines.geojson -o c.csv") == 2
    assert "exists and is not a table of counts" in capsys.readouterr().err
    assert call("count tracks.csv --lines lines.geojson -o tracks.csv") == 2
    assert call("count tracks.csv --lines lines.geojson -o c.csv --overwrite") == 0


def test_tracks_that_say_no_covariance_are_told(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = pd.read_csv(folder / "tracks.csv")
    bare = ["track_id", "time_utc", "latitude_deg", "longitude_deg"]
    table[bare].to_csv(folder / "bare.csv", index=False)
    assert call("count bare.csv --lines lines.geojson -o c.json") == 0
    assert "3 of 3 tracks do not say how unsure" in capsys.readouterr().err
    rows = json.loads((folder / "c.json").read_text())["lines"]
    assert sum(row["count"] for row in rows) == 3
    assert {row["sigma"] for row in rows if row["count"]} == {None}


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("", "there is nothing to count"),
        ("--lines none.geojson", "none.geojson: there is no such file"),
        ("--lines zones.geojson", "a line is a LineString"),
        ("--zones lines.geojson", "holds a LineString"),
        ("--lines lines.geojson --every soon", "--every 'soon': is no time"),
        ("--lines lines.geojson --every 0min", "between a second and a year"),
        ("--closest -3", "--closest -3: is no distance"),
        ("--closest nan", "--closest nan: is no distance"),
        ("--lines lines.geojson -o c.xlsx", "c.xlsx: unknown format of counts; known are .csv"),
        ("--lines lines.geojson -o lines.geojson", "is read by this command"),
    ],
)
def test_bad_input_is_told_in_a_line(
    asked: str, said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(f"count tracks.csv {asked}") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
