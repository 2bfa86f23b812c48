"""Planning of a camera: what it would know of places on the water, before it is mounted."""

from sightline.planning.drive import PATTERNS, Drive, DriveNoise, logged_drive, pattern_drive
from sightline.planning.learning import Learning, known_camera, learn
from sightline.planning.mounting import Hull, Mounting, horizontal_view
from sightline.planning.water_map import (
    Contour,
    Curvature,
    Row,
    WaterMap,
    curvature,
    rows_along,
    water_map,
)

__all__ = [
    "PATTERNS",
    "Contour",
    "Curvature",
    "Drive",
    "DriveNoise",
    "Hull",
    "Learning",
    "Mounting",
    "Row",
    "WaterMap",
    "curvature",
    "horizontal_view",
    "known_camera",
    "learn",
    "logged_drive",
    "pattern_drive",
    "rows_along",
    "water_map",
]
