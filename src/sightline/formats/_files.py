"""What the readers share: opening files, reading tables, and naming the row that is at fault."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError
from sightline.text import xml_text as xml_text
from sightline.types import BoolArray, Fixes, FloatArray, StrArray, from_datetime64

_SNIFFED_BYTES = 65536
# What pandas takes for an empty cell of a column of numbers.
MISSING = (
    *("", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "-NaN", "-nan", "1.#IND"),
    *("1.#QNAN", "<NA>", "N/A", "NA", "NULL", "NaN", "None", "n/a", "nan", "null"),
)
_NO_INT64 = 2.0**63
# What fits into nanoseconds of 64 bits, with years to spare for what is computed from it.
FIRST_TIME, LAST_TIME = np.datetime64("1700-01-01"), np.datetime64("2250-01-01")


def existing(path: str | os.PathLike[str]) -> Path:
    """The path of a file that is there and has something in it.

    Raises:
        InputError: It is missing, a folder, empty, or may not be read.
    """
    found = Path(path)
    if found.is_dir():
        raise InputError(f"{path}: is a folder; expected a file")
    if not found.exists():
        raise InputError(f"{path}: there is no such file")
    if not os.access(found, os.R_OK):
        raise InputError(f"{path}: may not be read; check its permissions")
    if found.stat().st_size == 0:
        raise InputError(f"{path}: is empty")
    return found


def beginning(path: str | os.PathLike[str]) -> str:
    """The first 64 KB of a text file.

    Raises:
        InputError: As `existing`, or the file is binary.
    """
    with existing(path).open("rb") as file:
        head = file.read(_SNIFFED_BYTES)
    if b"\0" in head and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError(f"{path}: is not text; expected a log or a table")
    return head.decode("utf-8-sig", errors="replace")


def log_lines(path: str | os.PathLike[str]) -> Iterator[tuple[int, str]]:
    """Number (from 1) and text of each line of a log, one at a time.

    Bytes that are no text become question marks: noise on a serial line spoils a sentence, whose
    checksum tells, and not the log.
    """
    with existing(path).open(encoding="ascii", errors="replace") as file:
        yield from enumerate(file, start=1)


def table(
    path: str | os.PathLike[str],
    *,
    required: Sequence[str],
    optional: Sequence[str] | None = None,
    text: Sequence[str] = (),
    chunk_rows: int | None = None,
) -> Iterator[pd.DataFrame]:
    """The rows of a CSV file with a header, in chunks; the index is the line in the file.

    Args:
        path: The file.
        required: Columns that must be there.
        optional: Columns that may be there; None allows any.
        text: Columns to be left as text.
        chunk_rows: Rows a chunk; None: all at once.

    Raises:
        InputError: The file cannot be read as a table, or its columns are others.
    """
    beginning(path)
    try:
        form: dict[str, Any] = {
            "skipinitialspace": True,
            "skip_blank_lines": False,
            "encoding": "utf-8-sig",
        }
        header = pd.read_csv(existing(path), nrows=0, **form).columns
        # As it stands: somebody may be called "nan" or "NA".
        spoken = [name for name in header if str(name).strip() in text]
        reader = pd.read_csv(
            path,
            chunksize=chunk_rows or 2**62,
            dtype=dict.fromkeys(spoken, str),
            keep_default_na=False,
            na_values={name: [""] if name in spoken else list(MISSING) for name in header},
            low_memory=False,
            **form,
        )
        with reader:
            for chunk in reader:
                if not isinstance(chunk.index, pd.RangeIndex):
                    raise InputError(f"{path}: its rows have more cells than its header has names")
                chunk.columns = chunk.columns.astype(str).str.strip()
                _check_columns(path, list(chunk.columns), required, optional)
                chunk.index += 2
                # Blank lines keep their number and then go.
                yield chunk.dropna(how="all")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 ({error.reason})") from error
    except pd.errors.EmptyDataError as error:
        raise InputError(f"{path}: holds no table; expected {_header(required)}") from error
    except pd.errors.ParserError as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        raise InputError(f"{path}: is no table of comma-separated values ({reason})") from error


def _header(required: Sequence[str]) -> str:
    return f"a header with {','.join(required)}"


def _check_columns(
    path: str | os.PathLike[str],
    found: list[str],
    required: Sequence[str],
    optional: Sequence[str] | None,
) -> None:
    missing = [name for name in required if name not in found]
    if missing:
        raise InputError(
            f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; "
            f"found {shortened(', '.join(found), 300)}"
        )
    if optional is not None:
        unknown = [name for name in found if name not in (*required, *optional)]
        if unknown:
            raise InputError(
                f"{path}: unknown column {shortened(unknown[0])!r}; known are "
                f"{', '.join((*required, *optional))}"
            )


def refuse(
    path: str | os.PathLike[str],
    lines: ArrayLike,
    bad: BoolArray,
    values: ArrayLike,
    reason: str,
    *,
    row: str = "line",
) -> None:
    """Raise an error that names the first line at fault, if there is one.

    Args:
        path: The file.
        lines: (N,) numbers of the lines.
        bad: (N,) whether a line is at fault.
        values: (N,) what stands there, for the message.
        reason: What is wrong with it.
        row: What ``lines`` counts.
    """
    if bad.any():
        i = int(np.argmax(bad))
        what = shortened(str(np.asarray(values)[i]))
        raise InputError(f"{path}, {row} {np.asarray(lines)[i]}: {what} {reason}")


def shortened(text: str, most: int = 80) -> str:
    """A text that fits into a message."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def numbers(path: str | os.PathLike[str], column: pd.Series, *, row: str = "line") -> FloatArray:
    """A column as float64; what is not a finite number is refused by its line."""
    values = floats(column)
    bad = ~np.isfinite(values)
    refuse(path, column.index, bad, column, f"is no number ({column.name})", row=row)
    return values


