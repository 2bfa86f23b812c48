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
from sightline.formats._box_table import iter_box_table
from sightline.tally import Tally
from sightline.types import NO_FRAME, Boxes


def iter_mot(
    path: str | os.PathLike[str],
    chunk_rows: int,
    *,
    source: str = "",
    skip_empty: bool = False,
    image_size_px: tuple[int, int] | None = None,
    tally: Tally | None = None,
) -> Iterator[Boxes]:
    """Boxes of a MOTChallenge file in chunks, at constant memory.

    Rows are ``frame,id,bb_left,bb_top,bb_width,bb_height,conf`` and what may follow, without a
    header. Frames count from 1 there and from 0 here. An id of -1 is no track. A confidence of -1
    is one that is not given and becomes 1. In ground truth (nine columns, of which the seventh is
    0 or 1, the eighth a class and the ninth a visibility from 0 to 1) the seventh says whether the
    row counts, and rows with 0 are left out. Pixels are taken as they stand. For what else is
    understood see `sightline.formats.boxes_csv.iter_boxes_csv`.

    Args:
        path: The file.
        chunk_rows: Most rows in a chunk.
        source: The source of all boxes.
        skip_empty: Leave out rows whose box has no width or height or no number, and count them,
            rather than refuse the file.
        image_size_px: Width and height of the picture, for boxes in shares of it.
        tally: Counts rows and boxes, and what is left out.

    Returns:
        Tables of boxes.

    Raises:
        InputError: A row cannot be understood or holds no box; names file and line.
    """
    return iter_box_table(
        path,
        chunk_rows,
        source=source,
        skip_empty=skip_empty,
        image_size_px=image_size_px,
        tally=tally,
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
