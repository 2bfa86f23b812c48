"""Tracks as Parquet, through the extra ``sightline[parquet]``."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sightline._optional import module
from sightline.errors import InputError
from sightline.formats import _files, _track_table
from sightline.types import Track

_GEOMETRY = "geometry"
_GEO = {
    "version": "1.1.0",
    "primary_column": _GEOMETRY,
    "columns": {_GEOMETRY: {"encoding": "WKB", "geometry_types": ["Point"]}},
}
_TEXTS = ("label", "kind", "state", "cameras", "name")
_LONGEST_TEXT = 1000
_MOST_ROWS = 20_000_000


@contextmanager
def parquet_track_writer(path: Path, *, fused: bool = False) -> Iterator[ParquetTrackWriter]:
    """Write tracks one at a time, each as a group of rows: GeoParquet 1.1, a point a row.

    Source: https://geoparquet.org/releases/v1.1.0/ (coordinates are OGC:CRS84 unless said).
    """
    arrow = module("pyarrow", "parquet")
    plain = arrow.Schema.from_pandas(_track_table.empty(fused=fused), preserve_index=False)
    described = {**(plain.metadata or {}), b"geo": json.dumps(_GEO).encode()}
    schema = plain.append(arrow.field(_GEOMETRY, arrow.binary())).with_metadata(described)
    with module("pyarrow.parquet", "parquet").ParquetWriter(path, schema) as file:
        yield ParquetTrackWriter(file, plain, schema, fused=fused)


class ParquetTrackWriter:
    """Adds tracks to an open Parquet file; see `parquet_track_writer`."""

    def __init__(self, file: Any, plain: Any, schema: Any, *, fused: bool = False) -> None:
        self._fused = fused
        self._file = file
        self._plain = plain
        self._schema = schema

    def add(self, track: Track) -> None:
        """Write one track."""
        arrow = module("pyarrow", "parquet")
        frame = _track_table.table(track, fused=self._fused)
        rows = arrow.Table.from_pandas(frame, schema=self._plain, preserve_index=False)
        points = arrow.array(_points(frame), arrow.binary())
        columns = [*rows.columns, points]
        self._file.write_table(arrow.Table.from_arrays(columns, schema=self._schema))


def _points(frame: pd.DataFrame) -> list[bytes]:
    """The places of rows as well-known binary: little-endian, type 1, longitude, latitude."""
    made = np.empty(len(frame), [("order", "u1"), ("type", "<u4"), ("xy", "<f8", 2)])
    made["order"], made["type"] = 1, 1
    made["xy"] = frame[["longitude_deg", "latitude_deg"]].to_numpy()
    return [row.tobytes() for row in made]


def read_parquet_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of all tracks in a Parquet file, with ``time_utc_s``.

    Raises:
        InputError: The file is no Parquet or is damaged, a column is missing, holds something else
            than texts, numbers or times, or there are more rows than a table of tracks has.
    """
    arrow = module("pyarrow", "parquet")
    parquet = module("pyarrow.parquet", "parquet")
    reader = _files.existing(path)
    try:
        # Texts stay numbered: one that is long and stands in many rows is not written out.
        with reader.open("rb") as opened:
            names = list(dict.fromkeys(parquet.read_schema(opened).names))
            texts = [name for name in _TEXTS if name in names]
            file = parquet.ParquetFile(opened, read_dictionary=texts)
            known = [name for name in names if name in _track_table.KNOWN]
            missing = [name for name in _track_table.REQUIRED if name not in known]
            if missing:
                raise _track_table.lacks(path, missing, names)
            _check(path, arrow, file, known)
            table = file.read(columns=known)
        # What pandas once wrote of itself into the file says nothing here, and may be damaged.
        rows = _decoded(table.replace_schema_metadata(None), arrow).to_pandas()
    except (
        arrow.ArrowException,
        *(OSError, ValueError, TypeError, LookupError, OverflowError, AttributeError),
    ) as error:
        raise InputError(f"{path}: is no Parquet file, is damaged, or is cut short") from error
    return _track_table.with_posix_times(path, rows)


def _check(path: str | os.PathLike[str], arrow: Any, file: Any, known: list[str]) -> None:
    """Raise InputError for what no table of tracks has, before it is unpacked."""
    if file.metadata.num_rows > _MOST_ROWS:
        raise InputError(
            f"{path}: says that it has {file.metadata.num_rows:,} rows; at most {_MOST_ROWS:,} can "
            "be read as tracks"
        )
    kinds = arrow.types
    for name in known:
        kind = file.schema_arrow.field(name).type
        if kinds.is_dictionary(kind):
            kind = kind.value_type
        text = kinds.is_string(kind) or kinds.is_large_string(kind)
        if not (text or kinds.is_primitive(kind) or kinds.is_null(kind)):
            raise InputError(f"{path}: its {name} are {kind}, no texts and no numbers")


def _decoded(table: Any, arrow: Any) -> Any:
    """The table with its numbered texts written out, each cut to the longest that is shown."""
    for i, name in enumerate(table.column_names):
        column = table.column(i)
        if arrow.types.is_dictionary(column.type):
            chunks = []
            for chunk in column.chunks:
                texts = [str(text.as_py() or "")[:_LONGEST_TEXT] for text in chunk.dictionary]
                chunks.append(arrow.DictionaryArray.from_arrays(chunk.indices, arrow.array(texts)))
            written = arrow.chunked_array(chunks or [arrow.array([], arrow.string())])
            table = table.set_column(i, name, written.cast(arrow.string()))
    return table
