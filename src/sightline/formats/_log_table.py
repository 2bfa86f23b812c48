"""Logs as tables of any program: their columns by name, their cells as they stand."""

from __future__ import annotations

import csv
import io
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._log_names import (
    ANY_LATITUDE,
    ANY_LONGITUDE,
    ANY_TIME,
    COURSES,
    DATES,
    HEADINGS,
    HEMISPHERES,
    LATITUDES,
    LOCAL,
    LONGITUDES,
    PARTS,
    TIMES,
    VESSELS,
    ZONES,
    day_first,
    is_speed,
    plain,
    tail,
    what_mends,
)
from sightline.formats._zones import offset_in, told_offset_s
from sightline.types import FloatArray

# Other characters that end lines elsewhere may stand in names.
_NEW_LINE = re.compile("\r\n|\r|\n")
_DELIMITERS = (",", ";", "\t", "|", " ")
_COMMENTS = ("#", "//", "%")
_COMMENT = re.compile(r"^\s*(?:#|//|%)[#/%\s]*")
_HEADER_WITHIN = 60
_HEADER_OVER = 40
_MOST_BYTES = 512 * 2**20
_RADIANS = re.compile(r"[\[(_\s]rad(ians?)?\b")
_TIME_OF_DAY = re.compile(r"\d{1,2}:\d{2}(:\d{2}([.,:]\d+)?)?\s*([AaPp]\.?[Mm]\.?)?\s*[Zz]?")
_DATE_ALONE = re.compile(r"\d{1,4}[-/.]\d{1,2}[-/.]\d{1,4}")
_PACKED_TIME = re.compile(r"(\d{2})(\d{2})(\d{2}(?:\.\d+)?)")
_PACKED_DATE = re.compile(r"(19\d\d|20\d\d)(\d\d)(\d\d)")


@dataclass(frozen=True, eq=False)
class LogTable:
    """The columns of a log, as text; their index is the line in the file.

    Attributes:
        time: Text of date and time; its name is that of its column.
        latitude: Text, with its hemisphere where a column of its own tells it.
        longitude: Text.
        places: What the file calls latitude and longitude.
        cut_short: Lines that end before their last column.
        heading: Text of the true heading; None where there is no such column, or none is asked for.
        mmsi: Text of the MMSI; as for ``heading``.
        course: Text of the course over ground; as for ``heading``.
        speed: Text of the speed over ground; as for ``heading``.
        zone: Text of the zone of each time; None where there is no such column.
        day_first: Whether its program writes dates with the day first; None: not known.
    """

    time: pd.Series
    latitude: pd.Series
    longitude: pd.Series
    places: tuple[str, str]
    cut_short: tuple[int, ...]
    heading: pd.Series | None = None
    mmsi: pd.Series | None = None
    course: pd.Series | None = None
    speed: pd.Series | None = None
    zone: pd.Series | None = None
    day_first: bool | None = None


def is_log_table(head: str) -> bool:
    """Whether a text begins as a table with a time and a place, by the names of its columns."""
    return _header(_NEW_LINE.split(head)) is not None


def is_vessel_table(head: str) -> bool:
    """Whether a text begins as a log that says of each row which vessel it is of, by its MMSI."""
    lines = _NEW_LINE.split(head)
    found = _header(lines)
    if found is None:
        return False
    number, delimiter = found
    header, below = _header_text(lines, number)
    names = [plain(name) for name in _cells(_uncommented(header), delimiter)]
    which = [i for i, name in enumerate(names) if name in VESSELS]
    if not which:
        return False
    rows = [_cells(line, delimiter) for line in lines[below:] if not _passed_over(line)]
    return any(cell.strip() for row in rows for cell in row[which[0] : which[0] + 1])


