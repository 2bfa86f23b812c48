"""Horizons as tables: ``frame,left_y_px,right_y_px``."""

from __future__ import annotations

import os

import numpy as np

from sightline.clock import Clock
from sightline.errors import InputError
from sightline.formats import _files
from sightline.tally import Tally
from sightline.types import Horizons


def read_horizons_csv(
    path: str | os.PathLike[str], clock: Clock, *, tally: Tally | None = None
) -> Horizons:
    """The rows of the horizon at the left and the right edge of the image, frame by frame.

    Args:
        path: A CSV file with ``frame``, ``left_y_px`` and ``right_y_px``.
        clock: Tells the times of the frames.
        tally: Takes what was read.

    Raises:
        InputError: A column is missing, a cell is no number, or a frame comes twice.
    """
    (rows,) = _files.table(path, required=("frame", "left_y_px", "right_y_px"))
    if rows.empty:
        raise InputError(f"{path}: holds no horizon")
    if tally is not None:
        tally.format = "CSV"
        tally.count("frames", len(rows))
    frame = _files.whole_numbers(path, rows["frame"])
    order = np.argsort(frame, kind="stable")
    twice = np.zeros(frame.size, dtype=bool)
    twice[order[1:]] = np.diff(frame[order]) == 0
    _files.refuse(path, rows.index, twice, frame, "is a frame that comes twice")
    lines = np.stack([_files.numbers(path, rows[name]) for name in ("left_y_px", "right_y_px")])
    left, right = lines[:, order]
    return Horizons(clock.time_utc_s(frame[order]), left, right)
