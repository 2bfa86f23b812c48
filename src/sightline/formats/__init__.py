"""Files that hold fixes, boxes, clocks and tracks: one module a format.

A file's ending picks its format, except for logs, where what is in the file decides.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import pandas as pd

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files, _track_table
from sightline.formats._json_logs import coco_refusal, is_coco, is_json
from sightline.formats._log_table import is_log_table, is_vessel_table
from sightline.formats.ais import (
    AisReport,
    AisStream,
    AisVessel,
    read_ais,
    read_ais_dimensions,
    read_ais_feed,
    read_ais_vessel,
)
from sightline.formats.area_geojson import read_area, read_lines, read_zones
from sightline.formats.boxes_csv import csv_box_writer, iter_boxes_csv, write_boxes_csv
from sightline.formats.clock_csv import read_clock
from sightline.formats.control_points import read_control_points
from sightline.formats.fixes_csv import read_fixes_csv, read_fixes_json, write_fixes_csv
from sightline.formats.geojson import geojson_track_writer, read_geojson_table
from sightline.formats.geopackage import geopackage_track_writer, read_geopackage_table
from sightline.formats.gpx import gpx_track_writer, read_gpx, read_gpx_table, write_gpx
from sightline.formats.headings import read_headings
from sightline.formats.horizons_csv import read_horizons_csv
from sightline.formats.kml import kml_track_writer
from sightline.formats.mfjson import mfjson_track_writer
from sightline.formats.mot import iter_mot, mot_box_writer, write_mot
from sightline.formats.nmea import read_nmea
from sightline.formats.otvision import iter_otvision
from sightline.formats.parquet import parquet_track_writer, read_parquet_table
from sightline.formats.track_logs import holds_tracks, track_logs
from sightline.formats.tracks_csv import csv_track_writer, read_csv_table
from sightline.formats.water_levels import read_water_levels
from sightline.geodesy import LocalPlane
from sightline.tally import Tally
from sightline.types import Boxes, Fixes, Track

__all__ = [
    "AisReport",
    "AisStream",
    "AisVessel",
    "BoxWriter",
    "TrackWriter",
    "atomic_path",
    "box_writer",
    "holds_ais",
    "holds_tracks",
    "is_log_table",
    "iter_boxes",
    "read_ais",
    "read_ais_dimensions",
    "read_ais_feed",
    "read_area",
    "read_boxes",
    "read_clock",
    "read_control_points",
    "read_fixes",
    "read_headings",
    "read_horizons_csv",
    "read_lines",
    "read_track_logs",
    "read_tracks",
    "read_water_levels",
    "read_zones",
    "track_table",
    "track_writer",
    "write_boxes",
    "write_fixes",
    "write_tracks",
]

T = TypeVar("T")

_CHUNK_ROWS = 100_000
_AIS = re.compile(r"![A-Z][A-Z0-9]VD[MO],\d")
_PLACE = re.compile(r"\$(?!P)[A-Z][A-Z0-9](?:RMC|GGA|GNS|GLL),")
_NMEA = re.compile(r"[$!](?!P)[A-Z][A-Z0-9][A-Z]{3},")


class TrackWriter(Protocol):
    """What takes tracks for a file, one at a time."""

    def add(self, track: Track) -> None:
        """Write a track, or keep it until the file is complete where its format wants that."""
        ...


class BoxWriter(Protocol):
    """What takes boxes for a file, some at a time."""

    def add(self, boxes: Boxes) -> None:
        """Write boxes."""
        ...


_WRITERS: dict[str, Callable[[Path], AbstractContextManager[TrackWriter]]] = {
    ".geojson": geojson_track_writer,
    ".gpx": gpx_track_writer,
    ".kml": kml_track_writer,
    ".csv": csv_track_writer,
    ".parquet": parquet_track_writer,
    ".gpkg": geopackage_track_writer,
    ".mfjson": mfjson_track_writer,
}
_FUSED_WRITERS: dict[str, Callable[[Path], AbstractContextManager[TrackWriter]]] = {
    **_WRITERS,
    ".geojson": partial(geojson_track_writer, fused=True),
    ".csv": partial(csv_track_writer, fused=True),
    ".parquet": partial(parquet_track_writer, fused=True),
    ".gpkg": partial(geopackage_track_writer, fused=True),
}
_READERS: dict[str, Callable[[str | os.PathLike[str]], pd.DataFrame]] = {
    ".geojson": read_geojson_table,
    ".gpx": read_gpx_table,
    ".csv": read_csv_table,
    ".parquet": read_parquet_table,
    ".gpkg": read_geopackage_table,
}
_BOX_READERS = {
    ".csv": iter_boxes_csv,
    ".txt": iter_mot,
    ".otdet": iter_otvision,
    ".ottrk": iter_otvision,
}
_BOX_WRITERS = {".csv": write_boxes_csv, ".txt": write_mot}
_BOX_APPENDERS: dict[str, Callable[[Path], AbstractContextManager[BoxWriter]]] = {
    ".csv": csv_box_writer,
    ".txt": mot_box_writer,
}
_FIX_WRITERS = {".csv": write_fixes_csv, ".gpx": write_gpx}


def _by_suffix(path: str | os.PathLike[str], known: dict[str, T], what: str) -> T:
    suffix = Path(path).suffix.lower()
    if suffix not in known:
        raise InputError(
            f"{path}: no format of {what} ends in {suffix or 'nothing'!r}; known are "
            f"{', '.join(known)}"
        )
    return known[suffix]


def read_fixes(
    path: str | os.PathLike[str], *, mmsi: int | None = None, tally: Tally | None = None
) -> Fixes:
    """The log of one vessel or vehicle: GPX, KML, TCX, NMEA 0183, AIS, CSV or JSON.

    What is in the file decides: XML is GPX, KML or TCX; ``$..RMC``, ``GGA``, ``GNS`` and ``GLL``
    sentences are the log of a receiver on board; ``!..VDM`` sentences are AIS; a table needs the
    columns ``time_utc,latitude_deg,longitude_deg``, or what other programs call them, and is AIS
    where it has a column ``mmsi`` as well; JSON is of gpsd, of Signal K, GeoJSON with times, or
    objects with a time and a place. A log with both kinds of sentences is read as AIS if an MMSI is
    given. Fixes that cannot be true are left out and counted; see `sightline.plausibility`.

    Args:
        path: The file.
        mmsi: Which vessel of an AIS log; needed where it holds several.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: The file is missing, empty, damaged or of no known kind; has no times, times
            that decrease or places off the earth; or several vessels and none is chosen.
    """
    head = _files.beginning(path)
    sentences = bool(_NMEA.search(head))
    # A log of many hours may begin with the receiver on board, and come to others later.
    if sentences and (mmsi is not None or _only_ais(head)):
        return read_ais_vessel(path, mmsi, tally=tally)
    if not sentences and is_vessel_table(head):
        return read_ais_vessel(path, mmsi, tally=tally)
    if mmsi is not None:
        raise InputError(
            f"{path}: holds no AIS sentence and no column mmsi, so no vessel can be chosen by its "
            "MMSI"
        )
    if sentences:
        return read_nmea(path, tally=tally)
    if head.lstrip("\ufeff \t\r\n").startswith("<") or Path(path).suffix.lower() == ".gpx":
        return read_gpx(path, tally=tally)
    if is_json(head):
        return read_fixes_json(path, tally=tally)
    if Path(path).suffix.lower() == ".csv" or is_log_table(head):
        return read_fixes_csv(path, tally=tally)
    raise InputError(
        f"{path}: is no log that is known; expected GPX, KML, NMEA 0183 (RMC, GGA, GNS or GLL), "
        "AIS (!AIVDM), JSON or a table with time_utc,latitude_deg,longitude_deg"
    )


def holds_ais(path: str | os.PathLike[str]) -> bool:
    """Whether a log is one of AIS, as sentences or as a table with MMSIs, and of none on board.

    Raises:
        InputError: The file is missing or cannot be read.
    """
    head = _files.beginning(path)
    return _only_ais(head) or (not _NMEA.search(head) and is_vessel_table(head))


def _only_ais(head: str) -> bool:
    return bool(_AIS.search(head)) and not _PLACE.search(head)


def write_fixes(fixes: Fixes, path: str | os.PathLike[str]) -> None:
    """Write a log as GPX or CSV, by the file's ending.

    Raises:
        InputError: The ending is unknown, or the file cannot be written.
    """
    _by_suffix(path, _FIX_WRITERS, "logs")(fixes, path)


def read_boxes(
    path: str | os.PathLike[str],
    *,
    source: str | None = None,
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Boxes:
    """All boxes of a file: a CSV table, MOTChallenge (``.txt``), or OTVision's.

    Args:
        path: The file; for its columns see `sightline.formats.boxes_csv`, `.mot` and `.otvision`.
        source: The source of boxes that name none; None: ``""``.
        skip_empty: Leave out rows whose box has no width or height or no number, as some
            detectors and trackers put them out, and count them, rather than refuse the file.
        image_size_px: Width and height of the picture, for boxes in shares of it (0 to 1), which
            are refused without it.
        tally: Counts rows and boxes, and what is left out; None: a warning tells of it.

    Raises:
        InputError: The file cannot be used, or none of its rows; names the line.
    """
    chunks = iter_boxes(
        path, source=source, skip_empty=skip_empty, image_size_px=image_size_px, tally=tally
    )
    return Boxes.concatenate(list(chunks))


def iter_boxes(
    path: str | os.PathLike[str],
    chunk_rows: int = _CHUNK_ROWS,
    *,
    source: str | None = None,
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Iterator[Boxes]:
    """The boxes of a file in chunks, at a memory that does not grow with its length.

    Args:
        path: As for `read_boxes`.
        chunk_rows: Most rows in a chunk.
        source: As for `read_boxes`.
        skip_empty: As for `read_boxes`.
        image_size_px: As for `read_boxes`.
        tally: As for `read_boxes`.

    Raises:
        InputError: The file cannot be used; names the line.
    """
    _refuse_other_boxes(path)
    return _by_suffix(path, _BOX_READERS, "boxes")(
        path,
        chunk_rows,
        source=source or "",
        skip_empty=skip_empty,
        image_size_px=image_size_px,
        tally=tally,
    )


def _refuse_other_boxes(path: str | os.PathLike[str]) -> None:
    """Raise an error that names what is no table of boxes, and what would make it one."""
    if Path(path).is_dir():
        texts = [one for one in Path(path).iterdir() if one.suffix.lower() == ".txt"]
        if texts:
            raise InputError(
                f"{path}: is a folder of {len(texts)} .txt files, as YOLO writes labels; put them "
                "into one table with the header frame,class_id,xc,yc,w,h (and conf, track_id), the "
                "frame from each file's name"
            )
    elif Path(path).suffix.lower() == ".json" and is_coco(_files.beginning(path)):
        raise coco_refusal(path)


def write_boxes(boxes: Boxes, path: str | os.PathLike[str]) -> None:
    """Write boxes as CSV or MOTChallenge (``.txt``), by the file's ending.

    Raises:
        InputError: The ending is unknown, or the file cannot be written.
    """
    _by_suffix(path, _BOX_WRITERS, "boxes")(boxes, path)


@contextmanager
def box_writer(path: str | os.PathLike[str]) -> Iterator[BoxWriter]:
    """Write boxes as they are found, at constant memory; the file appears when the block ends well.

    Args:
        path: Ends in .csv or .txt (MOTChallenge).

    Raises:
        InputError: The ending is unknown, or the file cannot be written.
    """
    opened = _by_suffix(path, _BOX_APPENDERS, "boxes")
    with atomic_path(path) as temporary, opened(temporary) as writer:
        yield writer


@contextmanager
def track_writer(path: str | os.PathLike[str], *, fused: bool = False) -> Iterator[TrackWriter]:
    """Write tracks as they are finished; the file appears when the block ends well.

    Tracks are written one by one, at a memory that does not grow with their number.

    Args:
        path: Ends in .geojson, .gpx, .kml, .csv, .mfjson, .parquet or .gpkg; the last two need the
            extras ``sightline[parquet]`` and ``sightline[geopackage]``.
        fused: Whether tables and GeoJSON say too which cameras saw a target at each point, and its
            MMSI and name.

    Raises:
        InputError: The ending is unknown, an extra is missing, or the file cannot be written.
    """
    opened = _by_suffix(path, _FUSED_WRITERS if fused else _WRITERS, "tracks")
    with atomic_path(path) as temporary, opened(temporary) as writer:
        yield writer


def write_tracks(
    tracks: Iterable[Track], path: str | os.PathLike[str], *, fused: bool = False
) -> None:
    """Write tracks in the format that the file's ending names; see `track_writer`."""
    with track_writer(path, fused=fused) as writer:
        for track in tracks:
            writer.add(track)


