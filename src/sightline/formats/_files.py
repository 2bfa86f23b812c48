"""What the readers share: opening files, reading tables, and naming the row that is at fault."""

from __future__ import annotations

import codecs
import logging
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError
from sightline.formats._times import EXPECTED, NotUnderstoodError, Times, read_numbers, read_times
from sightline.synchronisation import repeated
from sightline.tally import Tally
from sightline.text import xml_text as xml_text
from sightline.types import BoolArray, FloatArray, StrArray

_logger = logging.getLogger(__name__)

_SNIFFED_BYTES = 65536
_MOST_COLUMNS = 1000
_LOOKED_AT_ROWS = 20
_SENTENCE = re.compile(rb"[$!][A-Z]{5},[0-9A-Z.,*-]{6}")
# What pandas takes for an empty cell of a column of numbers.
MISSING = (
    *("", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "-NaN", "-nan", "1.#IND"),
    *("1.#QNAN", "<NA>", "N/A", "NA", "NULL", "NaN", "None", "n/a", "nan", "null"),
)
_MOST_COLUMNS = 2000
# Times in steps of two seconds or more that three fixes share, or a single one that many do.
_COARSEST_S, _MANY, _MOST_A_SECOND = 2.0, 3, 10
# gzip, zip (also of spreadsheets), xz, bzip2, Zstandard.
_PACKED = (b"\x1f\x8b", b"PK\x03\x04", b"\xfd7zXZ", b"BZh", b"\x28\xb5\x2f\xfd")
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
    if head.startswith(_PACKED):
        raise InputError(
            f"{path}: is a compressed file or a spreadsheet; unpack it, or save as text"
        )
    encoding = text_encoding(head)
    # A logger that lost power leaves zeros among its sentences.
    if b"\0" in head and not encoding.startswith("utf-16") and not _SENTENCE.search(head):
        raise InputError(f"{path}: is not text; expected a log or a table")
    return head.decode(encoding, errors="replace").lstrip("\ufeff")


