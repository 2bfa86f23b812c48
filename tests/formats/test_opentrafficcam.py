"""OTVision's boxes, and sections and counts of OTAnalytics."""

from __future__ import annotations

import bz2
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_boxes
from sightline.formats.otanalytics import read_otflow, write_flow_counts

BOX = {"class": "car", "confidence": 0.5, "x": 100.0, "y": 50.0, "w": 20.0, "h": 10.0}


def ottrk(path: Path, version: str, box: dict[str, Any]) -> Path:
    video = {"recorded_start_date": "2020-01-01 00:00:00.000000", "recorded_fps": 20.0}
    content = {
        "metadata": {"otdet_version": version, "video": video},
        "data": {"detections": [{**BOX, "frame": 3, "track-id": 7, **box}]},
    }
    path.write_bytes(bz2.compress(json.dumps(content).encode()))
    return path


@pytest.mark.parametrize(
    ("version", "corners"),
    [
        ("1.0", [90.0, 45.0, 110.0, 55.0]),
        ("ignored", [90.0, 45.0, 110.0, 55.0]),
        ("1.1", [100.0, 50.0, 120.0, 60.0]),
        ("1.2", [100.0, 50.0, 120.0, 60.0]),
    ],
)
def test_a_box_is_by_its_centre_or_its_corner_as_its_version_says(
    version: str, corners: list[float], tmp_path: Path
) -> None:
    boxes = read_boxes(ottrk(tmp_path / "a.ottrk", version, {}))
    assert boxes.xyxy_px.tolist() == [corners]
    assert (boxes.frame[0], boxes.track_id[0], boxes.label[0]) == (2, 7, "car")
    # Two frames of a twentieth of a second after 2020 began.
    assert boxes.time_utc_s[0] == pytest.approx(1_577_836_800.0 + 0.1)


def test_times_are_those_of_the_boxes_where_they_have_one(tmp_path: Path) -> None:
    text = {"occurrence": "2020-01-01 00:00:05.500000"}
    assert read_boxes(ottrk(tmp_path / "a.ottrk", "1.0", text)).time_utc_s[0] == 1_577_836_805.5
    number = {"occurrence": "1577836806.25"}
    assert read_boxes(ottrk(tmp_path / "b.ottrk", "1.2", number)).time_utc_s[0] == 1_577_836_806.25


def test_otvisions_own_tracks_lie_on_its_own_detections(data_dir: Path) -> None:
    tracks = read_boxes(data_dir / "otvision" / "Cars-Truck.ottrk")
    detections = read_boxes(data_dir / "otvision" / "Cars-Truck.otdet")
    assert len(set(tracks.track_id.tolist())) == 14
    assert set(tracks.source.tolist()) == {"YOLOv5"}
    assert tracks.frame.min() == 0
    assert tracks.frame.max() == 59
    # Both are of the picture of 800 by 600, the boxes by their corners.
    car = tracks[(tracks.track_id == 1) & (tracks.frame == 0)].xyxy_px[0]
    same = detections[detections.frame == 0].xyxy_px
    assert np.abs(same - car).max(axis=1).min() < 3.0


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"BZh91AY&SY", "damaged or cut short"),
        (b"[1, 2]", "is no file of OTVision"),
        (b"{}", "is no file of OTVision"),
        (b'{"metadata": {"video": {}}, "data": {}}', "is no file of OTVision"),
    ],
)
def test_what_is_no_file_of_otvision_is_refused(content: bytes, said: str, tmp_path: Path) -> None:
    path = tmp_path / "a.otdet"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said):
        read_boxes(path)


def test_boxes_without_a_size_are_refused_or_counted(tmp_path: Path) -> None:
    path = ottrk(tmp_path / "a.ottrk", "1.0", {"w": 0.0})
    with pytest.raises(InputError, match="without width"):
        read_boxes(path)
    assert len(read_boxes(path, skip_empty=True)) == 0
    with pytest.raises(InputError, match="a box is incomplete"):
        read_boxes(ottrk(tmp_path / "b.ottrk", "1.0", {"w": "wide"}))


def section(number: str, kind: str = "line", **more: Any) -> dict[str, Any]:
    """As OTAnalytics writes one."""
    return {
        "id": number,
        "type": kind,
        "relative_offset_coordinates": {"section-enter": {"x": 0.5, "y": 0.5}},
        "coordinates": [{"x": 43, "y": 184}, {"x": 137, "y": 200}, {"x": 352, "y": 145}],
        "plugin_data": {},
        **more,
    }


def otflow(path: Path, *sections: Any, flows: Any = ()) -> Path:
    path.write_text(json.dumps({"sections": sections, "flows": list(flows)}))
    return path


def test_sections_and_flows_of_otanalytics(tmp_path: Path) -> None:
    corner = {"section-enter": {"x": 0.5, "y": 1.0}}
    path = otflow(
        tmp_path / "a.otflow",
        section("1", name="Süd", relative_offset_coordinates=corner),
        section("Nord"),
        section("Platz", "area"),
        flows=[{"id": "Süd --> Nord", "start": "1", "end": "Nord", "distance": 25.0}],
    )
    read = read_otflow(path)
    assert list(read.lines) == ["Süd", "Nord"]
    assert read.lines["Süd"].tolist() == [[43.0, 184.0], [137.0, 200.0], [352.0, 145.0]]
    assert list(read.areas) == ["Platz"]
    assert read.flows == (("Süd --> Nord", "Süd", "Nord"),)
    assert read.offsets == {"Nord": (0.5, 0.5), "Platz": (0.5, 0.5)}


@pytest.mark.parametrize(
    ("sections", "flows", "said"),
    [
        ([section("a"), section("a")], [], "as another has"),
        ([section("a", "circle")], [], "is a circle"),
        ([section("a", coordinates=[{"x": 1, "y": 2}])], [], "section 1 is incomplete"),
        ([section("a", coordinates=[{"x": 1}, {"y": 2}])], [], "section 1 is incomplete"),
        ([section("a")], [{"id": "f", "start": "a", "end": "b"}], "flow 1 is incomplete"),
        (["a"], [], "section 1 is incomplete"),
    ],
)
def test_sections_that_cannot_be_used_are_told(
    sections: list[Any], flows: list[Any], said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said):
        read_otflow(otflow(tmp_path / "a.otflow", *sections, flows=flows))


def test_counts_of_flows_are_in_the_columns_of_otanalytics(tmp_path: Path) -> None:
    row = {
        "begin_utc": "2020-01-01T00:00:00Z",
        "end_utc": "2020-01-01T00:15:00Z",
        "class": "car",
        "name": "away",
        "origin": "near",
        "destination": "far",
        "count": 3,
        "expected": 2.9,
    }
    write_flow_counts([row], tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text().splitlines() == [
        "start time,end time,classification,flow,from section,to section,count",
        "2020-01-01 00:00:00,2020-01-01 00:15:00,car,away,near,far,3",
    ]
