"""GPX 1.0 and 1.1: logs in, logs and tracks out."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from itertools import groupby
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
from sightline.formats._gpx_points import GpxLine, GpxPoint, read_gpx_points
from sightline.formats._times import NotUnderstoodError, read_times
from sightline.synchronisation import mean_longitudes_deg
from sightline.tally import Tally
from sightline.types import Fixes, FloatArray, Track

_logger = logging.getLogger(__name__)
_HEADER = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="sightline" xmlns="http://www.topografix.com/GPX/1/1">
"""


def read_gpx(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """The points of all tracks in a GPX file, in the order of time.

    GPX 1.0 and 1.1 are read, whatever prefixes or namespace their elements have; what stands in
    extensions, or in another namespace, is not the point's. Where there is no track, the points of
    routes and then the waypoints are its fixes, if they have times. Segments may stand in any
    order. Times that repeat, as receivers write that log whole seconds, are kept; fixes that cannot
    be true are not (`sightline.plausibility`).

    Args:
        path: The file. A document type is refused, since entities in it can fill the memory.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: The file is no GPX or cut short, has no points, a point has no time, times
            decrease within a segment, or a place is not on the earth.
    """
    own = tally if tally is not None else Tally(path)
    own.format = "GPX"
    read = read_gpx_points(path)
    lines = read.tracks
    for kind, other in (("route points", read.routes), ("waypoints", read.waypoints)):
        points = [point for line in other for point in line.points]
        own.count(kind, len(points))
        if not any(line.points for line in lines) and any(point.time for point in points):
            lines = other
            own.note(f"it has no track; its {kind} are read as fixes")
    own.count("track points", sum(len(line.points) for line in read.tracks))
    names = {line.track.name for line in read.tracks if line.track.name}
    fixes = _fixes(path, lines, names.pop() if len(names) == 1 else "", own)
    own.count("fixes", len(fixes))
    if tally is None:
        own.warn(_logger)
    return fixes


def read_gpx_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of a GPX file as a table of tracks: one track for each ``trk``.

    Points of a track that share a time become their mean, since a track has one place at a time.

    Returns:
        Columns track_id, time_utc_s, latitude_deg, longitude_deg, label.

    Raises:
        InputError: As `read_gpx`.
    """
    read = read_gpx_points(path)
    tables = []
    used = {line.track.number for line in read.tracks}
    spare = (number for number in range(1, 2**31) if number not in used)
    for _, segments in groupby(read.tracks, key=lambda line: id(line.track)):
        lines = list(segments)
        track = lines[0].track
        points = [point for line in lines for point in line.points]
        time_s, latitude, longitude = _columns(path, points, None)
        rows = [point.row for point in points]
        _files.check_places(path, rows, latitude, longitude, row="point")
        _files.check_order(path, rows, time_s, row="point")
        number = next(spare) if track.number is None else track.number
        times, first, group, count = np.unique(
            time_s, return_index=True, return_inverse=True, return_counts=True
        )
        table = {
            "time_utc_s": times,
            "latitude_deg": np.bincount(group, latitude) / count,
            "longitude_deg": mean_longitudes_deg(longitude, group, first),
        }
        tables.append(pd.DataFrame(table).assign(track_id=number, label=track.kind))
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


def _fixes(
    path: str | os.PathLike[str], lines: Sequence[GpxLine], name: str, tally: Tally
) -> Fixes:
    points = [point for line in lines for point in line.points]
    time_s, latitude, longitude = _columns(path, points, tally)
    rows = np.array([point.row for point in points])
    # Programs write the newest track first, or the segments of a pause behind each other.
    begins = np.cumsum([0, *(len(line.points) for line in lines if line.points)])
    segments = np.split(np.arange(rows.size), begins[1:-1])
    order = np.concatenate(sorted(segments, key=lambda segment: float(time_s[segment[0]])))
    known = order[np.isfinite(latitude[order]) & np.isfinite(longitude[order])]
    if known.size < rows.size:
        first = rows[np.setdiff1d(order, known)[0]]
        tally.leave_out("without a place", rows.size - known.size, row=f"point {first}")
    texts = [points[i].time for i in known]
    places = latitude[known], longitude[known]
    _files.check_digits(path, rows[known], texts, time_s[known], *places, row="point")
    return _files.fixes(
        path,
        rows[known],
        time_s[known],
        *places,
        name=name,
        row="point",
        tally=tally,
    )


def _columns(
    path: str | os.PathLike[str], points: Sequence[GpxPoint], tally: Tally | None
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times and places of points."""
    if not points:
        raise InputError(f"{path}: has no track points")
    untimed = [point.row for point in points if not point.time]
    if len(untimed) == len(points):
        raise InputError(
            f"{path}: none of its {len(points)} points has a time; a log without times cannot be "
            "matched with a video (was it exported as a route?)"
        )
    if untimed:
        raise InputError(f"{path}, point {untimed[0]}: has no time")
    try:
        read = read_times([point.time for point in points])
    except NotUnderstoodError as error:
        point = points[error.row]
        raise InputError(
            f"{path}, point {point.row}: {_files.shortened(point.time)} {error.why}"
        ) from error
    if tally is not None:
        for sentence in read.assumed:
            tally.note(sentence)
        if read.zoneless:
            tally.note("its times name no zone and are taken for UTC")
    places = np.array([[_degrees(path, point, axis) for axis in (0, 1)] for point in points])
    return read.time_utc_s, places[:, 0], places[:, 1]


def _degrees(path: str | os.PathLike[str], point: GpxPoint, axis: int) -> float:
    text = (point.latitude, point.longitude)[axis]
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = float("inf")
    if np.isinf(value):
        raise InputError(
            f"{path}, point {point.row}: {_files.shortened(text) or 'nothing'} is no number "
            f"({('lat', 'lon')[axis]})"
        )
    return value
