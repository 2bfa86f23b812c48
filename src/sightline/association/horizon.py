"""What the edge of the water tells of the camera, without anybody knowing where that edge is.

The far shore lies beyond the furthest place on the water that any log of the scene visited in that
direction. So it appears below the horizon by less than a place there would, and the pitch and the
roll of the camera follow within a fraction of a pixel to a few. Boxes alone cannot tell them from
the habit of a detector whose boxes end too high.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sightline.detection.water_edge import WaterEdge
from sightline.inference.camera import Camera
from sightline.inference.pairs import Landmarks
from sightline.types import FloatArray

_POINTS = 5
_SECTOR_DEG = 8.0
_NEAREST_M = 150.0


def shore_landmarks(edge: WaterEdge, camera: Camera, afloat_m: Iterable[FloatArray]) -> Landmarks:
    """Points of the edge of the water as landmarks for a fit.

    Args:
        edge: In the picture.
        camera: Roughly right: the bearings of columns are taken from it.
        afloat_m: Places on the water, each (N, 2) metres east and north: whole logs.
    """
    places = np.concatenate([np.empty((0, 2)), *afloat_m]) - (camera.east_m, camera.north_m)
    places = places[np.isfinite(places).all(axis=1)]
    distance = np.hypot(places[:, 0], places[:, 1])
    bearing = np.degrees(np.arctan2(places[:, 0], places[:, 1]))
    pixels, where, sigma = [], [], []
    order = np.argsort(edge.column_px)
    for part in np.array_split(order, _POINTS):
        if not part.size:
            continue
        column, row = np.median(edge.column_px[part]), np.median(edge.row_px[part])
        # A point well below the horizon has the bearing of its column.
        lower = float(camera.horizon_y_px([column])[0]) + 40.0
        east, north = camera.locate([[column, lower]])
        if not np.isfinite(east[0]):
            continue
        toward = np.array([east[0] - camera.east_m, north[0] - camera.north_m])
        toward /= np.hypot(*toward)
        turn = (bearing - np.degrees(np.arctan2(toward[0], toward[1])) + 180.0) % 360.0 - 180.0
        least = float(distance[np.abs(turn) < _SECTOR_DEG].max(initial=0.0))
        if least < _NEAREST_M:
            continue
        # Its row below the horizon goes with 1 / distance, which lies anywhere from 0 to 1 / least:
        # a mean of half of that, a standard deviation of 1 / sqrt(12).
        pixels.append([column, row])
        where.append(np.array([camera.east_m, camera.north_m]) + 2.0 * least * toward)
        sigma.append(4.0 / np.sqrt(12.0) * least)
    if not pixels:
        return Landmarks.none()
    return Landmarks(np.array(pixels), np.array(where), np.array(sigma))
