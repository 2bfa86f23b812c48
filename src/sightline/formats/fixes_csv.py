"""Logs as tables: ``time_utc,latitude_deg,longitude_deg``."""

from __future__ import annotations

import os

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.types import Fixes

_REQUIRED = ("time_utc", "latitude_deg", "longitude_deg")


def read_fixes_csv(path: str | os.PathLike[str]) -> Fixes:
    """A log from a CSV file with ``time_utc``, ``latitude_deg`` and ``longitude_deg``.

    Times are ISO 8601 (UTC where they name no zone) or POSIX seconds. Other columns, as loggers
    add them, are left alone.

    Raises:
        InputError: A column is missing, a cell cannot be understood, times decrease, or a place
            is not on the earth.
    """
    (rows,) = _files.table(path, required=_REQUIRED)
    if rows.empty:
        raise InputError(f"{path}: holds no fix")
    return _files.fixes(
        path,
        rows.index,
        _files.times(path, rows["time_utc"]),
        _files.numbers(path, rows["latitude_deg"]),
        _files.numbers(path, rows["longitude_deg"]),
    )


def write_fixes_csv(fixes: Fixes, path: str | os.PathLike[str]) -> None:
    """Write a log that `read_fixes_csv` reads: milliseconds, and degrees to nine places.

    Raises:
        InputError: The file cannot be written.
    """
    rows = zip(
        _files.rfc3339(fixes.time_utc_s), fixes.latitude_deg, fixes.longitude_deg, strict=True
    )
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(",".join(_REQUIRED) + "\n")
        file.writelines(f"{when},{lat:.9f},{lon:.9f}\n" for when, lat, lon in rows)
