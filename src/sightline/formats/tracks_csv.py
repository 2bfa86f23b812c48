"""Tracks as CSV: every column, for a spreadsheet or pandas."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import pandas as pd

from sightline.formats import _files, _track_table
from sightline.text import cell_text, text_of_cell
from sightline.types import Track


@contextmanager
def csv_track_writer(path: Path, *, fused: bool = False) -> Iterator[CsvTrackWriter]:
    """Write tracks one at a time, a row a point."""
    with path.open("w", encoding="utf-8", newline="") as file:
        yield CsvTrackWriter(file, fused=fused)


class CsvTrackWriter:
    """Adds tracks to an open CSV file; see `csv_track_writer`.

    A label that a spreadsheet would take for a formula is written as a text; see `cell_text`.
    """

    def __init__(self, file: TextIO, *, fused: bool = False) -> None:
        self._writer = csv.writer(file, lineterminator=os.linesep)
        self._fused = fused
        _track_table.empty(fused=fused).to_csv(file, index=False)

    def add(self, track: Track) -> None:
        """Write one track."""
        # A table of pandas takes longer than the columns that are in it.
        content = {
            "track_id": [track.track_id] * len(track),
            "time_utc": _files.rfc3339(track.time_utc_s).tolist(),
            "label": [cell_text(track.label)] * len(track),
        }
        for name, column in _track_table.columns(track).items():
            content[name] = ["" if value != value else value for value in column.tolist()]
        names: tuple[str, ...] = _track_table.COLUMNS
        if self._fused:
            names = _track_table.KNOWN
            more = _track_table.fused_columns(track)
            content["cameras"] = [cell_text(cell) for cell in more["cameras"]]
            content["mmsi"] = ["" if track.mmsi is None else track.mmsi] * len(track)
            content["name"] = [cell_text(cell) for cell in more["name"]]
        rows = [content[name] for name in names]
        self._writer.writerows(zip(*rows, strict=True))


def read_csv_table(path: str | os.PathLike[str]) -> pd.DataFrame:
    """The points of all tracks in a CSV file, with ``time_utc_s``.

    Raises:
        InputError: A column is missing, or a cell cannot be understood.
    """
    (rows,) = _files.table(
        path, required=_track_table.REQUIRED, text=("label", "kind", "state", "cameras", "name")
    )
    rows["time_utc_s"] = _files.times(path, rows["time_utc"])
    rows["track_id"] = _files.whole_numbers(path, rows["track_id"])
    for name in ("latitude_deg", "longitude_deg"):
        rows[name] = _files.numbers(path, rows[name])
    for name in {"label", "cameras", "name"} & set(rows.columns):
        rows[name] = rows[name].map(text_of_cell, na_action="ignore")
    return rows
