"""Tracks as a GeoPackage for QGIS, through the extra ``sightline[geopackage]``."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pandas as pd

from sightline._optional import module
from sightline.errors import InputError
from sightline.formats import _files, _track_table
from sightline.types import Track

_LAYER = "tracks"
_ROWS_AT_ONCE = 50_000
_MOST_TEXT = 120
_MAGIC = b"SQLite format 3\0"
_LONGEST_CELL = 1_000_000
# Pages of a damaged file may lead to one another without an end.
_LEAST_ROW_BYTES = 4


@contextmanager
def geopackage_track_writer(path: Path, *, fused: bool = False) -> Iterator[GeoPackageTrackWriter]:
    """Write tracks one at a time, a point feature a point, in the layer ``tracks``."""
    # The driver makes its own file and does not take an empty one for it.
    path.unlink()
    writer = GeoPackageTrackWriter(path, fused=fused)
    yield writer
    writer.flush()
    writer.check()


class GeoPackageTrackWriter:
    """Adds tracks to a GeoPackage; see `geopackage_track_writer`."""

    def __init__(self, path: Path, *, fused: bool = False) -> None:
        self._geopandas = module("geopandas", "geopackage")
        self._path = path
        self._fused = fused
        self._waiting = [_track_table.empty(fused=fused)]
        self._rows = self._written = 0

    def add(self, track: Track) -> None:
        """Add one track; it is written with others, since each write is a transaction."""
        rows = _track_table.table(track, fused=self._fused)
        # A text ends at a zero there.
        for name in {"label", "name"} & set(rows.columns):
            rows[name] = rows[name].str.replace("\0", "\ufffd")
        self._waiting.append(rows)
        self._rows += len(track)
        if self._rows >= _ROWS_AT_ONCE:
            self.flush()

    def flush(self) -> None:
        """Write what is waiting."""
        rows = pd.concat([part for part in self._waiting if len(part)] or self._waiting)
        self._written += len(rows)
        self._waiting, self._rows = [], 0
        frame = self._geopandas.GeoDataFrame(
            rows,
            geometry=self._geopandas.points_from_xy(rows["longitude_deg"], rows["latitude_deg"]),
            crs="EPSG:4326",
        )
        mode = "a" if self._path.exists() else "w"
        errors = module("pyogrio.errors", "geopackage")
        try:
            frame.to_file(
                self._path,
                layer=_LAYER,
                driver="GPKG",
                mode=mode,
                geometry_type="Point",
                engine="pyogrio",
            )
        except (errors.DataSourceError, errors.DataLayerError) as error:
            # What the system said, as of a full disk, is in SQLite's words, which are long.
            raise _not_written(f"SQLite: {error}") from error

    def check(self) -> None:
        """Raise where points or their index are missing: on a full disk GDAL leaves them out.

        Raises:
            OSError: They are.
        """
        try:
            with closing(sqlite3.connect(self._path)) as file:
                tables = (_LAYER, f"rtree_{_LAYER}_geom") if self._written else (_LAYER,)
                counts = [
                    file.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0]  # noqa: S608
                    for table in tables
                ]
        except sqlite3.Error as error:
            raise _not_written(f"SQLite: {error}") from error
        if any(count != self._written for count in counts):
            raise _not_written(f"{min(counts)} of {self._written} points are in it")


def _not_written(reason: str) -> OSError:
    text = _files.shortened(" ".join(reason.split()), _MOST_TEXT)
    return OSError(errno.EIO, f"is the disk full? ({text})")


def read_geopackage_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of the layer ``tracks`` of a GeoPackage, with ``time_utc_s``.

    A GeoPackage is an SQLite database, and is read as one: GDAL guesses what a file is by what is
    in it, and would follow an address in a file that only has a GeoPackage's name.

    Raises:
        InputError: The file is no GeoPackage, has no such layer, or a column is missing.
    """
    file = _files.existing(path)
    with file.open("rb") as beginning:
        if beginning.read(len(_MAGIC)) != _MAGIC:
            raise InputError(f"{path}: is no GeoPackage, which is an SQLite database")
    # Another program that has it open keeps its last changes beside it.
    alone = not os.path.exists(f"{file}-wal")
    address = f"{file.absolute().as_uri()}?mode=ro" + ("&immutable=1" if alone else "")
    try:
        with closing(sqlite3.connect(address, uri=True)) as database:
            rows = _rows(path, database, file.stat().st_size // _LEAST_ROW_BYTES)
    except (sqlite3.Error, sqlite3.Warning, UnicodeError, OverflowError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path}: is no GeoPackage, is damaged, or is cut short ({reason})"
        ) from error
    return _track_table.with_posix_times(path, rows)


def _rows(
    path: str | os.PathLike[str], database: sqlite3.Connection, most_rows: int
) -> pd.DataFrame:
    """The rows of the layer, of which nothing is computed by what stands in the file."""
    database.execute("PRAGMA trusted_schema=OFF")
    database.execute("PRAGMA cell_size_check=ON")
    database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LONGEST_CELL)
    layers = dict(
        database.execute("SELECT name, type || ' ' || ifnull(sql, '') FROM sqlite_schema")
    )
    definition = layers.get(_LAYER, "")
    if not definition.startswith("table CREATE TABLE"):
        raise InputError(f"{path}: is no GeoPackage with a layer {_LAYER!r}")
    columns = [name for _, name, *_ in database.execute(f"PRAGMA table_info({_LAYER})")]
    known = [name for name in columns if name in _track_table.KNOWN]
    missing = [name for name in _track_table.REQUIRED if name not in known]
    if missing:
        raise _track_table.lacks(path, missing, columns)
    database.set_authorizer(_reading_alone)
    cursor = database.execute(f"SELECT {', '.join(known)} FROM {_LAYER}")  # noqa: S608 - names of ours
    rows = cursor.fetchmany(most_rows + 1)
    if len(rows) > most_rows:
        raise sqlite3.DatabaseError("it has more rows than fit into it")
    return pd.DataFrame(rows, columns=known, dtype=object)


def _reading_alone(action: int, *_: object) -> int:
    """Whether SQLite may do something: read tables, and nothing else."""
    reading = (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
    return sqlite3.SQLITE_OK if action in reading else sqlite3.SQLITE_DENY
