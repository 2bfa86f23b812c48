"""Lines with a value, such as contours, as GeoJSON (RFC 7946): a LineString feature a line."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from sightline.atomic import atomic_path
from sightline.types import FloatArray

Line = tuple[Mapping[str, str | float], FloatArray]
"""Its properties, and (N, 2) latitudes and longitudes, degrees."""

_DIGITS = 7


def write_contours(lines: Sequence[Line], path: str | os.PathLike[str]) -> None:
    """Write lines as a GeoJSON feature collection, whole or not at all.

    Args:
        lines: With their properties.
        path: The file.

    Raises:
        InputError: The file cannot be written.
    """
    features = [
        {
            "type": "Feature",
            "properties": dict(properties),
            "geometry": {
                "type": "LineString",
                "coordinates": [
                    [round(longitude, _DIGITS), round(latitude, _DIGITS)]
                    for latitude, longitude in points.tolist()
                ],
            },
        }
        for properties, points in lines
    ]
    head = '{"type": "FeatureCollection", "name": "sightline plan", "features": [\n'
    rows = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(f"{head}{rows}\n]}}\n", encoding="utf-8")
