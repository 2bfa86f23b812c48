"""Logs as tables: ``time_utc,latitude_deg,longitude_deg``, and what other programs call these."""

from __future__ import annotations

import logging
import os

import numpy as np

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._degrees import read_degrees
from sightline.formats._log_table import plain, read_log_table
from sightline.tally import Tally
from sightline.types import Fixes

_logger = logging.getLogger(__name__)

_REQUIRED = ("time_utc", "latitude_deg", "longitude_deg")


def read_fixes_csv(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """A log from a table with a time, a latitude and a longitude in each row.

    The columns are ``time_utc``, ``latitude_deg`` and ``longitude_deg``, or what other programs
    call them (``timestamp``, ``lat``, ``lng``; date and time may be two). Times are ISO 8601 (UTC
    where they name no zone), POSIX seconds, or one of the forms of `sightline.formats._times`;
    places are degrees, or one of the forms of `sightline.formats._degrees`. Other columns are left
    alone. Rows without a place are left out and counted, as are fixes that cannot be true
    (`sightline.plausibility`).

    Args:
        path: The file, its columns parted by commas, semicolons, tabs or bars.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: A column is missing, a cell cannot be understood, times decrease, or a place
            is not on the earth.
    """
    own = tally if tally is not None else Tally(path)
    own.format = "CSV"
    table = read_log_table(path)
    latitude, longitude, said = read_degrees(path, (table.latitude, table.longitude), table.places)
    if said:
        own.note(said)
    own.count("rows", len(table.time) + len(table.cut_short))
    if table.cut_short:
        own.leave_out("cut short", len(table.cut_short), row=f"line {table.cut_short[0]}")
    placed = np.isfinite(latitude) & np.isfinite(longitude)
    if not placed.all():
        first = int(np.argmin(placed))
        own.leave_out(
            "without a place",
            int((~placed).sum()),
            row=f"line {table.time.index[first]}",
            text=f"{table.latitude.iloc[first]}, {table.longitude.iloc[first]}",
        )
    if not placed.any():
        raise InputError(
            f"{path}: holds no fix" + (f"; left out: {own.reasons()}" if own.left_out else "")
        )
    when = table.time[placed].replace("", None)
    utc = "utc" in plain(str(table.time.name))
    time_s = _files.times(path, when, dated=True, tally=own, zone_told=utc)
    latitude, longitude, lines = latitude[placed], longitude[placed], when.index.to_numpy()
    _files.check_digits(path, lines, when.tolist(), time_s, latitude, longitude)
    if time_s.size > 2 and (np.diff(time_s) < 0.0).all():
        own.note("its rows stand the newest first")
        time_s, latitude, longitude, lines = (
            column[::-1] for column in (time_s, latitude, longitude, lines)
        )
    fixes = _files.fixes(path, lines, time_s, latitude, longitude, tally=own)
    own.count("fixes", len(fixes))
    if tally is None:
        own.warn(_logger)
    return fixes


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
