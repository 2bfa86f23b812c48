"""Logs as tables: ``time_utc,latitude_deg,longitude_deg``, and what other programs call these."""

from __future__ import annotations

import logging
import os

import numpy as np

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files, _log_rows
from sightline.formats._degrees import read_degrees
from sightline.formats._json_logs import read_json_log
from sightline.formats._log_names import plain
from sightline.formats._log_table import LogTable, read_log_table, zone_s
from sightline.formats._receivers import Source
from sightline.formats._turns import by_turns
from sightline.tally import Tally
from sightline.types import BoolArray, Fixes, FloatArray, IntArray

_logger = logging.getLogger(__name__)

_REQUIRED = ("time_utc", "latitude_deg", "longitude_deg")
# Receivers further apart than ships are long are of two vessels, and a table names none of them.
_SHIP_M = 500.0


def read_fixes_csv(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """A log from a table with a time, a latitude and a longitude in each row.

    The columns are ``time_utc``, ``latitude_deg`` and ``longitude_deg``, or what other programs
    call them (``timestamp``, ``lat``, ``lng``; date and time may be two). Times are ISO 8601 (UTC
    where they name no zone), POSIX seconds, or one of the forms of `sightline.formats._times`;
    places are degrees, or one of the forms of `sightline.formats._degrees`. Other columns are left
    alone. Rows without a place or a time, or with one that cannot be read or cannot be, are left
    out and counted, as are fixes that cannot be true (`sightline.plausibility`); where no more than
    half of the rows are left, the log is refused.

    Args:
        path: The file, its columns parted by commas, semicolons, tabs or bars.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: A column is missing, half of the cells cannot be understood, times decrease, or
            half of the places are not on the earth.
    """
    own = tally if tally is not None else Tally(path)
    own.format = "CSV"
    table = read_log_table(path)
    own.count("rows", len(table.time) + len(table.cut_short))
    fixes = _of_table(path, table, own, "line")
    own.count("fixes", len(fixes))
    if tally is None:
        own.warn(_logger)
    return fixes


def read_fixes_json(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """A log in JSON: of gpsd, of Signal K, GeoJSON with times, or an object a line.

    Used are gpsd's ``TPV`` of mode 2 and 3; Signal K's ``navigation.position`` of the vessel
    itself; the points of GeoJSON whose times stand in ``coordTimes``, or in ``time`` of a Point;
    and objects whose names are those that columns of tables have. What is left out is what
    `read_fixes_csv` leaves out. Of several receivers that ran at the same time that with most fixes
    is used.

    Args:
        path: The file.
        tally: Takes what was read, left out and assumed; None: what was left out is logged.

    Raises:
        InputError: It is JSON of another kind, or as `read_fixes_csv`.
    """
    own = tally if tally is not None else Tally(path)
    table, row = read_json_log(path, own)
    fixes = _of_table(path, table, own, row)
    own.count("fixes", len(fixes))
    if tally is None:
        own.warn(_logger)
    return fixes


def _of_table(path: str | os.PathLike[str], table: LogTable, own: Tally, row: str) -> Fixes:
    places = (table.latitude, table.longitude)
    latitude, longitude, said = read_degrees(path, places, table.places, tally=own, row=row)
    if said:
        own.note(said)
    if table.cut_short:
        own.leave_out("cut short", len(table.cut_short), row=f"line {table.cut_short[0]}")
    placed = np.isfinite(latitude) & np.isfinite(longitude)
    if not placed.any():
        raise InputError(
            f"{path}: holds no fix" + (f"; left out: {own.reasons()}" if own.left_out else "")
        )
    when = table.time[placed]
    title = str(table.time.name)
    texts = when.tolist()
    _check_epoch(path, title, texts)
    time_s = _log_rows.row_times(
        path,
        when.index,
        texts,
        own,
        row=row,
        title=title,
        zone_s=zone_s(path, table, when),
        day_first=table.day_first,
    )
    timed = np.isfinite(time_s)
    when, time_s = when[timed], time_s[timed]
    latitude, longitude, lines = (
        latitude[placed][timed],
        longitude[placed][timed],
        when.index.to_numpy(),
    )
    _files.check_digits(path, lines, when.tolist(), time_s, latitude, longitude, row=row)
    if newest_first(time_s):
        own.note("its rows stand the newest first")
        time_s, latitude, longitude, lines = (
            column[::-1] for column in (time_s, latitude, longitude, lines)
        )
    kept = _of_one_receiver(Source(time_s, latitude, longitude), lines, own, row)
    time_s, latitude, longitude, lines = (
        column[kept] for column in (time_s, latitude, longitude, lines)
    )
    return _log_rows.fixes(path, lines, time_s, latitude, longitude, row=row, tally=own)


def _of_one_receiver(fixes: Source, lines: IntArray, tally: Tally, row: str) -> BoolArray:
    """(N,) bool, the fixes of one receiver where several wrote by turns."""
    kept = np.ones(len(fixes), dtype=bool)
    able = np.flatnonzero(
        _log_rows.on_the_earth(fixes.latitude_deg, fixes.longitude_deg)
        & ((fixes.latitude_deg != 0.0) | (fixes.longitude_deg != 0.0))
    )
    turn = by_turns(fixes[able], most_m=_SHIP_M)
    if not turn.any():
        return kept
    counts = np.bincount(turn)
    kept[able[turn != turn[np.argmax(counts[turn] == counts.max())]]] = False
    first = lines[int(np.argmin(kept))]
    tally.leave_out("of another receiver", int((~kept).sum()), row=f"{row} {first}")
    tally.note(
        "two receivers wrote into it by turns; that with most fixes is used, of as many the first: "
        "give each a log of its own to choose"
    )
    return kept


def _check_epoch(path: str | os.PathLike[str], title: str, texts: list[str]) -> None:
    """Raise an error where numbers may count from 1980 as well as from 1970."""
    numbers = [text.replace(".", "", 1).isdecimal() for text in texts if text]
    if "gps" in plain(title) and "utc" not in plain(title) and 2 * sum(numbers) > len(numbers):
        raise InputError(
            f"{path}: its times ({title}) are numbers, which GPS counts from 1980 and without leap "
            "seconds, and computers from 1970; write them as 2020-09-30T19:36:24Z, or call the "
            "column timestamp where they count from 1970"
        )


def newest_first(time_utc_s: FloatArray) -> bool:
    """Whether the rows of a log stand the other way round, but for what is wrong."""
    steps = np.diff(time_utc_s)
    return time_utc_s.size > 2 and bool((steps < 0.0).sum() > 2 * (steps > 0.0).sum())


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
