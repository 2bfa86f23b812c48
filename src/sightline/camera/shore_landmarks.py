"""Landmarks along a shoreline of unknown place, as constraints on the camera.

The far shore lies beyond the furthest place on the water that a log of the scene visited in that
direction, and no further than the earth's curve lets one see. So it appears below the horizon by
less than a place there would, and the pitch and the roll of the camera follow within a fraction of
a pixel to a few. Boxes alone cannot tell them from the bias of a detector whose boxes end high.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sightline.camera.observations import Landmarks
from sightline.camera.pinhole import Camera
from sightline.camera.shoreline import WaterEdge
from sightline.types import FloatArray

_POINTS = 5
_SECTOR_DEG = 8.0
_NEAREST_M = 150.0
# A vessel that is next logged at more than so many times the distance may have gone round a
# headland in between, and the edge that is seen may be that.
_LARGEST_STEP = 2.0
# Of the earth, as light sees it that the air bends: 7/6 of the true one.
_EARTH_RADIUS_M = 7.43e6


def shore_landmarks(
    edges: Sequence[WaterEdge], camera: Camera, afloat_m: Iterable[FloatArray]
) -> Landmarks:
    """Points of the shoreline as landmarks for a fit.

    Args:
        edges: In the pictures of one camera. They are of one shore, and what nobody knows of it is
            the same in all of them: together they give one landmark a direction.
        camera: Roughly right: the bearings of columns are taken from it.
        afloat_m: Places on the water, each (N, 2) metres east and north: whole logs.
    """
    nothing = np.empty(0)
    columns = np.concatenate([nothing, *(edge.column_px for edge in edges)])
    rows = np.concatenate([nothing, *(edge.row_px for edge in edges)])
    places = np.concatenate([np.empty((0, 2)), *afloat_m]) - (camera.east_m, camera.north_m)
    places = places[np.isfinite(places).all(axis=1)]
    distance = np.hypot(places[:, 0], places[:, 1])
    bearing = np.degrees(np.arctan2(places[:, 0], places[:, 1]))
    pixels, where, sigma = [], [], []
    for part in np.array_split(np.argsort(columns, kind="stable"), _POINTS):
        if not part.size:
            continue
        column, row = np.median(columns[part]), np.median(rows[part])
        # A point well below the horizon has the bearing of its column.
        lower = float(camera.horizon_y_px([column])[0]) + 40.0
        east, north = camera.locate([[column, lower]])
        if not np.isfinite(east[0]):
            continue
        toward = np.array([east[0] - camera.east_m, north[0] - camera.north_m])
        toward /= np.hypot(*toward)
        turn = (bearing - np.degrees(np.arctan2(toward[0], toward[1])) + 180.0) % 360.0 - 180.0
        least_m = _water_reaches(distance[np.abs(turn) < _SECTOR_DEG])
        if least_m < _NEAREST_M:
            continue
        # How far below the horizon, as the tangent of the angle, the edge lies at least (where the
        # earth's curve hides what is further) and at most. In between every distance is as likely
        # as twice that, since nothing says on what scale the water is wide.
        highest = np.sqrt(2.0 * camera.height_m / _EARTH_RADIUS_M)
        lowest = camera.height_m / least_m + 0.5 * least_m / _EARTH_RADIUS_M
        ratio = max(np.log(lowest / highest), 1e-3)
        middle = (lowest - highest) / ratio
        spread = np.sqrt(max(0.5 * (lowest**2 - highest**2) / ratio - middle**2, 0.0))
        away_m = camera.height_m / middle
        pixels.append([column, row])
        where.append(np.array([camera.east_m, camera.north_m]) + away_m * toward)
        sigma.append(spread * away_m / middle)
    if not pixels:
        return Landmarks.none()
    return Landmarks(np.array(pixels), np.array(where), np.array(sigma))


def _water_reaches(distance_m: FloatArray) -> float:
    """Range of open water without land before it, as far as is known, metres.

    Args:
        distance_m: (N,) of places on the water in one direction.
    """
    reach_m = 0.0
    for place_m in np.sort(distance_m):
        if place_m > max(_NEAREST_M, _LARGEST_STEP * reach_m):
            break
        reach_m = float(place_m)
    return reach_m
