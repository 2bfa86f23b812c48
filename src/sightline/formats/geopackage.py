"""Tracks as a GeoPackage for QGIS, through the extra ``sightline[geopackage]``."""

from __future__ import annotations

import errno
import os
import sqlite3
import warnings
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


@contextmanager
def geopackage_track_writer(path: Path) -> Iterator[GeoPackageTrackWriter]:
    """Write tracks one at a time, a point feature a point, in the layer ``tracks``."""
    # The driver makes its own file and does not take an empty one for it.
    path.unlink()
    writer = GeoPackageTrackWriter(path)
    yield writer
    writer.flush()
    writer.check()


class GeoPackageTrackWriter:
    """Adds tracks to a GeoPackage; see `geopackage_track_writer`."""

    def __init__(self, path: Path) -> None:
        self._geopandas = module("geopandas", "geopackage")
        self._path = path
        self._waiting = [_track_table.empty()]
        self._rows = self._written = 0

    def add(self, track: Track) -> None:
        """Add one track; it is written with others, since each write is a transaction."""
        self._waiting.append(_track_table.table(track))
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

    Raises:
        InputError: The file is no GeoPackage, has no such layer, or a column is missing.
    """
    geopandas = module("geopandas", "geopackage")
    errors = module("pyogrio.errors", "geopackage")
    file = _files.existing(path)
    try:
        with warnings.catch_warnings():
            # What GDAL finds odd in a file that it can read is of no use to anybody here.
            warnings.simplefilter("ignore", RuntimeWarning)
            rows = geopandas.read_file(file, layer=_LAYER, engine="pyogrio")
    except (errors.DataSourceError, errors.DataLayerError) as error:
        raise InputError(f"{path}: is no GeoPackage with a layer {_LAYER!r} ({error})") from error
    return _track_table.with_posix_times(path, pd.DataFrame(rows.drop(columns="geometry")))
