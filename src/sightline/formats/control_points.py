"""Pixels whose place is known: tables, and OTVision's reference points."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files
from sightline.geodesy import from_utm
from sightline.plausibility import check_together
from sightline.tally import Tally
from sightline.types import ControlPoints, FloatArray

_REQUIRED = ("x_px", "y_px", "latitude_deg", "longitude_deg")
_MOST_BYTES = 16 * 2**20
_OTVISION = ("x_px", "y_px", "zone_utm", "lon_utm", "lat_utm")


def read_control_points(
    path: str | os.PathLike[str], *, tally: Tally | None = None
) -> ControlPoints:
    """Control points from a CSV file or from OTVision's ``.otrfpts``.

    A CSV file has the columns ``x_px,y_px,latitude_deg,longitude_deg`` and may have others. An
    ``.otrfpts`` file is JSON: for each point ``x_px``, ``y_px``, ``zone_utm``, ``hemisphere``, and
    UTM easting and northing under the names ``lon_utm`` and ``lat_utm``.

    Args:
        path: The file.
        tally: Takes what was read.

    Raises:
        InputError: The file is neither, or a point is incomplete or not on the earth.
    """
    if _files.beginning(path).lstrip().startswith("{"):
        kind, points = "OTVision", _from_otvision(path)
    else:
        (rows,) = _files.table(path, required=_REQUIRED)
        x, y, latitude, longitude = (_files.numbers(path, rows[name]) for name in _REQUIRED)
        names = [f"the point of line {line}" for line in rows.index]
        kind, points = "CSV", _checked(path, np.column_stack([x, y]), latitude, longitude, names)
    if tally is not None:
        tally.format = kind
        tally.count("points", len(points))
    return points


def _from_otvision(path: str | os.PathLike[str]) -> ControlPoints:
    try:
        points = json.loads(_files.whole_text(path, _MOST_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is damaged or cut short ({error})") from error
    pixels, latitudes, longitudes = [], [], []
    for name, point in points.items():
        try:
            values = [float(point[key]) for key in _OTVISION]
            if not np.isfinite(values).all() or values[2] % 1.0:
                raise ValueError("no finite numbers, or no whole zone")
            x, y, zone, easting, northing = values
            north = point.get("hemisphere", "N") == "N"
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{path}: point {_files.shortened(name)} is incomplete; expected "
                f"{', '.join(_OTVISION)} (numbers) and hemisphere"
            ) from error
        try:
            latitude, longitude = from_utm(easting, northing, int(zone), north=north)
        except InputError as error:
            raise InputError(f"{path}: point {name}: {error}") from error
        pixels.append((x, y))
        latitudes.append(float(latitude))
        longitudes.append(float(longitude))
    shown = [f"point {_files.shortened(str(name))}" for name in points]
    return _checked(path, np.array(pixels), np.array(latitudes), np.array(longitudes), shown)


def _checked(
    path: str | os.PathLike[str],
    pixel_px: FloatArray,
    latitude: FloatArray,
    longitude: FloatArray,
    names: Sequence[str],
) -> ControlPoints:
    if not len(latitude):
        raise InputError(f"{path}: holds no control point")
    try:
        points = ControlPoints(pixel_px, latitude, longitude)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    check_together(latitude, longitude, names, str(path))
    return points
