"""Logs as tables: ``time_utc,latitude_deg,longitude_deg``, and what other programs call these."""

from __future__ import annotations

import logging
import os

import numpy as np
import pandas as pd

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._degrees import read_degrees
from sightline.formats._log_table import plain, read_log_table
from sightline.tally import Tally
from sightline.types import Fixes, FloatArray

_logger = logging.getLogger(__name__)

_REQUIRED = ("time_utc", "latitude_deg", "longitude_deg")
_COARSEST_S = 2.0
_MANY = 3


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
    _refuse_coarse(path, when, time_s, latitude[placed], longitude[placed])
    fixes = _files.fixes(path, when.index, time_s, latitude[placed], longitude[placed], tally=own)
    own.count("fixes", len(fixes))
    if tally is None:
        own.warn(_logger)
    return fixes


def _refuse_coarse(
    path: str | os.PathLike[str],
    when: pd.Series,
    time_s: FloatArray,
    latitude_deg: FloatArray,
    longitude_deg: FloatArray,
) -> None:
    """Raise an error where times are rounded so that many places share each of them."""
    rows = pd.DataFrame({"t": time_s, "y": latitude_deg, "x": longitude_deg}).drop_duplicates()
    times, count = np.unique(rows["t"], return_counts=True)
    shared = count[count > 1].sum()
    coarse_s = float(np.diff(times).min()) if times.size > 1 else float("inf")
    if 2 * shared > len(rows) and np.median(count) >= _MANY and coarse_s >= _COARSEST_S:
        i = int(np.argmax(time_s == times[np.argmax(count)]))
        steps = f", in steps of {coarse_s:g} s" if times.size > 1 else ""
        raise InputError(
            f"{path}, line {when.index[i]}: {when.iloc[i]} is the time of {count.max()} different "
            f"places{steps}; the times were rounded, write them with all their digits"
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
