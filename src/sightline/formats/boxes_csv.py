"""Boxes as tables: ``frame,x1,y1,x2,y2`` and what else is known of them."""

from __future__ import annotations

import csv
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np
import pandas as pd

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._box_table import iter_box_table, refuse_empty
from sightline.tally import Tally
from sightline.text import cell_text, text_of_cell
from sightline.types import NO_FRAME, NO_TRACK, BoolArray, Boxes

_CORNERS = ("x1", "y1", "x2", "y2")


def iter_boxes_csv(
    path: str | os.PathLike[str],
    chunk_rows: int,
    *,
    source: str = "",
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Iterator[Boxes]:
    """Boxes of a CSV file in chunks, in the order of the file, at constant memory.

    Columns: ``x1,y1,x2,y2`` in pixels; ``frame`` or ``time_utc`` or both; and optionally
    ``confidence`` (0 to 1; 1 where absent), ``annotator`` (who made the box, its source),
    ``track_id``, ``label`` and ``target``; rows whose ``target`` is 0 are of another boat than the
    logged one, and are left out. Several boxes in a frame, even the same twice, are kept.

    Tables of trackers are read as they are: cells apart by semicolons, tabs or spaces, decimal
    commas, usual other names of columns (``x_min``, ``left``, ``bb_left``, ``score``,
    ``tracker_id``), a corner or the centre with width and height, percents, and rows without a
    header, which are of MOTChallenge's form. What was assumed is told; a column that is not used is
    named.

    Args:
        path: The file.
        chunk_rows: Most rows in a chunk.
        source: The source of boxes that name no annotator.
        skip_empty: Leave out rows whose box has no width or height or no number, as some
            detectors put them out, and count them, rather than refuse the file.
        image_size_px: Width and height of the picture, for boxes in shares of it (0 to 1), which
            are refused without it.
        tally: Counts rows and boxes, and what is left out.

    Returns:
        Tables of boxes.

    Raises:
        InputError: A column is missing, a row holds no box, or none of the rows is of use; names
            file and line.
    """
    return iter_box_table(
        path,
        chunk_rows,
        source=source,
        skip_empty=skip_empty,
        image_size_px=image_size_px,
        tally=tally,
    )


def targets(path: str | os.PathLike[str], rows: pd.DataFrame) -> BoolArray:
    """(N,) bool, which rows of a table with the column ``target`` are of what is looked for.

    Raises:
        InputError: A cell is neither 0 nor 1 nor empty; an empty one is 1.
    """
    flag = _files.whole_numbers(path, rows["target"].fillna(1))
    _files.refuse(path, rows.index, ~np.isin(flag, (0, 1)), flag, "is no target; give 1 or 0")
    return np.asarray(flag == 1)


def boxes_of_rows(path: str | os.PathLike[str], rows: pd.DataFrame) -> Boxes:
    """Boxes of the rows of a table of labels, whose index is the line."""
    xyxy = np.column_stack([_files.numbers(path, rows[name]) for name in _CORNERS])
    refuse_empty(path, rows.index, xyxy)
    frame = time = confidence = track = None
    if "frame" in rows:
        frame = _files.whole_numbers(path, rows["frame"])
        _files.refuse(path, rows.index, frame < 0, frame, "is no frame; frames count from 0")
    if "time_utc" in rows:
        # A frame tells the time as well, so then a cell may be empty.
        time = _files.times(path, rows["time_utc"], missing_allowed=frame is not None)
    if "confidence" in rows:
        confidence = _files.numbers(path, rows["confidence"].fillna(1.0))
        outside = (confidence < 0.0) | (confidence > 1.0)
        _files.refuse(path, rows.index, outside, confidence, "is no confidence between 0 and 1")
    if "track_id" in rows:
        track = _files.whole_numbers(path, rows["track_id"].fillna(NO_TRACK))
    return Boxes.of(
        xyxy,
        frame=frame,
        time_utc_s=time,
        confidence=confidence,
        source=_text(rows, "annotator"),
        track_id=track,
        label=_text(rows, "label"),
    )


def _text(rows: pd.DataFrame, column: str) -> list[str] | str:
    if column not in rows:
        return ""
    return [text_of_cell(cell) for cell in rows[column].fillna("").astype(str).str.strip()]


def write_boxes_csv(boxes: Boxes, path: str | os.PathLike[str]) -> None:
    """Write boxes that `iter_boxes_csv` reads; columns that say nothing are left out.

    Raises:
        InputError: The file cannot be written, or neither all frames nor all times are known.
    """
    columns = columns_of(boxes, path)
    with atomic_path(path) as temporary:
        pd.DataFrame(columns).to_csv(temporary, index=False)


def columns_of(boxes: Boxes, path: str | os.PathLike[str]) -> dict[str, object]:
    """The columns that `write_boxes_csv` writes to a file.

    Raises:
        InputError: Neither all frames nor all times are known.
    """
    columns: dict[str, object] = {}
    framed, timed = boxes.frame != NO_FRAME, np.isfinite(boxes.time_utc_s)
    if not framed.all() and not timed.all():
        raise InputError(f"{path}: every box needs a frame, or every box a time, to be written")
    if framed.all():
        columns["frame"] = boxes.frame
    columns |= {name: boxes.xyxy_px[:, i] for i, name in enumerate(_CORNERS)}
    columns["confidence"] = boxes.confidence
    if (boxes.source != "").any():
        columns["annotator"] = [cell_text(text) for text in boxes.source.tolist()]
    if timed.any():
        stamps = pd.Series(index=range(len(boxes)), dtype=object)
        stamps[timed] = _files.rfc3339(boxes.time_utc_s[timed])
        columns["time_utc"] = stamps
    if (boxes.track_id != NO_TRACK).any():
        columns["track_id"] = boxes.track_id
    if (boxes.label != "").any():
        columns["label"] = [cell_text(text) for text in boxes.label.tolist()]
    return columns


@contextmanager
def csv_box_writer(path: Path) -> Iterator[CsvBoxWriter]:
    """Write boxes as they are found."""
    with path.open("w", encoding="utf-8", newline="") as file:
        yield CsvBoxWriter(file)


class CsvBoxWriter:
    """Adds boxes to an open CSV file; see `csv_box_writer`.

    All columns are written, since nobody knows yet what the boxes to come will tell; what is not
    known is an empty cell.
    """

    def __init__(self, file: TextIO) -> None:
        # A table of pandas for the few boxes of a frame takes longer than finding some of them.
        self._writer = csv.writer(file, lineterminator="\n")
        self._writer.writerow(["frame", *_CORNERS, "confidence", "annotator", "label", "time_utc"])

    def add(self, boxes: Boxes) -> None:
        """Write boxes, all of which have a frame."""
        if (boxes.frame == NO_FRAME).any():
            raise InputError("boxes that are written as they are found need their frames")
        stamps = np.full(len(boxes), "", dtype="U24")
        timed = np.isfinite(boxes.time_utc_s)
        if timed.any():
            stamps[timed] = _files.rfc3339(boxes.time_utc_s[timed])
        # A hundredth of a pixel is finer than any detector.
        self._writer.writerows(
            zip(
                boxes.frame.tolist(),
                *boxes.xyxy_px.T.round(2).tolist(),
                boxes.confidence.round(4).tolist(),
                [cell_text(text) for text in boxes.source.tolist()],
                [cell_text(text) for text in boxes.label.tolist()],
                stamps.tolist(),
                strict=True,
            )
        )
