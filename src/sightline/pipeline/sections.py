"""Sections drawn in a camera's picture, as lines and zones on the earth."""

from __future__ import annotations

import itertools

import numpy as np

from sightline.area import Area, Line, Polygon
from sightline.errors import InputError
from sightline.formats.otanalytics import PixelSections
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.types import FloatArray

# What is straight in a picture is bent on the earth, by the lens.
_PARTS = 8


def place_sections(
    sections: PixelSections, model: Georeferencer, where: str = ""
) -> tuple[dict[str, Line], dict[str, Area]]:
    """Lines and zones where sections in pixels lie on the ground, by name.

    Args:
        sections: Their corners in pixels of the camera's picture.
        model: With a camera that stands still.
        where: The file, for messages.

    Raises:
        InputError: The model has no camera or one that moves, or a section reaches above the
            horizon or cannot be used on the ground.
    """
    camera = model.camera
    if camera is None or model.moving:
        raise InputError(
            f"{where}: sections in pixels need a model that has a camera and stands still; fit "
            "camera or camera+gpr"
        )

    def ground(name: str, corners_px: FloatArray) -> FloatArray:
        east, north = camera.locate(corners_px)
        if not np.isfinite(east).all() or not np.isfinite(north).all():
            raise InputError(f"{where}: section {name} reaches above the horizon; draw it lower")
        latitude, longitude = model.plane.to_geographic(east, north)
        return np.column_stack([longitude, latitude])

    lines, areas = {}, {}
    for name, corners in [*sections.lines.items(), *sections.areas.items()]:
        closed = name in sections.areas
        placed = ground(name, _dense(np.vstack([corners, corners[:1]]) if closed else corners))
        try:
            if closed:
                areas[name] = Area((Polygon((placed,)),), name)
            else:
                lines[name] = Line(placed)
        except InputError as error:
            raise InputError(f"{where}: section {name}: {error}") from error
    return lines, areas


def _dense(corners_px: FloatArray) -> FloatArray:
    share = np.arange(_PARTS)[:, None] / _PARTS
    parts = [a + share * (b - a) for a, b in itertools.pairwise(corners_px)]
    return np.concatenate([*parts, corners_px[-1:]])
