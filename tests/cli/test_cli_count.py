"""`sightline count` as somebody at the shell sees it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sightline.cli import main
from sightline.formats import read_boxes, write_tracks
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
    (tmp_path / "a.otflow").write_text('{"sections": [], "flows": []}')
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


def test_a_figure_and_the_flows_from_each_line_to_each_other(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    features = []
    for name, east_m in (("gate", 0.0), ("pier", 90.0)):
        geojson(folder / "one.geojson", "LineString", [(east_m, -90.0), (east_m, 90.0)], name)
        features += json.loads((folder / "one.geojson").read_text())["features"]
    collection = {"type": "FeatureCollection", "features": features}
    (folder / "two.geojson").write_text(json.dumps(collection))
    asked = "count tracks.csv --lines two.geojson --flows flows.csv --plot c.png --json c.json"
    assert call(asked) == 0
    assert "flow gate --> pier: 3" in capsys.readouterr().out
    table = pd.read_csv(folder / "flows.csv")
    wanted = ["start time", "end time", "classification", "flow", "from section", "to section"]
    assert list(table) == [*wanted, "count"]
    # Two classes, two intervals, two flows.
    assert len(table) == 8
    assert table[table["flow"] == "gate --> pier"]["count"].sum() == table["count"].sum() == 3
    assert (folder / "c.png").read_bytes().startswith(b"\x89PNG")
    # Results of before are replaced, and others are not.
    assert call(asked) == 0
    (folder / "flows.csv").write_text("a,b\n")
    assert call(asked) == 2
    assert "is not a table of counted flows" in capsys.readouterr().err


def test_the_clip_of_otvision_through_its_whole_way_to_counts(
    folder: Path, data_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What crosses on the road is what OTAnalytics' way of counting finds in the picture."""
    clip = data_dir / "otvision"
    ends = {"near": ((540, 175), (790, 175)), "far": ((600, 125), (760, 125))}
    ends["middle"] = ((300, 110), (300, 330))
    foot = {"section-enter": {"x": 0.5, "y": 1.0}}
    sections = [
        {
            "id": name,
            "type": "line",
            "relative_offset_coordinates": foot,
            "coordinates": [{"x": x, "y": y} for x, y in corners],
        }
        for name, corners in ends.items()
    ]
    flows = [{"id": "away", "start": "near", "end": "far"}]
    (folder / "j.otflow").write_text(json.dumps({"sections": sections, "flows": flows}))
    (folder / "j.toml").write_text(
        f'control_points = "{clip / "Cars-Truck.otrfpts"}"\n[camera]\nimage_size_px = [800, 600]\n'
    )
    assert call("fit j.toml --model camera -o j.safetensors") == 0
    assert call(f"track {clip / 'Cars-Truck.ottrk'} --model j.safetensors -o j.csv") == 0
    capsys.readouterr()
    asked = "count j.csv --lines j.otflow --model j.safetensors --flows flows.csv --json j.json"
    assert call(asked) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "flow away: 1" in said.out

    # Where the middle of a box's lower edge passes a section, in pixels.
    boxes = read_boxes(clip / "Cars-Truck.ottrk")
    wanted: dict[tuple[str, str], int] = {}
    for number in set(boxes.track_id.tolist()):
        own = boxes[boxes.track_id == number]
        x1, _, x2, y2 = own.xyxy_px[np.argsort(own.frame)].T
        place = np.column_stack([0.5 * (x1 + x2), y2])
        for name, (a, b) in ends.items():
            along = np.subtract(b, a)
            side = along[0] * (place[:, 1] - a[1]) - along[1] * (place[:, 0] - a[0])
            share = (place - a) @ along / (along @ along)
            for k in np.flatnonzero(np.sign(side[1:]) != np.sign(side[:-1])):
                if 0.0 < share[k] < 1.0:
                    key = (name, str(own.label[0]))
                    wanted[key] = wanted.get(key, 0) + 1
    assert wanted == {("near", "car"): 1, ("far", "car"): 1, ("middle", "truck"): 1}
    found: dict[tuple[str, str], int] = {}
    for row in json.loads((folder / "j.json").read_text())["lines"]:
        key = (row["name"], row["class"])
        found[key] = found.get(key, 0) + row["count"]
        # The uncertainty of a speed is in tables of tracks.
        assert not row["count"] or 0.0 < row["speed_se_mps"] < row["speed_mean_mps"]
    assert {key: n for key, n in found.items() if n} == wanted


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
        ("--lines lines.geojson --plot c.gif", "c.gif: a figure ends in .png, .svg, .pdf"),
        ("--closest 3 --plot c.png", "--plot FILE: there is nothing to draw"),
        ("--closest 3 --flows f.csv", "--flows FILE: needs --lines"),
        ("--lines lines.geojson --flows f.json", "a table that ends in .csv"),
        ("--lines lines.geojson --flows tracks.csv", "is read by this command"),
        ("--lines lines.geojson --model lines.geojson", "is for sections in pixels"),
        ("--lines a.otflow", "a.otflow: its sections are in pixels; give --model"),
        ("--lines a.otflow --model none.safetensors", "none.safetensors: there is no such file"),
    ],
)
def test_bad_input_is_told_in_a_line(
    asked: str, said: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(f"count tracks.csv {asked}") == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
