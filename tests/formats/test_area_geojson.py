"""Areas from GeoJSON, as QGIS, geojson.io and scripts write it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from sightline.errors import InputError
from sightline.formats import read_area

WATER = [[[10.0, 54.0], [10.2, 54.0], [10.2, 54.1], [10.0, 54.1], [10.0, 54.0]]]
POND = [[[11.0, 54.0, 3.5], [11.2, 54.0, 3.5], [11.1, 54.1, 3.5], [11.0, 54.0, 3.5]]]


def write(path: Path, content: Any) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def feature(geometry: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": {}, "geometry": geometry}


FORMS = [
    {"type": "MultiPolygon", "coordinates": [WATER, POND]},
    feature({"type": "MultiPolygon", "coordinates": [WATER, POND]}),
    {
        "type": "FeatureCollection",
        "features": [
            feature({"type": "Polygon", "coordinates": WATER}),
            feature({"type": "Polygon", "coordinates": POND}),
        ],
    },
    {
        "type": "GeometryCollection",
        "geometries": [
            {"type": "Polygon", "coordinates": POND},
            {"type": "Polygon", "coordinates": WATER},
        ],
    },
]


@pytest.mark.parametrize("content", FORMS, ids=[str(form["type"]) for form in FORMS])
def test_all_polygons_of_a_file_are_its_area(tmp_path: Path, content: Any) -> None:
    area = read_area(write(tmp_path / "water.geojson", content))
    assert area.contains([54.05, 54.02, 54.05, 0], [10.1, 11.1, 10.5, 0]).tolist() == [
        True, True, False, False,
    ]  # fmt: skip


def test_several_files_are_one_area(tmp_path: Path) -> None:
    one = write(tmp_path / "a.geojson", {"type": "Polygon", "coordinates": WATER})
    other = write(tmp_path / "b.geojson", {"type": "Polygon", "coordinates": POND})
    area = read_area([one, other])
    assert area.contains([54.05, 54.02], [10.1, 11.1]).tolist() == [True, True]
    assert area.where == f"{one}, {other}"


def test_marks_and_encodings_of_other_programs_are_read(tmp_path: Path) -> None:
    text = json.dumps(FORMS[0])
    for encoding in ("utf-8-sig", "utf-16"):
        (tmp_path / "water.geojson").write_text(text, encoding=encoding)
        assert len(read_area(tmp_path / "water.geojson").polygons) == 2


def swapped(rings: list) -> list:
    return [[[x, 100.0 + y] for x, y, *_ in ring] for ring in rings]


CROSSED = [[[10.0, 54.0], [10.2, 54.1], [10.2, 54.0], [10.0, 54.1], [10.0, 54.0]]]
REFUSED = [
    ("", "is empty"),
    ("{", "is no JSON, or is cut short"),
    (json.dumps(FORMS[2])[:-20], "is no JSON, or is cut short"),
    ("[1, 2]", "is no GeoJSON"),
    ("{}", "is no GeoJSON"),
    ({"type": "FeatureCollection", "features": []}, "holds no polygon, so nothing could be in"),
    ({"type": "FeatureCollection"}, "its FeatureCollection has no list features"),
    ({"type": "FeatureCollection", "features": [7]}, "is no GeoJSON"),
    ({"type": "Feature", "geometry": None}, "has a feature without a geometry"),
    ({"type": "LineString", "coordinates": WATER[0]}, "holds a LineString; an area is of polygons"),
    ({"type": "Polygon"}, "has a Polygon without coordinates"),
    ({"type": "Polygon", "coordinates": []}, "polygon 1: a polygon has no outline"),
    ({"type": "Polygon", "coordinates": [[1, 2, 3]]}, "polygon 1 has coordinates that are no"),
    ({"type": "Polygon", "coordinates": [[["a", "b"]]]}, "polygon 1 has coordinates that are no"),
    ({"type": "Polygon", "coordinates": [[[1], [2], [3]]]}, "polygon 1 .* no lists of longitude"),
    ({"type": "Polygon", "coordinates": CROSSED}, "polygon 1: its edges cross at longitude 10.1"),
    ({"type": "MultiPolygon", "coordinates": [WATER, swapped(POND)]}, "polygon 2: .* on the earth"),
    ({"type": "Polygon", "coordinates": [[[10.0, 54.0], [10.1, 54.0]]]}, "fewer than three"),
    ('{"type": "Polygon", "coordinates": [[[1e999, 0], [1, 1], [0, 1]]]}', "polygon 1: .*no long"),
    ({"type": "Polygon", "coordinates": [[[10**400, 0]]]}, "polygon 1 has coordinates that are no"),
    ('{"type":"GeometryCollection","geometries":[' * 30 + "]}" * 30, "is no GeoJSON"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "message"), REFUSED)
def test_what_is_no_area_is_refused_with_its_file(
    tmp_path: Path, content: Any, message: str
) -> None:
    path = write(tmp_path / "water.geojson", content)
    with pytest.raises(InputError, match=message) as error:
        read_area(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none.geojson: there is no such file"):
        read_area(tmp_path / "none.geojson")
