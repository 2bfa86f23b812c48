"""Logs as tables of any program: their columns by name, their cells as they stand."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._zones import offset_in, told_offset_s
from sightline.types import FloatArray


def _names(*groups: str) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(group.split()) for group in groups)


# Names of columns, less case and marks; those of an earlier group are taken first.
_TIMES = _names(
    "timeutc utctime datetimeutc utcdatetime timestamputc utctimestamp utc",
    "time timestamp datetime",
    "gpstime gpstimestamp gpsdatetime isotime iso8601 iso8601time fixtime datetimestamp "
    "basedatetime",
    "loggedat recordedat createdat devicetime locationtime timeofday",
    "epoch epochtime unix unixtime unixtimestamp posix posixtime ts timems timestampms epochms "
    "unixms unixtimems timens timestampns timesec times timestamps timestampus timeus "
    "timestampmillis timemillis tst",
)
_DATES = ("dateutc", "utcdate", "date", "gpsdate", "fixdate", "day")
_ZONES = ("tz", "timezone", "tzoffset", "utcoffset", "timezoneoffset", "gmtoffset")
_LOCAL = ("timelocal", "localtime", "datetimelocal", "localdatetime")
_LATITUDES = _names(
    "latitudedeg",
    "latitude lat latdeg latitudedegrees gpslatitude gpslat latitudedd latdd latdegrees "
    "latitudewgs84 latwgs84 positionlat positionlatitude locationlat latitudedecimal latdecimal "
    "latitudens latns latddmm latddmmmmmm latitudeddmm latnmea latitudenmea",
    "latitudee7 late7 latitudee6 late6",
)
_LONGITUDES = _names(
    "longitudedeg",
    "longitude lon lng long londeg lngdeg longitudedegrees gpslongitude gpslon gpslong gpslng "
    "longitudedd londd londegrees longitudewgs84 lonwgs84 positionlon positionlong "
    "positionlongitude locationlon locationlng longitudedecimal londecimal longitudeew lonew "
    "londdmm londddmm londddmmmmmm longitudeddmm longitudedddmm lonnmea longitudenmea",
    "longitudee7 lone7 lnge7 longitudee6 lone6 lnge6",
)
_HEMISPHERES = _names(
    "ns northsouth latns nsindicator latdir latdirection latitudedir latitudedirection lathemi "
    "lathemisphere latitudehemisphere latref latituderef gpslatituderef",
    "ew eastwest lonew ewindicator londir londirection longitudedir longitudedirection lonhemi "
    "lonhemisphere longitudehemisphere lonref longituderef gpslongituderef",
)
# What programs call a heading alone is often the course over ground.
_HEADINGS = ("headingdeg", "headingtrue", "headingtruedeg", "trueheading", "trueheadingdeg", "hdt")
_VESSELS = ("mmsi", "sourcemmsi", "vesselmmsi", "shipmmsi", "mmsinumber")
_COURSES = ("cog", "cogdeg", "course", "coursedeg", "courseoverground", "coursetrue")
_SPEEDS = ("sog", "speed", "speedoverground", "groundspeed")
_SPEED_UNITS = {
    r"kn|kts?|knots?": 1852.0 / 3600.0,
    r"m/s|mps|ms-1|ms": 1.0,
    r"km/h|kmh|kph": 1.0 / 3.6,
    r"mph": 1609.344 / 3600.0,
}
# The Danish Maritime Authority writes the day first, in days of AIS of one date each.
_DANISH = {"timestamp", "typeofmobile", "mmsi"}
_ANY_TIME = frozenset((*sum(_TIMES, ()), *_DATES, *_LOCAL))
_ANY_LATITUDE, _ANY_LONGITUDE = frozenset(sum(_LATITUDES, ())), frozenset(sum(_LONGITUDES, ()))

# Other characters that end lines elsewhere may stand in names.
_NEW_LINE = re.compile("\r\n|\r|\n")
_DELIMITERS = (",", ";", "\t", "|", " ")
_COMMENTS = ("#", "//", "%")
_COMMENT = re.compile(r"^\s*(?:#|//|%)[#/%\s]*")
_HEADER_WITHIN = 60
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


def plain(name: str) -> str:
    """The name of a column less case, marks, and what stands in brackets behind it."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*", "", name.lower())) or name.lower()


def alias_of(name: str) -> str:
    """What a name of a column is another name of: time, latitude, longitude, or nothing."""
    wanted = {"time": _ANY_TIME, "latitude": _ANY_LATITUDE, "longitude": _ANY_LONGITUDE}
    return next((key for key, names in wanted.items() if plain(name) in names), "")


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
    names = [plain(name) for name in _cells(_uncommented(lines[number]), delimiter)]
    which = [i for i, name in enumerate(names) if name in _VESSELS]
    if not which:
        return False
    rows = [_cells(line, delimiter) for line in lines[number + 1 :] if not _passed_over(line)]
    return any(cell.strip() for row in rows for cell in row[which[0] : which[0] + 1])


