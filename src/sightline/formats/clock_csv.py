"""Clocks as tables: ``frame,utc``."""

from __future__ import annotations

import os

from sightline.clock import FrameClock, stamped_clock
from sightline.errors import InputError
from sightline.formats import _files


def read_clock(path: str | os.PathLike[str]) -> FrameClock:
    """The clock of a recording from a CSV file with ``frame`` and ``utc``.

    Times are ISO 8601 (UTC where they name no zone) or POSIX seconds. Stamps that move in steps
    are understood; see `sightline.clock.stamped_clock`.

    Raises:
        InputError: The file is no such table, or its clock is refused; names file and row.
    """
    (rows,) = _files.table(path, required=("frame", "utc"))
    try:
        return stamped_clock(
            _files.whole_numbers(path, rows["frame"]), _files.times(path, rows["utc"])
        )
    except InputError as error:
        if str(error).startswith(str(path)):
            raise
        raise InputError(f"{path}: {error}") from error