def read_log_table(
    path: str | os.PathLike[str], *, heading: bool = False, vessel: bool = False
) -> LogTable:
    """The time and the place in each row of a table, whatever its program calls them.

    Columns are parted by commas, semicolons, tabs, bars or blanks. Lines before the header, and
    those that begin with ``#``, ``//`` or ``%``, are passed over; one of these may be the header.

    Args:
        path: The file.
        heading: Whether a heading is asked for as well.
        vessel: Whether the MMSI, the course and the speed are.

    Raises:
        InputError: The file is too large or no text, a column is missing or may be one of
            several, or a row has more cells than the header.
    """
    text = _files.whole_text(path, _MOST_BYTES)
    lines = _NEW_LINE.split(text.rstrip("\r\n"))
    found = _header(lines)
    if found is None:
        raise InputError(f"{path}: {_what_lacks(lines)}")
    number, delimiter = found
    rows = _rows(path, lines, number, delimiter)
    names = [" ".join(map(str.strip, bare_cell(name).split("\n"))) for name in next(rows)[1]]
    columns = _columns(path, names)
    for key, asked, aliases in (
        ("heading", heading, HEADINGS),
        ("mmsi", vessel, VESSELS),
        ("course", vessel, COURSES),
    ):
        which = [i for i, name in enumerate(names) if asked and plain(name) in aliases]
        if which:
            columns[key] = which[0]
    which = [i for i, name in enumerate(names) if vessel and is_speed(name)]
    if which:
        columns["speed"] = which[0]
    cells: dict[str, list[str]] = {key: [] for key in columns}
    index, cut_short = [], []
    for line, row in rows:
        while len(row) > len(names) and not row[-1].strip():
            row.pop()
        if delimiter == " " and len(row) == len(names) + 1:
            row = _with_date_and_time(row, columns)
        if row == names:
            # Logs that were put together keep the header of each.
            continue
        if len(row) > len(names):
            raise InputError(
                f"{path}, line {line}: its rows have more cells than its header has names (is a "
                "comma both in numbers and between them?)"
            )
        if max(columns.values()) >= len(row):
            cut_short.append(line)
            continue
        index.append(line)
        for key, column in columns.items():
            cells[key].append(bare_cell(row[column]))
    parts = {key: cells.pop(key) for key in PARTS if key in columns}
    if parts:
        cells = _joined(parts) | cells
        columns |= {"date" if "hour" not in parts else "time": columns["year"]}
    table = {key: pd.Series(values, index=index, dtype=object) for key, values in cells.items()}
    return LogTable(
        time=_time(path, table, names, columns),
        latitude=_with_hemisphere(table, "latitude", "ns"),
        longitude=_with_hemisphere(table, "longitude", "ew"),
        places=(names[columns["latitude"]].strip(), names[columns["longitude"]].strip()),
        cut_short=tuple(cut_short),
        day_first=day_first(names),
        **{
            key: table[key].rename(names[columns[key]].strip())
            for key in ("heading", "mmsi", "course", "speed", "zone")
            if key in columns
        },
    )


def zone_s(
    path: str | os.PathLike[str], table: LogTable, when: pd.Series
) -> float | FloatArray | None:
    """Seconds by which times are ahead of UTC, one or (N,), as their header or a column tells.

    Args:
        path: The file.
        table: Its columns.
        when: N of its times.

    Raises:
        InputError: A zone is named that may be several, or none that is known.
    """
    told_s = offset_in(path, str(table.time.name))
    if told_s is not None or table.zone is None:
        return told_s
    named = table.zone[when.index]
    where = f"its column {table.zone.name}"
    known = {
        text: told_offset_s(path, text, where) if text else 0.0 for text in named.unique().tolist()
    }
    return np.asarray(named.map(known), dtype=np.float64)


def _rows(
    path: str | os.PathLike[str], lines: list[str], header: int, delimiter: str
) -> Iterator[tuple[int, list[str]]]:
    """Number of its line, and cells of each row, the header's first."""
    # Blank lines and comments become empty, so that lines keep their numbers.
    _, below = _header_text(lines, header)
    names = (f"{line}\n" for line in (_uncommented(lines[header]), *lines[header + 1 : below]))
    body = itertools.chain(
        names, ("" if _passed_over(line) else f"{line}\n" for line in lines[below:])
    )
    reader = csv.reader(
        (line or "\n" for line in body), delimiter=delimiter, skipinitialspace=True, strict=True
    )
    try:
        for row in reader:
            if any(cell.strip() for cell in row):
                yield header + reader.line_num, row
    except csv.Error as error:
        raise InputError(
            f"{path}, line {header + reader.line_num}: is no row of a table ({error})"
        ) from error


def _passed_over(line: str) -> bool:
    return not line.strip() or line.lstrip().startswith(_COMMENTS)


def _uncommented(line: str) -> str:
    return _COMMENT.sub("", line)


def _header_text(lines: Sequence[str], number: int) -> tuple[str, int]:
    """A line with those that its quotes go on over, and the number of the line below."""
    below = number + 1
    most = min(len(lines), number + _HEADER_OVER)
    while below < most and sum(line.count('"') for line in lines[number:below]) % 2:
        below += 1
    text = "\n".join(lines[number:below])
    return (text, below) if text.count('"') % 2 == 0 else (lines[number], number + 1)