def mps_of_unit(name: str) -> float | None:
    """Metres a second of the unit that the name of a column of speeds tells; None: it tells none.

    What is called SOG is in knots, as in AIS.
    """
    words = re.split(r"[^a-z/]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    for unit, mps in _SPEED_UNITS.items():
        if any(re.fullmatch(unit, word) for word in words):
            return mps
    return _SPEED_UNITS[r"kn|kts?|knots?"] if plain(name) in ("sog", "speedoverground") else None


def _is_speed(name: str) -> bool:
    units = "|".join(_SPEED_UNITS).replace("/", "").replace("-1", "1")
    return re.sub(rf"({units})$", "", plain(name)) in _SPEEDS


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
    names = next(row for _, row in rows)
    columns = _columns(path, names)
    for key, asked, aliases in (
        ("heading", heading, _HEADINGS),
        ("mmsi", vessel, _VESSELS),
        ("course", vessel, _COURSES),
    ):
        which = [i for i, name in enumerate(names) if asked and plain(name) in aliases]
        if which:
            columns[key] = which[0]
    which = [i for i, name in enumerate(names) if vessel and _is_speed(name)]
    if which:
        columns["speed"] = which[0]
    cells: dict[str, list[str]] = {key: [] for key in columns}
    index, cut_short = [], []
    for line, row in rows:
        while len(row) > len(names) and not row[-1].strip():
            row.pop()
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
            cells[key].append(row[column].strip())
    table = {key: pd.Series(values, index=index, dtype=object) for key, values in cells.items()}
    return LogTable(
        time=_time(path, table, names, columns),
        latitude=_with_hemisphere(table, "latitude", "ns"),
        longitude=_with_hemisphere(table, "longitude", "ew"),
        places=(names[columns["latitude"]].strip(), names[columns["longitude"]].strip()),
        cut_short=tuple(cut_short),
        day_first=True if set(map(plain, names)) >= _DANISH else None,
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
    rows = [_uncommented(lines[header]), *lines[header + 1 :]]
    body = ("" if _passed_over(line) else f"{line}\n" for line in rows)
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


def _header(lines: Sequence[str]) -> tuple[int, str] | None:
    """Number of the header, from 0, and what parts its names; None where there is no header."""
    tried = 0
    commented = None
    for number, line in enumerate(lines):
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
        names = {plain(name) for name in _cells(line, delimiter)}
        if names & _ANY_TIME and names & _ANY_LATITUDE and names & _ANY_LONGITUDE:
            return delimiter
    return ""


def _cells(line: str, delimiter: str) -> list[str]:
    try:
        return next(csv.reader(io.StringIO(line), delimiter=delimiter, skipinitialspace=True), [])
    except csv.Error:
        return []


def _what_lacks(lines: Sequence[str]) -> str:
    first = next((line for line in lines if not _passed_over(line)), "")
    most = max((_cells(first, delimiter) for delimiter in _DELIMITERS), key=len)
    found = [name.strip() for name in most]
    names = {plain(name) for name in found}
    wanted = {"time_utc": _ANY_TIME, "latitude_deg": _ANY_LATITUDE, "longitude_deg": _ANY_LONGITUDE}
    missing = [name for name, aliases in wanted.items() if not names & aliases]
    return (
        f"lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; found "
        f"{_files.shortened(', '.join(found), 300)}"
    )


def _columns(path: str | os.PathLike[str], names: list[str]) -> dict[str, int]:
    """Which column holds what."""
    plains = [plain(name) for name in names]
    columns = {}
    for key, groups in (("latitude", _LATITUDES), ("longitude", _LONGITUDES), ("time", _TIMES)):
        chosen = _chosen(path, key, names, plains, groups)
        if chosen is not None:
            columns[key] = chosen
    for key in ("latitude", "longitude"):
        if _RADIANS.search(names[columns[key]].lower()):
            raise InputError(
                f"{path}: the column {names[columns[key]].strip()} is in radians; expected degrees"
            )
    for key, aliases in zip(("ns", "ew"), _HEMISPHERES, strict=True):
        own = {columns["latitude"], columns["longitude"]}
        which = [i for i, name in enumerate(plains) if name in aliases and i not in own]
        if which:
            columns[key] = which[0]
    which = [i for i, name in enumerate(plains) if name in _ZONES]
    if which:
        columns["zone"] = which[0]
    which = [plains.index(name) for name in _DATES if name in plains]
    if which:
        columns["date"] = which[0]
    if "time" not in columns and "date" not in columns:
        local = next(name for name in names if plain(name) in _LOCAL)
        raise InputError(
            f"{path}: its only time is {local.strip()}, which names no zone; add a column time_utc"
        )
    return columns


def _chosen(
    path: str | os.PathLike[str],
    key: str,
    names: list[str],
    plains: list[str],
    groups: tuple[tuple[str, ...], ...],
) -> int | None:
    for aliases in groups:
        which = [i for i, name in enumerate(plains) if name in aliases]
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
    if hemisphere in table:
        column = (column + " " + table[hemisphere]).where(column != "", "").str.strip()
    return column.rename(name)
