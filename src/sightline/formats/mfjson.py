"""Tracks as OGC Moving Features JSON (19-045r3): a feature a target, as MobilityDB reads it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sightline.formats import _files
from sightline.formats._features import FeatureWriter, feature_writer
from sightline.text import json_text
from sightline.types import Track, ellipses

_SYSTEMS = (
    '"crs": {"type": "Name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, '
    '"trs": {"type": "Name", "properties": {"name": "urn:ogc:data:time:iso8601"}}, '
)


@contextmanager
def mfjson_track_writer(path: Path) -> Iterator[MfJsonTrackWriter]:
    """Write tracks one at a time, a moving point each."""
    with feature_writer(path, _SYSTEMS) as features:
        yield MfJsonTrackWriter(features)


class MfJsonTrackWriter:
    """Adds tracks to an open MF-JSON file; see `mfjson_track_writer`."""

    def __init__(self, features: FeatureWriter) -> None:
        self._features = features

    def add(self, track: Track) -> None:
        """Write one track."""
        if not len(track):
            return
        times = _files.rfc3339(track.time_utc_s).tolist()
        places = zip(track.longitude_deg.tolist(), track.latitude_deg.tolist(), strict=True)
        ellipse = ellipses(track.covariance_m2)
        columns = {
            "speed": ("MTS", track.speed_mps),
            "course": ("DEG", track.course_deg),
            "semi_major_m": ("MTR", ellipse.semi_major_m),
            "semi_minor_m": ("MTR", ellipse.semi_minor_m),
            "ellipse_bearing_deg": ("DEG", ellipse.bearing_deg),
        }
        properties: dict[str, object] = {"datetimes": times}
        for name, (unit, values) in columns.items():
            known = [None if value != value else round(value, 3) for value in values.tolist()]
            properties[name] = {"type": "Measure", "uom": unit, "values": known}
        said: dict[str, object] = {"track_id": track.track_id, "label": track.label}
        if track.mmsi is not None:
            said["mmsi"] = track.mmsi
        if track.name:
            said["name"] = track.name
        feature = {
            "type": "Feature",
            "id": str(track.track_id),
            "properties": said,
            "temporalGeometry": {
                "type": "MovingPoint",
                "datetimes": times,
                "coordinates": [[round(lon, 8), round(lat, 8)] for lon, lat in places],
                "interpolation": "Linear",
            },
            "temporalProperties": [properties],
        }
        self._features.add([json_text(json.dumps(feature, allow_nan=False))])
