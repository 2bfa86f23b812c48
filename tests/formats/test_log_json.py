"""Logs in JSON, as daemons and servers on board write them; and JSON that is no log."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.formats import read_boxes, read_fixes, read_tracks
from sightline.tally import Tally
from sightline.types import Fixes

START_S = 1_717_236_000.0
N = 30


def stamp(second: float) -> str:
    moment = datetime.fromtimestamp(START_S + second, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def north_deg(second: float) -> float:
    return round(54.32 + 2.7e-5 * second, 9)


def lines(*objects: Any) -> str:
    return "".join(json.dumps(one) + "\n" for one in objects)


def tpv(second: float, device: str = "/dev/ttyACM0", east_deg: float = 10.13) -> dict[str, Any]:
    return {
        "class": "TPV",
        "device": device,
        "mode": 3,
        "time": stamp(second),
        "ept": 0.005,
        "lat": north_deg(second),
        "lon": east_deg,
        "speed": 3.0,
    }


def delta(second: float, context: str = "vessels.self") -> dict[str, Any]:
    place = {"latitude": north_deg(second), "longitude": 10.13}
    values = [
        {"path": "navigation.speedOverGround", "value": 3.0},
        {"path": "navigation.position", "value": place},
    ]
    update = {"$source": "gps.GP", "timestamp": stamp(second), "values": values}
    return {"context": context, "updates": [update]}


VERSION = {"class": "VERSION", "release": "3.25", "proto_major": 3}
SKY = {"class": "SKY", "device": "/dev/ttyACM0", "satellites": []}
POSITIONS = [[10.13, north_deg(i), 2.0] for i in range(N)]
TIMES = [stamp(i) for i in range(N)]
OBJECTS = [{"time": t, "lat": p[1], "lon": p[0]} for p, t in zip(POSITIONS, TIMES, strict=True)]


def feature(kind: str, positions: Any, properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": positions}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def collection(*features: dict[str, Any]) -> str:
    return json.dumps({"type": "FeatureCollection", "features": features}, indent=1)


LOGS = {
    "gpsd": lines(VERSION, SKY, *map(tpv, range(N)), SKY),
    "gpsd of old": lines(*({**tpv(i), "time": START_S + i, "tag": "RMC"} for i in range(N))),
    "gpsd without a fix": lines(
        VERSION, {"class": "TPV", "mode": 1}, *map(tpv, range(N)), {"class": "TPV", "mode": 0}
    ),
    "gpsd of two receivers": lines(
        *(
            tpv(i + k * 0.5, f"/dev/tty{k}", 10.13 + k * 2e-4)
            for i in range(N)
            for k in (0, 1)
            if i + k < N
        )
    ),
    "Signal K": lines(
        {"self": "vessels.urn:mrn:imo:mmsi:211000001", "version": "1.0"},
        *(delta(i, "vessels.urn:mrn:imo:mmsi:211000001") for i in range(N)),
    ),
    "Signal K among others": lines(
        *(delta(i + k, f"vessels.{who}") for i in range(N) for k, who in enumerate(("self", "b")))
    ),
    "OwnTracks": lines(
        *(
            {"_type": "location", "tst": START_S + i, "lat": north_deg(i), "lon": 10.13, "acc": 5}
            for i in range(N)
        )
    ),
    "GeoJSON": collection(feature("LineString", POSITIONS, {"coordTimes": TIMES})),
    "GeoJSON of toGeoJSON": collection(
        feature("LineString", POSITIONS, {"coordinateProperties": {"times": TIMES}})
    ),
    "GeoJSON in parts": collection(
        feature(
            "MultiLineString",
            [POSITIONS[:9], POSITIONS[9:]],
            {"coordTimes": [TIMES[:9], TIMES[9:]]},
        )
    ),
    "GeoJSON of points": collection(
        *(feature("Point", p, {"time": t}) for p, t in zip(POSITIONS, TIMES, strict=True))
    ),
    "Moving Features": json.dumps(
        {
            "type": "Feature",
            "temporalGeometry": {
                "type": "MovingPoint",
                "datetimes": TIMES,
                "coordinates": POSITIONS,
            },
        }
    ),
    "GeoJSON of points with other names": collection(
        *(feature("Point", p, {"datetime": t}) for p, t in zip(POSITIONS, TIMES, strict=True))
    ),
    "a list": json.dumps(OBJECTS),
    "a list over lines": json.dumps(OBJECTS, indent=2),
    "a list of an object a line": "[\n" + ",\n".join(map(json.dumps, OBJECTS)) + "\n]\n",
    "a list that was cut short": "[\n" + "".join(json.dumps(one) + ",\n" for one in OBJECTS),
    "a list within": json.dumps({"device": "7", "points": OBJECTS}),
    "Google's records": json.dumps(
        {
            "locations": [
                {"timestamp": t, "latitudeE7": f"{p[1] * 1e7:.0f}", "longitudeE7": 101300000}
                for p, t in zip(POSITIONS, TIMES, strict=True)
            ]
        },
        indent=1,
    ),
    "places within objects": lines(
        *({"timestamp": one["time"], "coords": {**one, "time": 7}} for one in OBJECTS)
    ),
    "a list for each column": json.dumps(
        {"time": TIMES, "lat": [p[1] for p in POSITIONS], "lon": [10.13] * N}
    ),
    "Signal K in a list": json.dumps([delta(i) for i in range(N)]),
    "a feature alone": json.dumps(feature("LineString", POSITIONS, {"coordTimes": TIMES})),
}


def read(path: Path, text: str) -> tuple[Fixes, Tally]:
    path.write_text(text)
    tally = Tally(path)
    return read_fixes(path, tally=tally), tally


@pytest.mark.parametrize("name", ["log.json", "log.jsonl", "log.txt", "log"])
@pytest.mark.parametrize("form", LOGS)
def test_logs_in_json(tmp_path: Path, form: str, name: str) -> None:
    fixes, tally = read(tmp_path / name, LOGS[form])
    np.testing.assert_allclose(fixes.time_utc_s - START_S, np.arange(N), rtol=0, atol=1e-6)
    expected = [north_deg(i) for i in range(N)]
    np.testing.assert_allclose(fixes.latitude_deg, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(fixes.longitude_deg, 10.13, rtol=0, atol=1e-9)
    assert {why: left.count for why, left in tally.left_out.items()} == {
        "gpsd without a fix": {"without a fix": 2},
        "gpsd of two receivers": {"of another receiver (/dev/tty1)": N - 1},
        "Signal K among others": {"deltas of other vessels (context)": N},
    }.get(form, {})


def test_wrong_lines_cost_themselves(tmp_path: Path) -> None:
    wrong = [{**tpv(3.5), "time": "1970-01-01T00:00:00.000Z"}, {**tpv(3.5), "lat": 95.0}]
    text = lines(*map(tpv, range(4)), *wrong, {**tpv(3.5), "lat": None}, *map(tpv, range(4, N)))
    fixes, tally = read(tmp_path / "log.json", text[:-30])
    assert len(fixes) == N - 1
    assert {why: left.row for why, left in tally.left_out.items()} == {
        "lines that are no JSON": f"line {N + 3}",
        "without a place": "line 7",
        "with a time that is years from the others": "line 5",
        "with a place that is not on the earth": "line 6",
    }


COCO = json.dumps([{"image_id": 1, "category_id": 9, "bbox": [1.0, 2.0, 3.0, 4.0], "score": 0.5}])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (collection(feature("LineString", POSITIONS, {})), "its points have no times; expected a"),
        (collection(), "is GeoJSON, and holds no point with times"),
        (COCO, "is JSON of boxes, as COCO has it, .* header frame,left,top,width,height"),
        (json.dumps({"a": 1}, indent=1), "is JSON, and holds no fix that is known"),
        (json.dumps({"locations": [{"latitudeE7": 1}]}), "holds no fix that is known"),
        (lines(VERSION, SKY), "holds no fix that is known; expected gpsd"),
        ("[" * 100_000, "is no JSON, is damaged, or is cut short"),
        (json.dumps(OBJECTS)[:-30], "is no JSON, is damaged, or is cut short"),
        ('{"type": "Feature", ' * 9_000, "is no JSON, is damaged, or is cut short"),
    ],
)
def test_json_that_is_no_log(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path / "log.json", text)
    assert "\n" not in str(caught.value)


def test_boxes_that_are_no_table(tmp_path: Path) -> None:
    for content in (COCO, json.dumps({"images": [], "annotations": [{"bbox": [1, 2, 3, 4]}]})):
        (tmp_path / "coco.json").write_text(content)
        with pytest.raises(
            InputError, match=r"as COCO has it, .* frame,left,top,width,height,conf"
        ):
            read_boxes(tmp_path / "coco.json")
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "clip_1.txt").write_text("0 0.5 0.5 0.1 0.1\n")
    with pytest.raises(InputError, match=r"as YOLO writes labels; .* frame,class_id,xc,yc,w,h"):
        read_boxes(tmp_path / "labels")


def test_a_log_in_geojson_is_no_table_of_tracks(tmp_path: Path) -> None:
    (tmp_path / "log.geojson").write_text(LOGS["GeoJSON"])
    with pytest.raises(InputError, match="a LineString with coordTimes is read as a log"):
        read_tracks(tmp_path / "log.geojson")