def _header(lines: Sequence[str]) -> tuple[int, str] | None:
    """Number of the header, from 0, and what parts its names; None where there is no header."""
    tried = 0
    commented = None
    below = 0
    for number in range(len(lines)):
        if number < below:
            continue
        line, below = _header_text(lines, number)
        if not line.strip() or line.lower().startswith("sep="):
            continue
        delimiter = _parted_by(_uncommented(line))
        if _passed_over(line):
            # The last one before the rows, of as many cells as they have.
            commented = (number, delimiter) if delimiter and not tried else commented
            continue
        if delimiter:
            return number, delimiter
        if commented and not tried:
            names = _cells(_uncommented(lines[commented[0]]), commented[1])
            cells = _cells(line, commented[1])
            commented = commented if len(cells) in (len(names), len(names) + 1) else None
        tried += 1
        if tried >= _HEADER_WITHIN:
            break
    return commented


def _parted_by(line: str) -> str:
    """What parts the names in a line that has a time and a place; empty where it has none."""
    for delimiter in _DELIMITERS:
        cells = [bare_cell(cell) for cell in _cells(line, delimiter)]
        names = {plain(name) for name in cells} | {tail(name) for name in cells}
        if names & ANY_TIME and names & ANY_LATITUDE and names & ANY_LONGITUDE:
            return delimiter
    return ""


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line), delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return []


def _what_lacks(lines: Sequence[str]) -> str:
    number = next((i for i, line in enumerate(lines) if not _passed_over(line)), 0)
    first, _ = _header_text(lines, number)
    most = max((_cells(first, delimiter) for delimiter in _DELIMITERS), key=len)
    found = [" ".join(name.split()) for name in most]
    names = {plain(name) for name in found}
    wanted = {"time_utc": ANY_TIME, "latitude_deg": ANY_LATITUDE, "longitude_deg": ANY_LONGITUDE}
    missing = [name for name, aliases in wanted.items() if not names & aliases]
    return (
        f"lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; found "
        f"{_files.shortened(', '.join(found), 300)}{what_mends(found)}"
    )


def _columns(path: str | os.PathLike[str], names: list[str]) -> dict[str, int]:
    """Which column holds what."""
    plains, tails = [plain(name) for name in names], [tail(name) for name in names]
    columns = {}
    for key, groups in (("latitude", LATITUDES), ("longitude", LONGITUDES), ("time", TIMES)):
        chosen = _chosen(path, key, names, plains, groups)
        if chosen is None and not (key == "time" and set(plains) & {*DATES, *LOCAL}):
            chosen = _chosen(path, key, names, tails, groups)
        if chosen is not None:
            columns[key] = chosen
    if "time" in columns and plains[columns["time"]] == "gpst":
        raise InputError(
            f"{path}: its times ({names[columns['time']].strip()}) are those of GPS, whole seconds "
            "ahead of UTC (18 since 2017); write the log with times in UTC"
        )
    parts = _parts(plains)
    if {"year", "month", "day"} <= parts.keys():
        columns |= {key: parts[key] for key in ("year", "month", "day")}
        if "time" not in columns and {"hour", "minute", "second"} <= parts.keys():
            columns |= {key: parts[key] for key in parts.keys() - {"year", "month", "day"}}
    for key in ("latitude", "longitude"):
        if _RADIANS.search(names[columns[key]].lower()):
            raise InputError(
                f"{path}: the column {names[columns[key]].strip()} is in radians; expected degrees"
            )
    for key, aliases in zip(("ns", "ew"), HEMISPHERES, strict=True):
        own = {columns["latitude"], columns["longitude"]}
        which = [i for i, name in enumerate(plains) if name in aliases and i not in own]
        if which:
            columns[key] = which[0]
    which = [i for i, name in enumerate(plains) if name in ZONES]
    if which:
        columns["zone"] = which[0]
    which = [named.index(name) for named in (plains, tails) for name in DATES if name in named]
    if which and "year" not in columns:
        columns["date"] = which[0]
    if not columns.keys() & {"time", "date", "hour"}:
        if "year" in columns:
            raise InputError(
                f"{path}: has columns of the year, the month and the day, and none of the hour, "
                "the minute and the second; add a column time"
            )
        local = next(name for name in names if {plain(name), tail(name)} & {*LOCAL})
        raise InputError(
            f"{path}: its only time is {local.strip()}, which names no zone; add a column time_utc"
        )
    return columns


def _parts(plains: Sequence[str]) -> dict[str, int]:
    """Which columns hold the parts of a time."""
    found = {}
    for key, aliases in PARTS.items():
        which = [i for i, name in enumerate(plains) if name in aliases]
        if which:
            found[key] = which[0]
    return found


def _joined(parts: dict[str, list[str]]) -> dict[str, list[str]]:
    """A date, or a whole time, of its parts; what is no number stays as it stands."""
    days = ("year", "month", "day")
    date = [_dated(cells) for cells in zip(*(parts[key] for key in days), strict=True)]
    if "hour" not in parts:
        return {"date": date}
    nano = parts.get("nano") or ["0"] * len(date)
    clock = (parts[key] for key in ("hour", "minute", "second"))
    return {"time": [_timed(*cells) for cells in zip(date, *clock, nano, strict=True)]}


