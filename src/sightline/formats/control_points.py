"""Pixels whose place is known: tables, and OTVision's reference points."""

from __future__ import annotations

import json
import os

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files
from sightline.geodesy import from_utm
from sightline.types import ControlPoints

_REQUIRED = ("x_px", "y_px", "latitude_deg", "longitude_deg")
_OTVISION = ("x_px", "y_px", "zone_utm", "lon_utm", "lat_utm")


def read_control_points(path: str | os.PathLike[str]) -> ControlPoints:
    """Control points from a CSV file or from OTVision's ``.otrfpts``.

    A CSV file has the columns ``x_px,y_px,latitude_deg,longitude_deg`` and may have others. An
    ``.otrfpts`` file is JSON: for each point ``x_px``, ``y_px``, ``zone_utm``, ``hemisphere``, and
    UTM easting and northing under the names ``lon_utm`` and ``lat_utm``.

    Raises:
        InputError: The file is neither, or a point is incomplete or not on the earth.
    """
    if _files.beginning(path).lstrip().startswith("{"):
        return _from_otvision(path)
    (rows,) = _files.table(path, required=_REQUIRED)
    x, y, latitude, longitude = (_files.numbers(path, rows[name]) for name in _REQUIRED)
    return _checked(path, np.column_stack([x, y]), latitude, longitude)


def _from_otvision(path: str | os.PathLike[str]) -> ControlPoints:
    try:
        points = json.loads(_files.existing(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path}: is damaged or cut short ({error})") from error
    pixels, latitudes, longitudes = [], [], []
    for name, point in points.items():
        try:
            x, y, zone, easting, northing = (float(point[key]) for key in _OTVISION)
            north = point.get("hemisphere", "N") == "N"
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"{path}: point {name} is incomplete; expected {', '.join(_OTVISION)} (numbers) "
                "and hemisphere"
            ) from error
        try:
            latitude, longitude = from_utm(easting, northing, int(zone), north=north)
        except InputError as error:
            raise InputError(f"{path}: point {name}: {error}") from error
        pixels.append((x, y))
        latitudes.append(float(latitude))
        longitudes.append(float(longitude))
    return _checked(path, np.array(pixels), np.array(latitudes), np.array(longitudes))


def _checked(
    path: str | os.PathLike[str], pixel_px: np.ndarray, latitude: np.ndarray, longitude: np.ndarray
) -> ControlPoints:
    if not len(latitude):
        raise InputError(f"{path}: holds no control point")
    try:
        return ControlPoints(pixel_px, latitude, longitude)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
