from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sightline.errors import InputError
from sightline.formats import read_lines, read_zones

SQUARE = [[10.0, 54.0], [10.1, 54.0], [10.1, 54.1], [10.0, 54.1], [10.0, 54.0]]
BOW = [[10.0, 54.0], [10.1, 54.1], [10.1, 54.0], [10.0, 54.1], [10.0, 54.0]]


def feature(kind: str, coordinates: Any, name: Any = "gate") -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": {"name": name}, "geometry": geometry}


def written(path: Path, *features: Any) -> Path:
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def test_lines_and_zones_are_read_by_their_names(tmp_path: Path) -> None:
    corners = [[10.0, 54.0], [10.1, 54.0, 3.0], [10.1, 54.0], [10.1, 54.1]]
    path = written(
        tmp_path / "a.geojson",
        feature("LineString", corners),
        feature("LineString", [[179.9, 0.0], [-179.9, 0.1]], " date line "),
    )
    lines = read_lines(path)
    assert list(lines) == ["gate", "date line"]
    assert lines["gate"].corners.tolist() == [[10.0, 54.0], [10.1, 54.0], [10.1, 54.1]]
    assert lines["date line"].corners[:, 0].tolist() == pytest.approx([179.9, 180.1])
    several = feature("MultiPolygon", [[SQUARE], [[[11.0, 54.0], [11.1, 54.0], [11.0, 54.1]]]])
    zones = read_zones(written(tmp_path / "z.geojson", several))
    inside = zones["gate"].contains([54.05, 54.01, 54.05], [10.05, 11.01, 10.5])
    assert inside.tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ([feature("Polygon", [SQUARE])], "line gate: it is a Polygon; a line is a LineString"),
        ([feature("LineString", [[10, 54]])], "fewer than two corners"),
        ([feature("LineString", [[10, 54], [10, 54]])], "fewer than two corners"),
        ([feature("LineString", [[54, 100], [54, 10]])], "is not on the earth"),
        ([feature("LineString", SQUARE)], "it is closed"),
        ([feature("LineString", BOW[:-1])], "crosses or touches itself"),
        ([feature("LineString", [[0, 0], [2, 0], [1, 0]])], "crosses or touches itself"),
        ([feature("LineString", [[0, 0], [2, 0], [2, 1], [1, 0]])], "crosses or touches itself"),
        ([feature("LineString", [[10, "x"], [10, 54]])], "no list of longitude and latitude"),
        ([feature("LineString", None)], "no list of longitude and latitude"),
        ([feature("LineString", [])], "no list of longitude and latitude"),
        ([{"type": "Feature", "properties": {"name": "a"}, "geometry": None}], "line a: "),
        ([feature("LineString", [[0, 0], [1, 0]], None)], "feature 1 has no name"),
        ([feature("LineString", [[0, 0], [1, 0]], "  ")], "feature 1 has no name"),
        ([feature("LineString", [[0, 0], [1, 0]])] * 2, "two features have the name gate"),
        ([], "holds no LineString feature"),
        ([3], "feature 1 is no Feature"),
    ],
)
def test_a_line_that_cannot_be_used_is_told_in_a_line(
    features: list[Any], said: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "lines.geojson", *features)
    with pytest.raises(InputError, match=said) as error:
        read_lines(path)
    assert str(error.value).startswith(f"{path}: ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("features", "said"),
    [
        ([feature("LineString", [[0, 0], [1, 0]])], "zone gate: holds a LineString"),
        ([feature("Polygon", [BOW])], "zone gate: polygon 1: its edges cross"),
        ([feature("Polygon", [[[0, 0], [1, 0], [2, 0]]])], "has no area"),
        ([feature("Polygon", [[[0, 0], [1, 95], [2, 0]]])], "is not on the earth"),
        ([feature("Polygon", [SQUARE], 7)], "feature 1 has no name"),
        ([feature("Polygon", [SQUARE])] * 2, "two features have the name"),
    ],
)
def test_a_zone_that_cannot_be_used_is_told_in_a_line(
    features: list[Any], said: str, tmp_path: Path
) -> None:
    path = written(tmp_path / "zones.geojson", *features)
    with pytest.raises(InputError, match=said) as error:
        read_zones(path)
    assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"features": []}', '{"type": "FeatureCollection"}']
)
def test_what_is_no_geojson_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "lines.geojson"
    path.write_text(text)
    with pytest.raises(InputError):
        read_lines(path)
