"""Clocks as tables: ``frame,utc``."""

from __future__ import annotations

import logging
import os

from sightline.clock import FrameClock, stamped_clock
from sightline.errors import InputError
from sightline.formats import _files
from sightline.tally import Tally

_logger = logging.getLogger(__name__)


def read_clock(path: str | os.PathLike[str], *, tally: Tally | None = None) -> FrameClock:
    """The clock of a recording from a CSV file with ``frame`` and ``utc``.

    Times are ISO 8601 (UTC where they name no zone) or POSIX seconds. Stamps that move in steps
    are understood; see `sightline.clock.stamped_clock`.

    Args:
        path: The file.
        tally: Takes what was read and assumed.

    Raises:
        InputError: The file is no such table, or its clock is refused; names file and row.
    """
    (rows,) = _files.table(path, required=("frame", "utc"), text=("utc",))
    own = tally if tally is not None else Tally(path)
    own.format = "CSV"
    own.count("frames", len(rows))
    frame = _files.whole_numbers(path, rows["frame"])
    times = _files.times(path, rows["utc"], tally=own)
    if tally is None:
        own.warn(_logger)
    try:
        return stamped_clock(frame, times)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
