"""Areas from GeoJSON files (RFC 7946) of polygons."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from sightline.area import MOST_CORNERS, Area, Polygon
from sightline.errors import InputError
from sightline.formats import _files

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


def _polygons(path: str | os.PathLike[str]) -> list[Polygon]:
    try:
        content = json.loads(_files.whole_text(path, _MOST_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, or is cut short; expected GeoJSON") from error
    if not isinstance(content, dict) or "type" not in content:
        raise InputError(f"{path}: is no GeoJSON; expected a FeatureCollection of polygons")
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