def text_encoding(head: bytes) -> str:
    """The encoding that the first bytes of a text tell: UTF-16, also without a mark, or UTF-8."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    for encoding, zeros, letters in (("utf-16-le", 1, 0), ("utf-16-be", 0, 1)):
        if len(head) > 3 and not any(head[zeros:200:2]) and all(head[letters:200:2]):
            return encoding
    return "utf-8-sig"


def whole_text(path: str | os.PathLike[str], most_bytes: int) -> str:
    """A text file as a whole: UTF-8 or UTF-16, else of a Western Windows.

    Args:
        path: The file.
        most_bytes: A larger file is refused.

    Raises:
        InputError: As `beginning`, or the file is too large.
    """
    beginning(path)
    if existing(path).stat().st_size > most_bytes:
        raise InputError(f"{path}: is larger than {most_bytes // 2**20} MiB; split it")
    data = existing(path).read_bytes()
    encoding = text_encoding(data[:_SNIFFED_BYTES])
    try:
        return data.decode(encoding).lstrip("\ufeff")
    except UnicodeDecodeError:
        return data.decode("cp1252" if encoding == "utf-8-sig" else encoding, errors="replace")


def log_lines(path: str | os.PathLike[str]) -> Iterator[tuple[int, str]]:
    """Number (from 1) and text of each line of a log, one at a time.

    Bytes that are no text become question marks: noise on a serial line spoils a sentence, whose
    checksum tells, and not the log.
    """
    with existing(path).open("rb") as file:
        head = file.read(_SNIFFED_BYTES)
    encoding = text_encoding(head)
    encoding = encoding if encoding.startswith("utf-16") else "ascii"
    with existing(path).open(encoding=encoding, errors="replace") as file:
        if head.startswith(codecs.BOM_UTF8):
            file.read(len(codecs.BOM_UTF8))
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
    check_width(path, _header(required))
    try:
        form = _form(path, required)
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
                chunk.index += 2 + form["skiprows"]
                # Blank lines keep their number and then go.
                yield chunk.dropna(how="all")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text in UTF-8 ({error.reason})") from error
    except OverflowError as error:
        raise InputError(f"{path}: holds a number that is too large") from error
    except pd.errors.EmptyDataError as error:
        raise InputError(f"{path}: holds no table; expected {_header(required)}") from error
    except pd.errors.ParserError as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        raise InputError(f"{path}: is no table of comma-separated values ({reason})") from error


def check_width(path: str | os.PathLike[str], expected: str) -> None:
    """Refuse what has far more cells in a row than any table: each costs pandas time and memory.

    Args:
        path: The file.
        expected: What a table would have, for the message.

    Raises:
        InputError: One of the first rows is so wide.
    """
    for number, line in enumerate(beginning(path).splitlines()[:_LOOKED_AT_ROWS], start=1):
        if max(map(line.count, ",;\t")) > _MOST_COLUMNS:
            raise InputError(
                f"{path}, line {number}: has more than {_MOST_COLUMNS} cells; expected {expected}"
            )


def _form(path: str | os.PathLike[str], required: Sequence[str]) -> dict[str, Any]:
    """How a table is written, for pandas: its encoding, and what parts cells and decimals."""
    with existing(path).open("rb") as file:
        data = file.read(_SNIFFED_BYTES)
    encoding = text_encoding(data)
    lines = data.decode(encoding, errors="replace").lstrip("\ufeff").splitlines()
    comments = next((i for i, line in enumerate(lines) if not line.startswith("#")), 0)
    header, *rows = lines[comments : comments + _LOOKED_AT_ROWS] or [""]
    separator = ","
    for other in (";", "\t"):
        if set(required) <= {name.strip(' "') for name in header.split(other)} and other in header:
            separator = other
    if header.count(separator) >= _MOST_COLUMNS:
        raise InputError(f"{path}: has more than {_MOST_COLUMNS:,} columns; is it a table?")
    text = "\n".join(rows)
    comma = separator == ";" and re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text)
    return {
        "skipinitialspace": True,
        "skip_blank_lines": False,
        "encoding": encoding,
        "sep": separator,
        "decimal": "," if comma else ".",
        "skiprows": comments,
        # A file is what it says, and unpacks into nothing larger.
        "compression": None,
    }


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
        what = shortened(cell(np.asarray(values)[i]))
        raise InputError(f"{path}, {row} {np.asarray(lines)[i]}: {what} {reason}")


def shortened(text: str, most: int = 80) -> str:
    """A text that fits into a message of one line."""
    cut = text if len(text) <= most else f"{text[: most - 3]}..."
    line = " ".join(cut.split())
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


def numbers(path: str | os.PathLike[str], column: pd.Series, *, row: str = "line") -> FloatArray:
    """A column as float64; what is not a finite number is refused by its line."""
    values = floats(column)
    bad = ~np.isfinite(values)
    refuse(path, column.index, bad, column, f"is no number ({column.name})", row=row)
    return values


def floats(column: pd.Series) -> FloatArray:
    """A column as float64; NaN where there is no number, infinite where it is beyond float64."""
    if not pd.api.types.is_numeric_dtype(column) or column.dtype == bool:
        # What pandas takes for true and false are words.
        column = column.where(~column.map(lambda one: isinstance(one, bool)).astype(bool))
    try:
        return pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64, copy=True)
    except OverflowError:
        return np.array([_float(cell) for cell in column])


def _float(cell: Any) -> float:
    try:
        return float(cell)
    except OverflowError:
        return float("inf")
    except (TypeError, ValueError):
        return float("nan")


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
    dated: bool = False,
    zone_told: bool = True,
    tally: Tally | None = None,
    row: str = "line",
) -> FloatArray:
    """A column of times as POSIX seconds; see `sightline.formats._times` for what is understood.

    Args:
        path: The file, for the message.
        column: Text or numbers; its index is the line.
        missing_allowed: Whether a cell may be empty; it becomes NaN.
        dated: Whether numbers of before 2000 are refused, as seconds of a day.
        zone_told: Whether the column's name says that its times are in UTC.
        tally: Takes what was assumed of how they are written.
        row: What its index counts.
    """
    empty = column.isna().to_numpy(dtype=bool)
    if not missing_allowed:
        refuse(
            path, column.index, empty, column, f"is no time ({column.name}); {EXPECTED}", row=row
        )
    try:
        if pd.api.types.is_numeric_dtype(column):
            read = read_numbers(column.to_numpy(dtype=np.float64), dated=dated)
        else:
            texts = ["" if gone else cell(one) for gone, one in zip(empty, column, strict=True)]
            read = read_times(texts, dated=dated)
    except NotUnderstoodError as error:
        line, said = column.index[error.row], shortened(cell(column.iloc[error.row]))
        why = error.why.replace("is no time", f"is no time ({column.name})", 1)
        raise InputError(f"{path}, {row} {line}: {said} {why}") from error
    if tally is not None:
        note_how_read(read, tally, zone_told=zone_told)
    return read.time_utc_s


def note_how_read(read: Times, tally: Tally, *, zone_told: bool) -> None:
    """Note what was assumed of how times are written, and a zone that nothing names.

    Args:
        read: The times.
        tally: Takes the notes.
        zone_told: Whether something beside them says that they are in UTC.
    """
    for sentence in read.assumed:
        tally.note(sentence)
    if read.zoneless and not zone_told:
        tally.note("its times name no zone and are taken for UTC")


def cell(value: object) -> str:
    """A cell as it stands; Python writes out no number of over 4,300 digits."""
    try:
        return str(value)
    except ValueError:
        return "a number of thousands of digits"
    except NotImplementedError:
        return "a time that no calendar has"


def check_order(
    path: str | os.PathLike[str], rows: ArrayLike, time_utc_s: FloatArray, *, row: str = "line"
) -> None:
    """Raise an error that names the first row whose time is earlier than that of the row before.

    Args:
        path: The file.
        rows: (N,) where in the file each time stands.
        time_utc_s: (N,) POSIX seconds.
        row: What ``rows`` counts.
    """
    backwards = np.diff(time_utc_s) < 0.0
    if backwards.any():
        i = int(np.argmax(backwards)) + 1
        raise InputError(
            f"{path}, {row} {np.asarray(rows)[i]}: {rfc3339(time_utc_s[i])} is earlier than the "
            "fix before it; the times of a log must not decrease: cut it there if it is of two "
            "receivers, or of a clock that was set back"
        )


def check_digits(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    texts: Sequence[str],
    time_s: FloatArray,
    latitude_deg: FloatArray,
    longitude_deg: FloatArray,
    *,
    row: str = "line",
) -> None:
    """Raise an error where times were rounded so that many places share each of them.

    Args:
        path: The file.
        rows: (N,) where in the file each fix stands.
        texts: (N,) the times as they stand.
        time_s: (N,) POSIX seconds.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        row: What ``rows`` counts.
    """
    once = ~repeated(time_s, latitude_deg, longitude_deg)
    times, count = np.unique(time_s[once], return_counts=True)
    shared, most = int(count[count > 1].sum()), int(count.max(initial=0))
    if 2 * shared <= once.sum() or np.median(count) < _MANY:
        return
    step_s = float(np.diff(times).min()) if times.size > 1 else float(most > _MOST_A_SECOND) * most
    if step_s >= _COARSEST_S:
        i = int(np.argmax(time_s == times[np.argmax(count)]))
        raise InputError(
            f"{path}, {row} {np.asarray(rows)[i]}: {shortened(texts[i])} is the time of {most} "
            "different places; the times were rounded, write them with all their digits"
        )


def check_places(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    latitude_deg: FloatArray,
    longitude_deg: FloatArray,
    *,
    row: str = "line",
) -> None:
    """Raise an error that names the first row whose place is not on the earth.

    Args:
        path: The file.
        rows: (N,) where in the file each place stands.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        row: What ``rows`` counts.
    """
    bad = ~((np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0))
    if bad.any():
        i = int(np.argmax(bad))
        raise InputError(
            f"{path}, {row} {np.asarray(rows)[i]}: latitude {latitude_deg[i]:g}, longitude "
            f"{longitude_deg[i]:g} is not on the earth; latitudes lie within ±90 degrees, "
            "longitudes within ±180 (are the columns swapped?)"
        )


def milliseconds(time_utc_s: ArrayLike) -> NDArray[np.datetime64]:
    """POSIX seconds, rounded, as ``datetime64[ms]``."""
    return np.round(np.asarray(time_utc_s, dtype=float) * 1000.0).astype("datetime64[ms]")


def rfc3339(time_utc_s: ArrayLike) -> StrArray:
    """POSIX seconds as RFC 3339 text with milliseconds and ``Z``; (N,) gives (N,) str."""
    return np.char.add(np.datetime_as_string(milliseconds(time_utc_s)), "Z")
