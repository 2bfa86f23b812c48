"""Tracks as GeoJSON (RFC 7946): a Point feature a fix, as QGIS, Leaflet and geopandas read it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.formats import _files, _track_table
from sightline.formats._features import FeatureWriter, feature_writer
from sightline.text import encodable_text
from sightline.types import Track

_PROPERTIES = (
    "speed_mps",
    "course_deg",
    "kind",
    "semi_major_m",
    "semi_minor_m",
    "ellipse_bearing_deg",
    "state",
    "label",
)

_KNOWN = (*_PROPERTIES, *_track_table.FUSED)
_COLUMNS = ("longitude_deg", "latitude_deg", "time", *_PROPERTIES[:-1])


def _feature(columns: tuple[str, ...]) -> str:
    """The text of a feature, whose values are filled in; the label comes last."""
    return (
        '{"type": "Feature", "geometry": {"type": "Point", "coordinates": [%%s, %%s]}, '
        '"properties": {"track_id": %s, "time": %%s, '
        + "".join(f'"{name}": %%s, ' for name in columns)
        + '"label": %s}}'
    )


@contextmanager
def geojson_track_writer(path: Path, *, fused: bool = False) -> Iterator[GeoJsonTrackWriter]:
    """Write tracks one at a time, a feature a point."""
    with feature_writer(path) as features:
        yield GeoJsonTrackWriter(features, fused=fused)


class GeoJsonTrackWriter:
    """Adds tracks to an open GeoJSON file; see `geojson_track_writer`."""

    def __init__(self, features: FeatureWriter, *, fused: bool = False) -> None:
        self._features = features
        self._fused = fused
        self._columns = (*_COLUMNS, *(_track_table.FUSED if fused else ()))
        self._feature = _feature(self._columns[3:])

    def add(self, track: Track) -> None:
        """Write one track."""
        if not len(track):
            return
        columns = _track_table.columns(track)
        columns["time"] = _files.rfc3339(track.time_utc_s)
        if self._fused:
            more = _track_table.fused_columns(track)
            columns |= {name: np.array(more[name].tolist()) for name in ("cameras", "name")}
            columns["mmsi"] = np.array([track.mmsi] * len(track))
        texts = [_values(columns[name]) for name in self._columns]
        label = json.dumps(encodable_text(track.label)).replace("%", "%%")
        feature = self._feature % (json.dumps(track.track_id), label)
        self._features.add(feature % point for point in zip(*texts, strict=True))


def _values(column: NDArray[Any]) -> list[str]:
    """A column as JSON, value by value; what is not known is null, since JSON knows no NaN."""
    values = column.tolist()
    if column.dtype.kind == "f" and np.isnan(column).any():
        values = [None if value != value else value for value in values]
    # All in one call of the encoder, which is written in C.
    return json.dumps(values, allow_nan=False)[1:-1].split(", ")


def read_geojson_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The Point features of a GeoJSON file that have a ``track_id`` and a ``time``.

    Returns:
        A table with ``time_utc_s``, indexed by the number of the feature, from 1.

    Raises:
        InputError: The file is no GeoJSON, or a feature is no point with track_id and time.
    """
    _files.beginning(path)
    try:
        document = json.loads(_files.existing(path).read_text(encoding="utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, is damaged, or is cut short ({error})") from error
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError(f"{path}: is no GeoJSON FeatureCollection")
    if not features:
        raise InputError(f"{path}: holds no point of a track")
    rows = pd.DataFrame([_row(path, i, feature) for i, feature in enumerate(features, start=1)])
    rows.index += 1
    rows["track_id"] = _files.whole_numbers(path, rows["track_id"], row="feature")
    rows["time_utc_s"] = _files.times(path, rows["time"], row="feature")
    for name in ("latitude_deg", "longitude_deg"):
        rows[name] = _files.numbers(path, rows[name], row="feature")
    return rows


def _row(path: str | os.PathLike[str], number: int, feature: Any) -> dict[str, Any]:
    try:
        geometry, properties = feature["geometry"], feature["properties"]
        longitude, latitude = geometry["coordinates"][:2]
        if geometry["type"] != "Point":
            raise KeyError(geometry["type"])
        row = {
            **{name: properties.get(name, np.nan) for name in _KNOWN if name in properties},
            "track_id": properties["track_id"],
            "time": properties["time"],
            "longitude_deg": longitude,
            "latitude_deg": latitude,
        }
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        line = isinstance(feature, dict) and "LineString" in str(feature.get("geometry"))[:200]
        hint = "; a LineString with coordTimes is read as a log, not as tracks" if line else ""
        raise InputError(
            f"{path}, feature {number}: is no Point with the properties track_id and time{hint}"
        ) from error
    for name, value in row.items():
        if isinstance(value, str):
            row[name] = encodable_text(value)
        elif not isinstance(value, int | float | None):
            raise InputError(f"{path}, feature {number}: its {name} is no text and no number")
    return row
