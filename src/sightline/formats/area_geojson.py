"""Areas, and lines and zones that have names, from GeoJSON files (RFC 7946)."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from sightline.area import MOST_CORNERS, Area, Line, Polygon
from sightline.errors import InputError
from sightline.formats import _files
from sightline.text import encodable_text

_MOST_BYTES = 2**27
_DEEPEST = 20
_INNER = {"FeatureCollection": "features", "GeometryCollection": "geometries"}


def read_area(paths: str | os.PathLike[str] | Iterable[str | os.PathLike[str]]) -> Area:
    """The area of all polygons in a GeoJSON file, or in several.

    Args:
        paths: A file or files.

    Raises:
        InputError: One is no GeoJSON, holds none or something else than polygons, or a polygon
            cannot be used: its edges cross, or a corner is not on the earth.
    """
    files = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not files:
        raise InputError("an area needs at least one file")
    polygons = [polygon for path in files for polygon in _polygons(path)]
    return Area(tuple(polygons), ", ".join(map(str, files)))


def read_lines(path: str | os.PathLike[str]) -> dict[str, Line]:
    """The LineString features of a GeoJSON file, by their property ``name``.

    Raises:
        InputError: The file is no GeoJSON, a feature is no LineString, has no name or one that
            another has, or a line cannot be used.
    """
    lines: dict[str, Line] = {}
    for name, feature in _named(path, "line", "LineString"):
        try:
            geometry = feature["geometry"]
            if geometry["type"] != "LineString":
                raise InputError(
                    f"it is a {str(geometry['type'])[:40]}; a line is a LineString feature"
                )
            lines[name] = Line(_ring(geometry["coordinates"]))
        except InputError as error:
            raise InputError(f"{path}: line {_files.shortened(name)}: {error}") from error
        except (TypeError, ValueError, LookupError, OverflowError) as error:
            raise InputError(
                f"{path}: line {_files.shortened(name)}: has coordinates that are no list of "
                "longitude and latitude"
            ) from error
    return lines


def read_zones(path: str | os.PathLike[str]) -> dict[str, Area]:
    """The Polygon and MultiPolygon features of a GeoJSON file, by their property ``name``.

    Raises:
        InputError: The file is no GeoJSON, a feature is no polygon, has no name or one that
            another has, or a polygon cannot be used.
    """
    zones: dict[str, Area] = {}
    for name, feature in _named(path, "zone", "Polygon"):
        where = f"{path}: zone {_files.shortened(name)}"
        zones[name] = Area(tuple(_polygons_of(where, feature)), where)
    return zones


def _named(
    path: str | os.PathLike[str], what: str, geometry: str
) -> Iterator[tuple[str, dict[str, Any]]]:
    """The features of a collection and their names, of which no two are the same."""
    content = _content(path, f"{geometry} features")
    features = content.get("features") if content["type"] == "FeatureCollection" else [content]
    if not isinstance(features, list) or not features:
        raise InputError(f"{path}: holds no {geometry} feature, so there is no {what}")
    names: set[str] = set()
    for number, feature in enumerate(features, start=1):
        if not isinstance(feature, dict) or feature.get("type") != "Feature":
            raise InputError(f"{path}: feature {number} is no Feature of GeoJSON")
        properties = feature.get("properties")
        name = properties.get("name") if isinstance(properties, dict) else None
        if not isinstance(name, str) or not name.strip():
            raise InputError(
                f"{path}: feature {number} has no name; give each {what} the property name"
            )
        name = encodable_text(name.strip())
        if name in names:
            raise InputError(
                f"{path}: two features have the name {_files.shortened(name)}; give each {what} "
                "a name of its own"
            )
        names.add(name)
        yield name, feature


def _content(path: str | os.PathLike[str], of: str) -> dict[str, Any]:
    try:
        content = json.loads(_files.whole_text(path, _MOST_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, or is cut short; expected GeoJSON") from error
    if not isinstance(content, dict) or "type" not in content:
        raise InputError(f"{path}: is no GeoJSON; expected a FeatureCollection of {of}")
    return content


def _polygons(path: str | os.PathLike[str]) -> list[Polygon]:
    return _polygons_of(path, _content(path, "polygons"))


def _polygons_of(path: str | os.PathLike[str], content: Mapping[str, Any]) -> list[Polygon]:
    found: list[Polygon] = []
    corners = 0
    for coordinates in _coordinates(path, content, 0):
        number = len(found) + 1
        try:
            rings = tuple(_ring(ring) for ring in coordinates)
        except (TypeError, ValueError, IndexError, OverflowError) as error:
            raise InputError(
                f"{path}: polygon {number} has coordinates that are no lists of longitude and "
                "latitude"
            ) from error
        corners += sum(len(ring) for ring in rings)
        if corners > MOST_CORNERS:
            raise InputError(f"{path}: has more than {MOST_CORNERS} corners; simplify it")
        try:
            found.append(Polygon(rings))
        except InputError as error:
            raise InputError(f"{path}: polygon {number}: {error}") from error
    if not found:
        raise InputError(f"{path}: holds no polygon, so nothing could be in the area")
    return found


def _ring(positions: Any) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    # A third number is a height.
    return np.array([[_degrees(x) for x in one[:2]] for one in positions]).reshape(-1, 2)


def _degrees(value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError("is no number")
    return float(value)


def _coordinates(
    path: str | os.PathLike[str], content: Mapping[str, Any], depth: int
) -> Iterator[Any]:
    """The coordinates of each polygon in an object of GeoJSON."""
    kind = content.get("type") if isinstance(content, dict) else None
    if depth > _DEEPEST or not isinstance(kind, str):
        raise InputError(f"{path}: is no GeoJSON; expected a FeatureCollection of polygons")
    if kind in _INNER:
        inner = content.get(_INNER[kind])
        if not isinstance(inner, list):
            raise InputError(f"{path}: its {kind} has no list {_INNER[kind]}")
        for one in inner:
            yield from _coordinates(path, one, depth + 1)
    elif kind == "Feature":
        if content.get("geometry") is None:
            raise InputError(f"{path}: has a feature without a geometry; an area is of polygons")
        yield from _coordinates(path, content["geometry"], depth + 1)
    elif kind in ("Polygon", "MultiPolygon"):
        coordinates = content.get("coordinates")
        if not isinstance(coordinates, list):
            raise InputError(f"{path}: has a {kind} without coordinates")
        yield from [coordinates] if kind == "Polygon" else coordinates
    else:
        raise InputError(f"{path}: holds a {kind[:40]}; an area is of polygons")
