"""MOTChallenge: boxes as trackers and their benchmarks exchange them."""

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
from sightline.formats.boxes_csv import usable
from sightline.types import NO_FRAME, NO_TRACK, Boxes

_COLUMNS = ("frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf")


def iter_mot(
    path: str | os.PathLike[str], chunk_rows: int, *, source: str = "", skip_empty: bool = False
) -> Iterator[Boxes]:
    """Boxes of a MOTChallenge file in chunks, at constant memory.

    Rows are ``frame,id,bb_left,bb_top,bb_width,bb_height,conf`` and what may follow, without a
    header. Frames count from 1 there and from 0 here. An id of -1 is no track. A confidence of -1
    is one that is not given and becomes 1. In ground truth (nine columns) the seventh says
    whether the row counts, and rows with 0 are left out. Pixels are taken as they stand.

    Args:
        path: The file.
        chunk_rows: Most rows in a chunk.
        source: The source of all boxes.
        skip_empty: Leave out boxes without width or height, rather than refuse the file.

    Yields:
        Tables of boxes.

    Raises:
        InputError: A row cannot be understood or holds no box; names file and line.
    """
    _files.beginning(path)
    try:
        with pd.read_csv(
            path, header=None, chunksize=chunk_rows, skip_blank_lines=False, skipinitialspace=True
        ) as reader:
            for chunk in reader:
                chunk.index += 1
                rows = chunk.dropna(how="all")
                if rows.shape[1] < 6:
                    raise InputError(
                        f"{path}: has {rows.shape[1]} columns; a MOTChallenge file has at least "
                        "six: frame,id,bb_left,bb_top,bb_width,bb_height"
                    )
                yield _boxes(path, rows, source, skip_empty)
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 ({error.reason})") from error
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        raise InputError(f"{path}: is no MOTChallenge file ({reason})") from error


def _boxes(
    path: str | os.PathLike[str], rows: pd.DataFrame, source: str, skip_empty: bool
) -> Boxes:
    named = rows.rename(columns=dict(enumerate(_COLUMNS)))
    left, top, width, height = (_files.numbers(path, named[name]) for name in _COLUMNS[2:6])
    xyxy = np.column_stack([left, top, left + width, top + height])
    frame = _files.whole_numbers(path, named["frame"])
    _files.refuse(path, rows.index, frame < 1, frame, "is no frame; MOTChallenge counts from 1")
    track = _files.whole_numbers(path, named["id"])
    confidence = np.ones(len(rows))
    counts = np.ones(len(rows), dtype=bool)
    if "conf" in named:
        given = _files.numbers(path, named["conf"])
        if rows.shape[1] == 9:
            counts = given != 0.0
        else:
            confidence = np.where(given == -1.0, 1.0, given)
            outside = (confidence < 0.0) | (confidence > 1.0)
            _files.refuse(path, rows.index, outside, given, "is no confidence between 0 and 1")
    counts[counts] = usable(path, rows.index[counts], xyxy[counts], skip_empty)
    return Boxes.of(
        xyxy[counts],
        frame=frame[counts] - 1,
        confidence=confidence[counts],
        source=source,
        track_id=np.where(track < 0, NO_TRACK, track)[counts],
    )


def write_mot(boxes: Boxes, path: str | os.PathLike[str]) -> None:
    """Write boxes as a MOTChallenge file; times, sources and labels have no place in it.

    Raises:
        InputError: A box has no frame, or the file cannot be written.
    """
    if (boxes.frame == NO_FRAME).any():
        raise InputError(f"{path}: a MOTChallenge file needs the frame of every box")
    with atomic_path(path) as temporary:
        _rows(boxes).to_csv(temporary, index=False, header=False)


def _rows(boxes: Boxes) -> pd.DataFrame:
    size = boxes.xyxy_px[:, 2:] - boxes.xyxy_px[:, :2]
    rows = pd.DataFrame({"frame": boxes.frame + 1, "id": boxes.track_id})
    rows[["left", "top"]] = boxes.xyxy_px[:, :2]
    rows[["width", "height"]] = size
    rows["conf"] = boxes.confidence
    rows[["x", "y", "z"]] = -1
    return rows


@contextmanager
def mot_box_writer(path: Path) -> Iterator[MotBoxWriter]:
    """Write boxes as they are found."""
    with path.open("w", encoding="utf-8", newline="") as file:
        yield MotBoxWriter(file)


class MotBoxWriter:
    """Adds boxes to an open MOTChallenge file; see `mot_box_writer`."""

    def __init__(self, file: TextIO) -> None:
        self._writer = csv.writer(file, lineterminator="\n")

    def add(self, boxes: Boxes) -> None:
        """Write boxes, all of which have a frame."""
        if (boxes.frame == NO_FRAME).any():
            raise InputError("boxes that are written as they are found need their frames")
        left, top, right, bottom = boxes.xyxy_px.T
        for row in zip(
            (boxes.frame + 1).tolist(),
            boxes.track_id.tolist(),
            *np.stack([left, top, right - left, bottom - top]).round(2).tolist(),
            boxes.confidence.round(4).tolist(),
            strict=True,
        ):
            self._writer.writerow([*row, -1, -1, -1])
