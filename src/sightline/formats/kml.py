"""Tracks as KML with ``gx:Track``: Google Earth plays them along its time slider."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO
from xml.sax.saxutils import escape

from sightline.formats import _files
from sightline.types import Track

_HEADER = """<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2">
<Document>
<name>sightline</name>
"""
_FOOTER = "</Document>\n</kml>\n"


@contextmanager
def kml_track_writer(path: Path) -> Iterator[KmlTrackWriter]:
    """Write tracks one at a time, each a placemark with a ``gx:Track``."""
    with path.open("w", encoding="utf-8") as file:
        file.write(_HEADER)
        yield KmlTrackWriter(file)
        file.write(_FOOTER)


class KmlTrackWriter:
    """Adds tracks to an open KML file; see `kml_track_writer`."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def add(self, track: Track) -> None:
        """Write one track."""
        name = f"{_files.xml_text(track.name or track.label) or 'track'} {track.track_id}"
        if track.never_moves:
            name += " (moored)"
        times = _files.rfc3339(track.time_utc_s).tolist()
        places = zip(track.longitude_deg.tolist(), track.latitude_deg.tolist(), strict=True)
        # In the order of Google's schema: the mode, all times, all places.
        lines = [
            # A bare carriage return would be read back as a line feed.
            f"<Placemark>\n<name>{escape(name, {chr(13): '&#13;'})}</name>",
            "<gx:Track>\n<altitudeMode>clampToGround</altitudeMode>",
            *(f"<when>{time}</when>" for time in times),
            *(
                f"<gx:coord>{longitude:.9f} {latitude:.9f} 0</gx:coord>"
                for longitude, latitude in places
            ),
            "</gx:Track>\n</Placemark>\n",
        ]
        self._file.write("\n".join(lines))
