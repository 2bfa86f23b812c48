"""Water levels as tables: ``time_utc,water_level_m``."""

from __future__ import annotations

import os

from sightline.errors import InputError
from sightline.formats import _files
from sightline.water import WaterLevels


def read_water_levels(path: str | os.PathLike[str]) -> WaterLevels:
    """The levels that a gauge measured, or a table of tides foretells.

    Args:
        path: A CSV file with ``time_utc`` and ``water_level_m``, metres above any datum that is
            the same for all recordings of a camera.

    Raises:
        InputError: A column is missing, a cell is no number, times do not increase, or there are
            fewer than two rows.
    """
    (rows,) = _files.table(path, required=("time_utc", "water_level_m"))
    if len(rows) < 2:
        raise InputError(
            f"{path}: holds {len(rows)} levels; a table needs two or more (a single level is given "
            "as a number)"
        )
    times = _files.times(path, rows["time_utc"])
    try:
        return WaterLevels(times, _files.numbers(path, rows["water_level_m"]))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