def floats(column: pd.Series) -> FloatArray:
    """A column as float64, NaN for what is no number; integers beyond float64 are infinite."""
    try:
        return pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64, copy=True)
    except OverflowError:
        texts = column.astype(str)
        return pd.to_numeric(texts, errors="coerce").to_numpy(dtype=np.float64, copy=True)


def whole_numbers(
    path: str | os.PathLike[str], column: pd.Series, *, row: str = "line"
) -> NDArray[np.int64]:
    """A column as int64; what is not a whole number is refused by its line."""
    values = numbers(path, column, row=row)
    bad = values % 1 != 0
    refuse(path, column.index, bad, column, f"is no whole number ({column.name})", row=row)
    far = np.abs(values) >= _NO_INT64
    refuse(path, column.index, far, column, f"is too large a number ({column.name})", row=row)
    return values.astype(np.int64)


def times(
    path: str | os.PathLike[str],
    column: pd.Series,
    *,
    missing_allowed: bool = False,
    row: str = "line",
) -> FloatArray:
    """A column of ISO 8601 times (UTC where they name no zone) or POSIX seconds as POSIX seconds.

    Args:
        path: The file, for the message.
        column: Text or numbers; its index is the line.
        missing_allowed: Whether a cell may be empty; it becomes NaN.
        row: What its index counts.
    """
    empty = column.isna().to_numpy()
    seconds = floats(column)
    written = np.isnan(seconds) & ~empty
    if written.any():
        parsed = pd.to_datetime(column[written], utc=True, format="ISO8601", errors="coerce")
        stamps = parsed.dt.tz_localize(None).to_numpy()
        stamps = np.where(
            (stamps > FIRST_TIME) & (stamps < LAST_TIME), stamps, np.datetime64("NaT")
        )
        seconds[written] = from_datetime64(stamps)
    first_s, last_s = from_datetime64([FIRST_TIME, LAST_TIME])
    known = (seconds > first_s) & (seconds < last_s)
    bad = ~known & ~(empty & missing_allowed)
    refuse(
        path,
        column.index,
        bad,
        column,
        f"is no time ({column.name}); expected ISO 8601, as 2020-09-30T19:36:24Z, or POSIX seconds",
        row=row,
    )
    return seconds


def fixes(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    time_utc_s: ArrayLike,
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    *,
    name: str = "",
    row: str = "line",
) -> Fixes:
    """Fixes of a file, whose errors name the file and the row.

    Args:
        path: The file.
        rows: (N,) where in the file each fix stands.
        time_utc_s: (N,) POSIX seconds.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        name: Whose log it is.
        row: What ``rows`` counts.

    Raises:
        InputError: A place is not on the earth, or times decrease.
    """
    when, latitude, longitude = (
        np.asarray(values, dtype=np.float64) for values in (time_utc_s, latitude_deg, longitude_deg)
    )
    numbers = np.asarray(rows)
    bad = ~((np.abs(latitude) <= 90.0) & (np.abs(longitude) <= 180.0))
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{path}, {row} {numbers[i]}: latitude {latitude[i]:g}, longitude {longitude[i]:g} is "
            "not on the earth; latitudes lie within ±90 degrees, longitudes within ±180 "
            "(are the columns swapped?)"
        )
    backwards = np.diff(when) < 0.0
    if backwards.any():
        i = int(np.argmax(backwards)) + 1
        raise InputError(
            f"{path}, {row} {numbers[i]}: {rfc3339(when[i])} is earlier than the fix before it; "
            "the times of a log must not decrease"
        )
    return Fixes(when, latitude, longitude, name=name)


def milliseconds(time_utc_s: ArrayLike) -> NDArray[np.datetime64]:
    """POSIX seconds, rounded, as ``datetime64[ms]``."""
    return np.round(np.asarray(time_utc_s, dtype=float) * 1000.0).astype("datetime64[ms]")


def rfc3339(time_utc_s: ArrayLike) -> StrArray:
    """POSIX seconds as RFC 3339 text with milliseconds and ``Z``; (N,) gives (N,) str."""
    return np.char.add(np.datetime_as_string(milliseconds(time_utc_s)), "Z")