def _dated(cells: tuple[str, ...]) -> str:
    if not any(cells):
        return ""
    try:
        year, month, day = (int(float(cell)) for cell in cells)
    except (ValueError, OverflowError):
        return " ".join(cells)
    return f"{year:04d}-{month:02d}-{day:02d}"


def _timed(date: str, hour: str, minute: str, second: str, nano: str) -> str:
    """The text of a time; nanoseconds may be below zero, as u-blox rounds to the nearest second."""
    if not date or not (hour and minute and second):
        return ""
    written = f"{date} {hour}:{minute}:{second}"
    try:
        since_s = 60 * (60 * int(float(hour)) + int(float(minute))) + float(
            second.replace(",", ".")
        )
        micro = round(since_s * 1e6 + float(nano or 0) * 1e-3)
        if not (0 <= int(float(minute)) < 60 and 0 <= float(second) <= 60 and micro > -1e6):
            return written
        return f"{np.datetime64(date, 'us') + np.timedelta64(micro, 'us')}Z"
    except (ValueError, OverflowError):
        return written


def _with_date_and_time(row: list[str], columns: dict[str, int]) -> list[str]:
    """A row of which blanks part the cells, with its date and its time of day in one."""
    i = columns.get("time", columns.get("date", len(row)))
    if i + 1 < len(row) and _DATE_ALONE.fullmatch(row[i]) and _TIME_OF_DAY.fullmatch(row[i + 1]):
        return [*row[:i], f"{row[i]} {row[i + 1]}", *row[i + 2 :]]
    return row


def bare_cell(text: str) -> str:
    """A cell less what spreadsheets write to keep it as text: ``'54.3`` and ``="54.3"``."""
    bare = text.strip()
    if bare.startswith("'"):
        return bare[1:-1].strip() if len(bare) > 1 and bare.endswith("'") else bare[1:].strip()
    return bare[2:-1].strip() if bare.startswith('="') and bare.endswith('"') else bare


def _chosen(
    path: str | os.PathLike[str],
    key: str,
    names: list[str],
    plains: list[str],
    groups: tuple[tuple[str, ...], ...],
) -> int | None:
    for aliases in groups:
        which = [i for i, name in enumerate(plains) if name in aliases]
        utc = [i for i in which if "utc" in names[i].lower()]
        if len(which) > 1 and len(utc) == 1:
            which = utc
        if len(which) > 1:
            several = " and ".join(names[i].strip() for i in which)
            best = {"time": "time_utc"}.get(key, f"{key}_deg")
            raise InputError(
                f"{path}: the columns {several} may both be its {key}; call the right one {best}"
            )
        if which:
            return which[0]
    return None


def _time(
    path: str | os.PathLike[str],
    table: dict[str, pd.Series],
    names: list[str],
    columns: dict[str, int],
) -> pd.Series:
    """Text of date and time, from one column or from two."""
    if "time" not in table:
        date, name = table["date"], names[columns["date"]].strip()
        bare = date.str.fullmatch(_DATE_ALONE)
        if bare.any():
            line = date.index[bare][0]
            raise InputError(
                f"{path}, line {line}: {date[line]} has no time of day ({name}); add a column time"
            )
        return date.rename(name)
    time = table["time"]
    name = names[columns["time"]].strip()
    alone = time[time != ""]
    packed = "date" in table and alone.str.fullmatch(_PACKED_TIME).all()
    if not (packed or alone.str.fullmatch(_TIME_OF_DAY).any()):
        return time.rename(name)
    if "date" not in table:
        line = alone.index[alone.str.fullmatch(_TIME_OF_DAY)][0]
        raise InputError(
            f"{path}, line {line}: {alone[line]} has no date ({name}); add a column date"
        )
    if packed:
        time = time.str.replace(_PACKED_TIME, r"\1:\2:\3", regex=True)
    date = table["date"].str.replace(_PACKED_DATE, r"\1-\2-\3", regex=True)
    # A date as spreadsheets write it has a midnight of its own.
    date = date.str.replace(r"[T ]00:00:00(\.0+)?Z?$", "", regex=True)
    both: pd.Series = (date + " " + time).where((date != "") & (time != ""), "")
    return both.rename(name)


def _with_hemisphere(table: dict[str, pd.Series], key: str, hemisphere: str) -> pd.Series:
    name = f"{key}_deg"
    column = table[key]
    # RTKLIB counts satellites under "ns".
    if hemisphere in table and not table[hemisphere].str.contains(r"\d").any():
        column = (column + " " + table[hemisphere]).where(column != "", "").str.strip()
    return column.rename(name)
