"""Boxes as tables: ``frame,x1,y1,x2,y2`` and what else is known of them."""

from __future__ import annotations

import csv
import logging
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
from sightline.types import NO_FRAME, NO_TRACK, BoolArray, Boxes, FloatArray

_logger = logging.getLogger(__name__)

_CORNERS = ("x1", "y1", "x2", "y2")
_OPTIONAL = ("frame", "time_utc", "confidence", "annotator", "track_id", "label", "target")


def iter_boxes_csv(
    path: str | os.PathLike[str], chunk_rows: int, *, source: str = "", skip_empty: bool = False
) -> Iterator[Boxes]:
    """Boxes of a CSV file in chunks, in the order of the file, at constant memory.

    Columns: ``x1,y1,x2,y2`` in pixels; ``frame`` or ``time_utc`` or both; and optionally
    ``confidence`` (0 to 1; 1 where absent), ``annotator`` (who made the box, its source),
    ``track_id``, ``label`` and ``target``; rows whose ``target`` is 0 are of another boat than the
    logged one, and are left out. Several boxes in a frame, even the same twice, are kept.

    Args:
        path: The file.
        chunk_rows: Most rows in a chunk.
        source: The source of boxes that name no annotator.
        skip_empty: Leave out boxes without width or height, which some detectors put out, and
            log a warning that says how many, rather than refuse the file.

    Yields:
        Tables of boxes.

    Raises:
        InputError: A column is missing or unknown, or a row holds no box; names file and line.
    """
    for rows in _files.table(
        path,
        required=_CORNERS,
        optional=_OPTIONAL,
        text=("annotator", "label"),
        chunk_rows=chunk_rows,
    ):
        if "frame" not in rows and "time_utc" not in rows:
            raise InputError(
                f"{path}: lacks the column frame (or time_utc); found {', '.join(rows.columns)}"
            )
        if "target" in rows:
            rows = rows[targets(path, rows)]
        yield boxes_of_rows(path, rows, source, skip_empty)


def targets(path: str | os.PathLike[str], rows: pd.DataFrame) -> BoolArray:
    """(N,) bool, which rows of a table with the column ``target`` are of what is looked for.

    Raises:
        InputError: A cell is neither 0 nor 1 nor empty; an empty one is 1.
    """
    flag = _files.whole_numbers(path, rows["target"].fillna(1))
    _files.refuse(path, rows.index, ~np.isin(flag, (0, 1)), flag, "is no target; give 1 or 0")
    return np.asarray(flag == 1)


def boxes_of_rows(
    path: str | os.PathLike[str], rows: pd.DataFrame, source: str = "", skip_empty: bool = False
) -> Boxes:
    """Boxes of the rows of a table, whose index is the line; see `iter_boxes_csv`."""
    xyxy = np.column_stack([_files.numbers(path, rows[name]) for name in _CORNERS])
    kept = usable(path, rows.index, xyxy, skip_empty)
    rows, xyxy = rows[kept], xyxy[kept]
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
        source=_text(rows, "annotator", source),
        track_id=track,
        label=_text(rows, "label", ""),
    )


def _text(rows: pd.DataFrame, column: str, default: str) -> list[str] | str:
    if column not in rows:
        return default
    return rows[column].fillna(default).astype(str).str.strip().tolist()


def usable(
    path: str | os.PathLike[str], lines: pd.Index, xyxy_px: FloatArray, skip_empty: bool
) -> BoolArray:
    """Which rows hold a box; those whose corners are reversed are refused by their line.

    Args:
        path: The file.
        lines: (N,) numbers of the lines.
        xyxy_px: (N, 4) pixels.
        skip_empty: Whether boxes without width or height are left out, not refused.

    Returns:
        (N,) bool.
    """
    size = xyxy_px[:, 2:] - xyxy_px[:, :2]
    empty: BoolArray = (size == 0.0).any(axis=1)
    refused = (size < 0.0).any(axis=1) | (empty & (not skip_empty))
    if refused.any():
        i = int(np.argmax(refused))
        raise InputError(
            f"{path}, line {lines[i]}: the box {','.join(f'{v:g}' for v in xyxy_px[i])} is empty "
            "or reversed; expected x1 < x2 and y1 < y2 (upper left corner, lower right corner)"
        )
    if empty.any():
        _logger.warning("%s: %d boxes without width or height are left out", path, empty.sum())
    return np.logical_not(empty)


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
        columns["annotator"] = boxes.source
    if timed.any():
        stamps = pd.Series(index=range(len(boxes)), dtype=object)
        stamps[timed] = _files.rfc3339(boxes.time_utc_s[timed])
        columns["time_utc"] = stamps
    if (boxes.track_id != NO_TRACK).any():
        columns["track_id"] = boxes.track_id
    if (boxes.label != "").any():
        columns["label"] = boxes.label
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
                boxes.source.tolist(),
                boxes.label.tolist(),
                stamps.tolist(),
                strict=True,
            )
        )
