"""GPX 1.0 and 1.1: logs in, logs and tracks out; KML and TCX: logs in."""

from __future__ import annotations

import itertools
import logging
import os
from collections import Counter
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
from sightline.formats import _files, _log_rows
from sightline.formats._gpx_points import GpxLine, GpxPoint
from sightline.formats._receivers import FIT_M, Source, apart_m, off_board_m
from sightline.formats._times import NotUnderstoodError, read_times
from sightline.formats._xml_points import read_xml_points
from sightline.synchronisation import mean_longitudes_deg, repeated
from sightline.tally import Tally
from sightline.types import BoolArray, Fixes, FloatArray, IntArray, Track

_logger = logging.getLogger(__name__)

# No ship is longer, so that two receivers on board of one are not further apart.
_SHIP_M = 500.0
# Receivers on board of one keep their places on it, but for errors and the time between fixes.
_BESIDE_M = 30.0
_KEEPS_M, _KEEPS = 10.0, 0.15
_FEWEST = 3
_MOST_NAMED = 5
_HEADER = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="sightline" xmlns="http://www.topografix.com/GPX/1/1">
"""


def read_gpx(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """The points of all tracks in a GPX, KML or TCX file, in the order of time.

    Of KML each ``gx:Track`` is a track, and a placemark that is a point with a time a waypoint.
    GPX 1.0 and 1.1 are read, whatever prefixes or namespace their elements have; what stands in
    extensions, or in another namespace, is not the point's. Where there is no track, the points of
    routes and then the waypoints are its fixes, if they have times. Segments may stand in any
    order. Where tracks or segments are of the same times, the points of the longest are used there,
    unless they lie on one line; where they are far apart, or now near and now far, they are of two
    vessels. Times that repeat, as receivers write that log whole seconds, are kept; points without
    a time or a place, or with one that cannot be, are not, nor are fixes that cannot be true
    (`sightline.plausibility`).

    Args:
        path: The file. A document type is refused, since entities in it can fill the memory.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: The file is no GPX or cut short, has no points, half of them are of no use,
            times decrease within a segment, or two tracks of the same times are of two vessels.
    """
    own = tally if tally is not None else Tally(path)
    read = read_xml_points(path)
    own.format = read.format
    lines = read.tracks
    for kind, other in (("route points", read.routes), ("waypoints", read.waypoints)):
        points = [point for line in other for point in line.points]
        own.count(kind, len(points))
        if not any(line.points for line in lines) and any(point.time for point in points):
            lines = other
            own.note(f"it has no track; its {kind} are read as fixes")
    if read.lacks and not any(point.time for line in lines for point in line.points):
        raise InputError(f"{path}: is {read.format}, and {read.lacks}")
    own.count("track points", sum(len(line.points) for line in read.tracks))
    names = {line.track.name for line in read.tracks if line.track.name}
    _note_tracks(read.tracks, own)
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
    read = read_xml_points(path)
    tables = []
    used = {line.track.number for line in read.tracks}
    spare = (number for number in range(1, 2**31) if number not in used)
    for _, segments in groupby(read.tracks, key=lambda line: id(line.track)):
        lines = list(segments)
        track = lines[0].track
        points = [point for line in lines for point in line.points]
        time_s, latitude, longitude = _columns(path, points)
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
        called = _files.xml_text(track.name) or label or "track"
        out = gpxpy.gpx.GPXTrack(name=f"{called} {track.track_id}", number=track.track_id)
        out.type = label or None  # type: ignore[assignment]
        if track.never_moves:
            out.comment = "moored"
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


def _note_tracks(lines: Sequence[GpxLine], tally: Tally) -> None:
    """Say that several tracks are taken for one vessel's: nothing in a file says whose they are."""
    tracks = {id(line.track): line.track.name for line in lines if line.points}
    if len(tracks) < 2:
        return
    named = [_files.shortened(name) for name in dict.fromkeys(tracks.values()) if name]
    more = ", ..." if len(named) > _MOST_NAMED else ""
    which = f" ({', '.join(named[:_MOST_NAMED])}{more})" if named else ""
    tally.note(f"its {len(tracks)} tracks{which} are read as those of one vessel")


def _fixes(
    path: str | os.PathLike[str], lines: Sequence[GpxLine], name: str, tally: Tally
) -> Fixes:
    points = [point for line in lines for point in line.points]
    _check_timed(path, points)
    rows = np.array([point.row for point in points])
    texts = [point.time for point in points]
    time_s = _log_rows.row_times(path, rows, texts, tally, row="point")
    places = _places(path, points, tally)
    known = np.flatnonzero(np.isfinite(time_s) & np.isfinite(places).all(axis=1))
    rows, time_s = rows[known], time_s[known]
    latitude, longitude = places[known].T
    segment = np.repeat(np.arange(len(lines)), [len(line.points) for line in lines])[known]
    placed = _log_rows.on_the_earth(latitude, longitude)
    looked_at = placed & ~repeated(time_s, latitude, longitude)
    kept = np.ones(known.size, dtype=bool)
    begins = np.searchsorted(segment, np.arange(len(lines) + 1))
    for begin, end in itertools.pairwise(begins.tolist()):
        own = begin + np.flatnonzero(looked_at[begin:end])
        kept[own] = _log_rows.timely(path, rows[own], time_s[own], tally, row="point")
    found = Source(time_s, latitude, longitude)
    used = np.flatnonzero(kept & placed)
    kept[used] = _of_one_track(path, lines, segment[used], rows[used], found[used], tally)
    # Programs write the newest track first, or the segments of a pause behind each other.
    order = np.flatnonzero(kept)
    order = order[np.argsort(time_s[order], kind="stable")]
    columns = rows[order], time_s[order], latitude[order], longitude[order]
    texts = [texts[known[i]] for i in order]
    _files.check_digits(path, columns[0], texts, *columns[1:], row="point")
    return _log_rows.fixes(path, *columns, name=name, row="point", tally=tally)


