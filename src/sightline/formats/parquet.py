"""Tracks as Parquet, through the extra ``sightline[parquet]``."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

from sightline._optional import module
from sightline.errors import InputError
from sightline.formats import _files, _track_table
from sightline.types import Track


@contextmanager
def parquet_track_writer(path: Path) -> Iterator[ParquetTrackWriter]:
    """Write tracks one at a time, each as a group of rows."""
    arrow = module("pyarrow", "parquet")
    schema = arrow.Schema.from_pandas(_track_table.empty(), preserve_index=False)
    with module("pyarrow.parquet", "parquet").ParquetWriter(path, schema) as file:
        yield ParquetTrackWriter(file, schema)


class ParquetTrackWriter:
    """Adds tracks to an open Parquet file; see `parquet_track_writer`."""

    def __init__(self, file: Any, schema: Any) -> None:
        self._file = file
        self._schema = schema

    def add(self, track: Track) -> None:
        """Write one track."""
        rows = module("pyarrow", "parquet").Table.from_pandas(
            _track_table.table(track), schema=self._schema, preserve_index=False
        )
        self._file.write_table(rows)


def read_parquet_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of all tracks in a Parquet file, with ``time_utc_s``.

    Raises:
        InputError: The file is no Parquet, or a column is missing.
    """
    arrow = module("pyarrow", "parquet")
    file = _files.existing(path)
    try:
        rows = module("pyarrow.parquet", "parquet").read_table(file).to_pandas()
    except (arrow.ArrowInvalid, OSError) as error:
        raise InputError(f"{path}: is no Parquet file, is damaged, or is cut short") from error
    return _track_table.with_posix_times(path, rows)
