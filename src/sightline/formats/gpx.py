"""GPX 1.0 and 1.1: logs in, logs and tracks out."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TextIO

import gpxpy
import gpxpy.gpx
import numpy as np
import pandas as pd
from gpxpy.gpxfield import gpx_fields_to_xml

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.types import Fixes, FloatArray, Track

_HEADER = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="sightline" xmlns="http://www.topografix.com/GPX/1/1">
"""


def read_gpx(path: str | os.PathLike[str]) -> Fixes:
    """The points of all tracks in a GPX file, in the order of the file.

    Times that repeat, as receivers write that log whole seconds, are kept.

    Args:
        path: The file. A document type is refused, since entities in it can fill the memory.

    Raises:
        InputError: The file is no GPX or cut short, has no track points, a point has no time,
            times decrease, or a place is not on the earth.
    """
    gpx = _parse(path)
    points = [point for track in gpx.tracks for point in _points(track)]
    names = {track.name for track in gpx.tracks if track.name}
    return _fixes(path, points, names.pop() if len(names) == 1 else "")


def read_gpx_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of a GPX file as a table of tracks: one track for each ``trk``.

    Points of a track that share a time become their mean, since a track has one place at a time.

    Returns:
        Columns track_id, time_utc_s, latitude_deg, longitude_deg, label.

    Raises:
        InputError: As `read_gpx`.
    """
    gpx = _parse(path)
    tables = []
    used = {track.number for track in gpx.tracks}
    spare = (number for number in range(1, 2**31) if number not in used)
    for track in gpx.tracks:
        log = _fixes(path, _points(track), "")
        number = next(spare) if track.number is None else track.number
        rows = pd.DataFrame(
            {
                "time_utc_s": log.time_utc_s,
                "latitude_deg": log.latitude_deg,
                "longitude_deg": log.longitude_deg,
            }
        )
        rows = rows.groupby("time_utc_s", as_index=False).mean()
        tables.append(rows.assign(track_id=number, label=track.type or ""))
    if not tables:
        raise InputError(f"{path}: holds no track")
    return pd.concat(tables, ignore_index=True)


@contextmanager
def gpx_track_writer(path: Path) -> Iterator[GpxTrackWriter]:
    """Write tracks one at a time, each a ``trk`` whose number is the track's."""
    with path.open("w", encoding="utf-8") as file:
        file.write(_HEADER)
        yield GpxTrackWriter(file)
        file.write("</gpx>\n")


class GpxTrackWriter:
    """Adds tracks to an open GPX file; see `gpx_track_writer`."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def add(self, track: Track) -> None:
        """Write one track."""
        label = _files.xml_text(track.label)
        out = gpxpy.gpx.GPXTrack(name=f"{label or 'track'} {track.track_id}", number=track.track_id)
        out.type = label or None  # type: ignore[assignment]
        out.segments = [_segment(track.time_utc_s, track.latitude_deg, track.longitude_deg)]
        self._file.write(_xml(out))


def write_gpx(fixes: Fixes, path: str | os.PathLike[str]) -> None:
    """Write a log as a GPX file of one track: milliseconds, and degrees to nine places.

    Raises:
        InputError: The file cannot be written.
    """
    out = gpxpy.gpx.GPXTrack(name=_files.xml_text(fixes.name) or None)
    out.segments = [_segment(fixes.time_utc_s, fixes.latitude_deg, fixes.longitude_deg)]
    with atomic_path(path) as temporary:
        temporary.write_text(_HEADER + _xml(out) + "</gpx>\n", encoding="utf-8")


def _points(track: gpxpy.gpx.GPXTrack) -> list[gpxpy.gpx.GPXTrackPoint]:
    return [point for segment in track.segments for point in segment.points]


def _xml(track: gpxpy.gpx.GPXTrack) -> str:
    return gpx_fields_to_xml(track, "trk", "1.1").strip() + "\n"


def _segment(
    time_utc_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> gpxpy.gpx.GPXTrackSegment:
    milliseconds = np.round(time_utc_s * 1000.0).astype(np.int64).tolist()
    rows = zip(milliseconds, latitude_deg.tolist(), longitude_deg.tolist(), strict=True)
    return gpxpy.gpx.GPXTrackSegment(
        [
            gpxpy.gpx.GPXTrackPoint(
                round(latitude, 9),
                round(longitude, 9),
                time=datetime.fromtimestamp(ms // 1000, UTC) + timedelta(milliseconds=ms % 1000),
            )
            for ms, latitude, longitude in rows
        ]
    )


def _parse(path: str | os.PathLike[str]) -> gpxpy.gpx.GPX:
    data = _files.existing(path).read_bytes()
    declared = re.match(rb"""\s*<\?xml[^>]*encoding=["']([A-Za-z0-9._-]+)""", data)
    encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    if declared and declared[1].lower() != b"utf-8":
        encoding = declared[1].decode("ascii")
    try:
        text = data.decode(encoding)
    except (UnicodeDecodeError, LookupError) as error:
        raise InputError(f"{path}: is not text in {encoding}, so it is no GPX file") from error
    if re.search(r"<!\s*(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputError(
            f"{path}: declares a document type, which GPX has none of and which can be abused; "
            "remove the <!DOCTYPE ...> declaration"
        )
    # The text is decoded: what encoding it once had is no longer true.
    text = re.sub(r"^\s*<\?xml[^>]*\?>", "", text.lstrip("\ufeff"), count=1)
    try:
        return gpxpy.parse(text)
    except (gpxpy.gpx.GPXException, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: is no GPX file, is damaged, or is cut short ({reason})"
        ) from error


def _fixes(path: str | os.PathLike[str], points: list[gpxpy.gpx.GPXTrackPoint], name: str) -> Fixes:
    if not points:
        raise InputError(f"{path}: has no track points")
    timed = [point.time is not None for point in points]
    if not any(timed):
        raise InputError(
            f"{path}: none of its {len(points)} points has a time; a log without times cannot be "
            "matched with a video (was it exported as a route?)"
        )
    if not all(timed):
        raise InputError(f"{path}, point {timed.index(False) + 1}: has no time")
    return _files.fixes(
        path,
        range(1, len(points) + 1),
        [_posix(point.time) for point in points if point.time is not None],
        [point.latitude for point in points],
        [point.longitude for point in points],
        name=name,
        row="point",
    )


def _posix(moment: datetime) -> float:
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