def _of_one_track(
    path: str | os.PathLike[str],
    lines: Sequence[GpxLine],
    segment: IntArray,
    rows: IntArray,
    points: Source,
    tally: Tally,
) -> BoolArray:
    """(N,) bool, which points are used where segments overlap: those of the longest track.

    Args:
        path: The file.
        lines: Segments.
        segment: (N,) which of them a point is in.
        rows: (N,) numbers of the points.
        points: N of them.
        tally: Takes what is left out.

    Raises:
        InputError: Two tracks are of the same times and far apart.
    """
    kept = np.ones(len(points), dtype=bool)
    begins = np.flatnonzero(np.diff(segment, prepend=-1))
    if begins.size < 2:
        return kept
    ends = np.append(begins[1:], len(points)) - 1
    order = np.argsort(points.time_utc_s[begins], kind="stable")
    if (points.time_utc_s[ends][order][:-1] <= points.time_utc_s[begins][order][1:]).all():
        return kept
    lengths = Counter(id(lines[i].track) for i in segment)
    ranked = sorted(
        range(len(lines)), key=lambda i: (-lengths[id(lines[i].track)], -len(lines[i].points))
    )
    used: Source | None = None
    for i in ranked:
        own = np.flatnonzero(segment == i)
        own = own[np.argsort(points.time_utc_s[own], kind="stable")]
        if not own.size:
            continue
        if used is not None:
            within = own[used.covers(points.time_utc_s[own])]
            apart = float(np.median(apart_m(used, points[within]))) if within.size else 0.0
            if within.size >= _FEWEST and _of_another_vessel(used, points[within], apart):
                name = _files.shortened(lines[i].track.name) or f"of point {rows[within[0]]}"
                raise InputError(
                    f"{path}: its track {name} is of the same times as another and {apart:,.0f} m "
                    "from it, as of another vessel; leave the one that is meant in the file"
                )
            if apart > FIT_M:
                kept[within] = False
                row = f"point {rows[within].min()}"
                tally.leave_out(
                    "of a track of the same times as a longer one", within.size, row=row
                )
                own = own[kept[own]]
        used = points[own] if used is None else used.with_fixes_of(points[own])
    return kept


def _of_another_vessel(line: Source, points: Source, apart_m: float) -> bool:
    """Whether points that are so many metres from a track are not on board of one ship with it."""
    if not _BESIDE_M < apart_m <= _SHIP_M:
        return apart_m > _SHIP_M
    varies_m = float(np.median(off_board_m(line, points)))
    return varies_m > max(_KEEPS_M, _KEEPS * apart_m)


def _check_timed(path: str | os.PathLike[str], points: Sequence[GpxPoint]) -> None:
    if not points:
        raise InputError(f"{path}: has no track points")
    if not any(point.time for point in points):
        raise InputError(
            f"{path}: none of its {len(points)} points has a time; a log without times cannot be "
            "matched with a video (was it exported as a route?)"
        )


def _columns(
    path: str | os.PathLike[str], points: Sequence[GpxPoint]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times and places of points, all of which must have them."""
    _check_timed(path, points)
    untimed = [point.row for point in points if not point.time]
    if untimed:
        raise InputError(f"{path}, point {untimed[0]}: has no time")
    try:
        read = read_times([point.time for point in points])
    except NotUnderstoodError as error:
        point = points[error.row]
        raise InputError(
            f"{path}, point {point.row}: {_files.shortened(point.time)} {error.why}"
        ) from error
    places = np.array([[_degrees(point, axis) for axis in (0, 1)] for point in points])
    if np.isinf(places).any():
        raise _unread(path, points, places)
    return read.time_utc_s, places[:, 0], places[:, 1]


def _places(path: str | os.PathLike[str], points: Sequence[GpxPoint], tally: Tally) -> FloatArray:
    """(N, 2) latitude and longitude, not finite where there is none to be read."""
    places = np.array([[_degrees(point, axis) for axis in (0, 1)] for point in points])
    places[[not (point.latitude and point.longitude) for point in points]] = np.nan
    unread = np.isinf(places).any(axis=1)
    missing = ~unread & np.isnan(places).any(axis=1)
    if unread.any() and 2 * unread.sum() >= (~missing).sum():
        raise _unread(path, points, places)
    for which, reason in ((unread, _log_rows.UNREAD_PLACE), (missing, _log_rows.NO_PLACE)):
        if which.any():
            first = points[int(np.argmax(which))]
            text = f"{first.latitude}, {first.longitude}"
            tally.leave_out(reason, int(which.sum()), row=f"point {first.row}", text=text)
    return places


def _unread(
    path: str | os.PathLike[str], points: Sequence[GpxPoint], places: FloatArray
) -> InputError:
    i, axis = np.argwhere(np.isinf(places))[0]
    point = points[i]
    text = (point.latitude, point.longitude)[axis]
    return InputError(
        f"{path}, point {point.row}: {_files.shortened(text) or 'nothing'} is no number "
        f"({('lat', 'lon')[axis]})"
    )


def _degrees(point: GpxPoint, axis: int) -> float:
    """Degrees, infinite where there is no number."""
    text = (point.latitude, point.longitude)[axis]
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return float("inf")
