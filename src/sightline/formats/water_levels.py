"""Water levels as tables: ``time_utc,water_level_m``."""

from __future__ import annotations

import logging
import os

from sightline.errors import InputError
from sightline.formats import _files
from sightline.tally import Tally
from sightline.water import WaterLevels

_logger = logging.getLogger(__name__)


def read_water_levels(path: str | os.PathLike[str], *, tally: Tally | None = None) -> WaterLevels:
    """The levels that a gauge measured, or a table of tides foretells.

    Args:
        path: A CSV file with ``time_utc`` and ``water_level_m``, metres above any datum that is
            the same for all recordings of a camera.
        tally: Takes what was read and assumed; None: what was assumed is logged.

    Raises:
        InputError: A column is missing, a cell is no number, times do not increase, or there are
            fewer than two rows.
    """
    (rows,) = _files.table(path, required=("time_utc", "water_level_m"), text=("time_utc",))
    if len(rows) < 2:
        raise InputError(
            f"{path}: holds {len(rows)} levels; a table needs two or more (a single level is given "
            "as a number)"
        )
    own = tally if tally is not None else Tally(path)
    own.format = "CSV"
    own.count("levels", len(rows))
    times = _files.times(path, rows["time_utc"], dated=True, tally=own)
    levels = _files.numbers(path, rows["water_level_m"])
    if tally is None:
        own.warn(_logger)
    try:
        return WaterLevels(times, levels)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
