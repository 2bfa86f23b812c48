"""Tracks as KML with ``gx:Track``: Google Earth plays them along its time slider."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import simplekml

from sightline.formats import _files
from sightline.types import Track


@contextmanager
def kml_track_writer(path: Path) -> Iterator[KmlTrackWriter]:
    """Write tracks, each a ``gx:Track``; the document is kept in memory until the end."""
    document = simplekml.Kml(name="sightline")
    yield KmlTrackWriter(document)
    document.save(str(path))


class KmlTrackWriter:
    """Adds tracks to a KML document; see `kml_track_writer`."""

    def __init__(self, document: simplekml.Kml) -> None:
        self._document = document

    def add(self, track: Track) -> None:
        """Add one track."""
        out = self._document.newgxtrack(
            name=f"{_files.xml_text(track.label) or 'track'} {track.track_id}"
        )
        out.altitudemode = simplekml.AltitudeMode.clamptoground
        out.newwhen(_files.rfc3339(track.time_utc_s).tolist())
        places = zip(track.longitude_deg.tolist(), track.latitude_deg.tolist(), strict=True)
        out.newgxcoord(
            [(round(longitude, 9), round(latitude, 9), 0) for longitude, latitude in places]
        )
