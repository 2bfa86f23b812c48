"""Times as people and programs write them: one function for the cells of tables and for XML."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import date

import numpy as np
import pandas as pd

from sightline.types import FloatArray, IntArray, from_datetime64

EXPECTED = "expected ISO 8601, as 2020-09-30T19:36:24Z, or POSIX seconds"

# What fits into nanoseconds of 64 bits, with years to spare for what is computed from it.
_FIRST, _LAST = np.datetime64("1700-01-01"), np.datetime64("2250-01-01")
_FIRST_S, _LAST_S = from_datetime64([_FIRST, _LAST])
_FIRST_DATED_S = 946_684_800.0
"""2000: a smaller number is seconds of a day or a recording, or since another epoch than 1970."""

_POSIX_UNITS = (
    ("seconds", 1.0),
    ("milliseconds", 1e3),
    ("microseconds", 1e6),
    ("nanoseconds", 1e9),
)
_SERIAL_DAYS = (36526.0, 60000.0)
"""2000 to 2064 in the days of spreadsheets."""

_SERIAL_STEP = 0.01
"""Days: seconds of a day follow each other by more, but for receivers at over 100 Hz."""

_SERIAL_EPOCH_DAYS = 25569.0
_DAY_S = 86400.0
_ISO = r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d(?:\.\d{1,9})?(?:Z|[+-]\d\d:?\d\d)?"
_ZONED = re.compile(r"(?:Z|[+-]\d\d:?\d\d)$")
_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?")
_MOST_NUMBER = 40
_MOST_TEXT = 80

_CLOCK = (
    r"(?P<hour>\d{1,2}):(?P<minute>\d{2})(?::(?P<second>\d{2})"
    r"(?:[.,](?P<fraction>\d+)|:(?P<milli>\d{3}|\d{6}))?)?(?:\s*(?P<half>[AaPp])\.?[Mm]\.?)?"
)
_ZONE = (
    r"(?:\s*(?:[Zz]|(?:(?i:UTC|GMT)\s?)?(?P<sign>[+\-\N{MINUS SIGN}])(?P<zone_hour>\d{1,2})"
    r"(?::?(?P<zone_minute>\d{2}))?(?:\s(?:[A-Z]{1,5}|[+-]\d{2,4}))?|(?i:UTC|GMT)(?!\s?[+-]))"
    r"(?P<zoned>)(?:\s+m=[+-][\d.]+)?(?:\[[^\]]*\])?)?"
)
_NAME = r"(?P<name>[A-Za-z]{3,9})"
_BETWEEN = r"(?:[Tt_]|,?\s+|,)"
_MOMENT = f"{_BETWEEN}{_CLOCK}{_ZONE}"
_YEAR = r"(?P<year>\d{4})"
_DAY = r"(?P<day>\d{1,2})"
_WEEKDAY = r"(?:[A-Za-z]{3,9}\.?,?\s+)?"
_BASIC_DATE = rf"{_YEAR}(?P<month>\d\d)(?P<day>\d\d)"
_BASIC_CLOCK = r"(?P<hour>\d\d)(?P<minute>\d\d)(?P<second>\d\d)(?:[.,](?P<fraction>\d+))?"
_FORMS = tuple(
    re.compile(form)
    for form in (
        rf"{_YEAR}[-/.](?P<month>\d{{1,2}})[-/.]{_DAY}(?:{_MOMENT})?",
        rf"(?P<first>\d{{1,2}})(?P<mark>[-/.])(?P<next>\d{{1,2}})(?P=mark){_YEAR}{_MOMENT}",
        rf"{_BASIC_DATE}[Tt]?{_BASIC_CLOCK}{_ZONE}",
        # 1 Jun 2024 10:00:00; Jun 1, 2024 10:00:00; Sat Jun  1 10:00:00 2024
        rf"{_WEEKDAY}{_DAY}[-\s/]{_NAME}\.?[-\s/,]+{_YEAR}{_MOMENT}",
        rf"{_WEEKDAY}{_NAME}\.?\s+{_DAY},?\s+{_YEAR}{_MOMENT}",
        rf"{_WEEKDAY}{_NAME}\s+{_DAY}\s+{_CLOCK}{_ZONE}\s+{_YEAR}",
    )
)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_MONTH_NAMES = (
    *("january", "february", "march", "april", "may", "june"),
    *("july", "august", "september", "october", "november", "december"),
)
_SHORT_YEAR = re.compile(r"\d{1,2}[-/.]\d{1,2}[-/.]\d{2}(?!\d).*")
_NO_DATE = re.compile(r"\d{1,2}:\d{2}(?::\d{2}(?:[.,]\d+)?)?\s*(?:[AaPp]\.?[Mm]\.?)?\s*[Zz]?")
_ZONE_NAME = re.compile(r".*\d\s*(?P<zone>[A-Za-z]{2,5})")
_ORDERS = {True: "day first", False: "month first"}


class NotUnderstoodError(ValueError):
    """A text that is no time, and why, as it continues the text: ``has no date``."""

    def __init__(self, row: int, why: str) -> None:
        super().__init__(why)
        self.row = row
        self.why = why


@dataclass(frozen=True, eq=False)
class Times:
    """Times that were read.

    Attributes:
        time_utc_s: (N,) float64, POSIX seconds; NaN where there was no text.
        assumed: What was assumed of how they are written, a sentence each.
        zoneless: Whether a text named no zone, and was taken for UTC.
        refused: Rows whose text alone is no time, in a column that can be read, and why.
    """

    time_utc_s: FloatArray
    assumed: tuple[str, ...] = ()
    zoneless: bool = False
    refused: dict[int, str] = field(default_factory=dict)


def read_times(
    texts: Sequence[str],
    *,
    dated: bool = True,
    strict: bool = True,
    day_first: bool | None = None,
) -> Times:
    """POSIX seconds of texts that belong together: a column, or the points of a file.

    Understood are ISO 8601 in its forms, and what loggers, spreadsheets and languages make of it;
    POSIX seconds, milliseconds, microseconds and nanoseconds; the day numbers of spreadsheets. A
    date like 03/04/2024 is understood where another row of the same column tells the order.

    Args:
        texts: (N,) as they stand; an empty one has no time.
        dated: Whether seconds of before 2000 are refused, since they are no dates of logs.
        strict: Whether one text that is no time refuses all; else it is among ``refused``.
        day_first: How dates like 03/04/2024 are read where no row tells; None: they are refused.

    Raises:
        NotUnderstoodError: A text is no time, or may be two.
    """
    seconds = np.full(len(texts), np.nan)
    clean = pd.Series([" ".join(text.split()) for text in texts], dtype=object)
    written = (clean != "").to_numpy(dtype=bool)
    number = written & clean.map(_is_number).to_numpy(dtype=bool)
    assumed: tuple[str, ...] = ()
    refused: dict[int, str] = {}
    if number.any():
        rows = np.flatnonzero(number)
        values = np.array([float(text.replace(",", ".")) for text in clean[number]])
        try:
            numbers = read_numbers(values, dated=dated, strict=strict)
            seconds[rows], assumed = numbers.time_utc_s, numbers.assumed
            refused = {int(rows[i]): why for i, why in numbers.refused.items()}
        except NotUnderstoodError as error:
            # A few numbers among dates are rows at fault; a column of them is not understood.
            if strict or 2 * rows.size > written.sum():
                raise NotUnderstoodError(int(rows[error.row]), error.why) from error
            refused = dict.fromkeys(map(int, rows), error.why)
    canonical = clean.str.fullmatch(_ISO).to_numpy(dtype=bool)
    if canonical.any():
        stamps = pd.to_datetime(clean[canonical], utc=True, format="ISO8601", errors="coerce")
        moments = stamps.dt.tz_localize(None).to_numpy()
        known = (moments > _FIRST) & (moments < _LAST)
        seconds[canonical] = from_datetime64(np.where(known, moments, np.datetime64("NaT")))
    zoneless = bool((canonical & ~clean.str.contains(_ZONED).to_numpy(dtype=bool)).any())
    # What pandas cannot say, as a leap second, is looked at once more.
    rest = np.flatnonzero(written & np.isnan(seconds) & ~number)
    if rest.size:
        found = _texts(clean, rest, strict, day_first)
        seconds[rest] = found.time_utc_s
        refused |= {int(rest[i]): why for i, why in found.refused.items()}
        assumed += found.assumed
        zoneless = zoneless or found.zoneless
    outside = written & ~((seconds > _FIRST_S) & (seconds < _LAST_S))
    outside[list(refused)] = False
    if outside.any() and strict:
        raise NotUnderstoodError(int(np.argmax(outside)), f"is no time; {EXPECTED}")
    seconds[outside] = np.nan
    refused |= dict.fromkeys(map(int, np.flatnonzero(outside)), f"is no time; {EXPECTED}")
    return Times(seconds, assumed, zoneless, dict(sorted(refused.items())))


def read_numbers(values: FloatArray, *, dated: bool = True, strict: bool = True) -> Times:
    """POSIX seconds of numbers, by their size: in seconds or parts of it, or days of spreadsheets.

    Args:
        values: (N,) as they stand; NaN has no time.
        dated: As for `read_times`.
        strict: As for `read_times`.

    Raises:
        NotUnderstoodError: A number is no time, or of another unit than those before it.
    """
    rows = np.flatnonzero(~np.isnan(values))
    seconds = np.full(values.size, np.nan)
    if not rows.size:
        return Times(seconds)
    found = _posix_numbers(values[rows], rows, dated, strict)
    seconds[rows] = found.time_utc_s
    return Times(seconds, found.assumed, refused=found.refused)


def _is_number(text: str) -> bool:
    return len(text) <= _MOST_NUMBER and _NUMBER.fullmatch(text) is not None and not _basic(text)


def _basic(text: str) -> bool:
    """Whether a number is a date and a time without marks, 20240601100000."""
    whole = re.split("[.,]", text)[0]
    return len(whole) == 14 and whole[:2] in ("19", "20") and whole.isdigit()


def _posix_numbers(values: FloatArray, rows: IntArray, dated: bool, strict: bool) -> Times:
    for name, scale in _POSIX_UNITS:
        first_s = _FIRST_DATED_S if dated or scale > 1.0 else _FIRST_S
        fits = (values > first_s * scale) & (values < _LAST_S * scale)
        if not (fits[0] if strict else 2 * fits.sum() > fits.size):
            continue
        why = f"is no time in POSIX {name}, as others are; {EXPECTED}"
        if strict and not fits.all():
            raise NotUnderstoodError(int(rows[np.argmin(fits)]), why)
        said = () if name == "seconds" else (f"its times are taken for POSIX {name}",)
        refused = dict.fromkeys(map(int, rows[~fits]), why)
        return Times(np.where(fits, values / scale, np.nan), said, refused=refused)
    serial = (values >= _SERIAL_DAYS[0]) & (values <= _SERIAL_DAYS[1])
    most = serial.all() if strict else 2 * serial.sum() > serial.size
    if most and _are_serials(values[serial]):
        seconds = np.round((values - _SERIAL_EPOCH_DAYS) * _DAY_S, 4)
        why = f"is no day number of a spreadsheet, as others are; {EXPECTED}"
        return Times(
            np.where(serial, seconds, np.nan),
            ("its times are taken for the day numbers of a spreadsheet, in UTC",),
            refused=dict.fromkeys(map(int, rows[~serial]), why),
        )
    why = "is no time"
    if dated and 0.0 <= values[0] <= _FIRST_DATED_S:
        why = "has no date (seconds of a day, of a recording, or since another year than 1970?)"
    raise NotUnderstoodError(int(rows[0]), f"{why}; {EXPECTED}")


def _are_serials(values: FloatArray) -> bool:
    if values.size < 3 or (values % 1.0 == 0.0).all():
        return False
    return bool(np.median(np.abs(np.diff(values))) < _SERIAL_STEP)


def _texts(clean: pd.Series, rows: IntArray, strict: bool, day_first: bool | None) -> Times:
    """Times of texts that are no numbers; their rows are counted among ``rows``."""
    found: list[dict[str, str | None]] = []
    refused: dict[int, str] = {}
    for i, row in enumerate(rows):
        try:
            found.append(_match(clean[row], int(row)))
        except NotUnderstoodError as error:
            if strict:
                raise
            found.append({})
            refused[i] = error.why
    orders = _day_first(found, rows, day_first)
    seconds = np.full(rows.size, np.nan)
    for i, (parts, row) in enumerate(zip(found, rows, strict=True)):
        if i in refused:
            continue
        try:
            seconds[i] = _posix_s(parts, orders)
        except ValueError as error:
            why = f"is no time ({error}); {EXPECTED}"
            if strict:
                raise NotUnderstoodError(int(row), why) from error
            refused[i] = why
    said = () if orders is None else (f"its dates are read {_ORDERS[orders]}",)
    bare = any(parts.get("zoned") is None and parts.get("hour") for parts in found)
    return Times(seconds, said, bare, refused)


def _match(text: str, row: int) -> dict[str, str | None]:
    if len(text) <= _MOST_TEXT:
        for form in _FORMS:
            match = form.fullmatch(text)
            if match:
                return match.groupdict()
    why = f"is no time; {EXPECTED}"
    zone = _ZONE_NAME.fullmatch(text)
    if _NO_DATE.fullmatch(text):
        why = f"has no date; {EXPECTED}"
    elif _SHORT_YEAR.fullmatch(text):
        why = f"has a year of two digits; {EXPECTED}"
    elif zone and any(form.fullmatch(text[: zone.start("zone")].strip()) for form in _FORMS):
        why = f"names the zone {zone['zone']}, which has no offset of its own; {EXPECTED}"
    raise NotUnderstoodError(row, why)


def _day_first(
    found: list[dict[str, str | None]], rows: IntArray, usual: bool | None
) -> bool | None:
    """Whether dates of two small numbers have the day first; None where there are none."""
    dates = [
        (int(row), int(parts["first"] or 0), int(parts["next"] or 0), parts["mark"])
        for parts, row in zip(found, rows, strict=True)
        if parts.get("first")
    ]
    if not dates:
        return None
    days = [row for row, first, _, _ in dates if first > 12]
    months = [row for row, _, second, _ in dates if second > 12]
    if days and months:
        raise NotUnderstoodError(
            max(days[0], months[0]), f"has day and month in another order than others; {EXPECTED}"
        )
    if days or months:
        return bool(days)
    if usual is not None:
        return usual
    # With points the day comes first wherever dates are written so.
    unclear = [row for row, first, second, mark in dates if first != second and mark != "."]
    if unclear:
        raise NotUnderstoodError(
            unclear[0],
            "may have the day first or the month, and no other row tells; write the year first, as "
            "2020-09-30T19:36:24Z",
        )
    return True


def _posix_s(parts: dict[str, str | None], day_first: bool | None) -> float:
    """POSIX seconds of a text's parts; ValueError where they are no date or no time of day."""

    def number(name: str) -> int:
        return int(parts.get(name) or 0)

    if parts.get("first"):
        day, month = number("first"), number("next")
        if not day_first:
            day, month = month, day
    else:
        day = number("day")
        month = _month(parts["name"] or "") if parts.get("name") else number("month")
    whole_s = (date(number("year"), month, day).toordinal() - 719163) * 86400
    hour, minute, second = number("hour"), number("minute"), number("second")
    half = (parts.get("half") or "").lower()
    if half:
        if not 1 <= hour <= 12:
            raise ValueError(f"there is no hour {hour} {half}m")
        hour = hour % 12 + (12 if half == "p" else 0)
    # A leap second counts as the one after it; 24:00 ends a day.
    if hour > 24 or (hour == 24 and (minute or second)) or minute > 59 or second > 60:
        raise ValueError("there is no such time of day")
    fraction = parts.get("fraction") or parts.get("milli") or "0"
    zone_s = number("zone_hour") * 3600 + number("zone_minute") * 60
    if zone_s > 14 * 3600 or number("zone_minute") > 59:
        raise ValueError("there is no such zone")
    if (parts.get("sign") or "+") != "+":
        zone_s = -zone_s
    whole_s += hour * 3600 + minute * 60 + second - zone_s
    return whole_s + float(f"0.{fraction}")


def _month(name: str) -> int:
    lower = name.lower()
    if lower in _MONTHS:
        return _MONTHS.index(lower) + 1
    if lower in _MONTH_NAMES:
        return _MONTH_NAMES.index(lower) + 1
    if lower == "sept":
        return 9
    raise ValueError(f"{name} is no month in English")