def track_table(tracks: Iterable[Track]) -> pd.DataFrame:
    """Tracks as one table, a row a point: the columns of the CSV, Parquet and GeoPackage files.

    ``time_utc`` is a time stamp in UTC, in milliseconds; ``kind`` is measured, interpolated or
    extrapolated; the ellipse holds the true position with 95 %.
    """
    tables = [_track_table.table(track) for track in tracks if len(track)]
    return pd.concat(tables or [_track_table.empty()], ignore_index=True)


def read_tracks(
    path: str | os.PathLike[str], *, plane: LocalPlane | None = None, tally: Tally | None = None
) -> tuple[Track, ...]:
    """The tracks of a GeoJSON, GPX, CSV, Parquet or GeoPackage file.

    Files of others will do where they have the columns (properties) ``track_id``, ``time_utc``
    (``time``) and the place. Velocities that a file does not give are differences of places;
    covariances that it does not give are NaN.

    Args:
        path: The file.
        plane: The plane of the tracks; None: one that touches the earth at the first point.
        tally: Counts tracks and points.

    Raises:
        InputError: The ending is unknown, or the file cannot be used.
    """
    found = _track_table.tracks(path, _by_suffix(path, _READERS, "tracks")(path), plane)
    if tally is not None:
        tally.format = f"tracks ({Path(path).suffix[1:].lower()})"
        tally.count("tracks", len(found))
        tally.count("points", sum(len(track) for track in found))
    return found


def read_track_logs(
    path: str | os.PathLike[str], *, tally: Tally | None = None
) -> tuple[AisVessel, ...]:
    """The logs that tracks of other cameras are to one that has none, one a target that moves.

    Raises:
        InputError: As `read_tracks`, a track does not say how unsure it is, or none moves.
    """
    return track_logs(path, read_tracks(path, tally=tally))
