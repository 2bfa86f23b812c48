"""Ways to spoil a text, with and without regard to its lines, cells, sentences and tags."""

from __future__ import annotations

import bz2
import gzip
import lzma
import re
from collections.abc import Callable
from functools import partial

import numpy as np

from fuzz.examples import with_checksum

Rng = np.random.Generator
Mutator = Callable[[Rng, bytes], bytes]

NUMBERS = (
    *("0", "-0", "-1", "1", "0.5", "1e308", "-1e308", "9e999", "1e-320", "nan", "-nan", "inf"),
    *("-inf", "Infinity", "NaN", "null", "None", "", " ", "-", "+5", "1,5", "1_000", "0x10"),
    *("90.0000001", "-180", "180", "181", "360", "999", "65536", "2147483648", "4294967296"),
    *("9223372036854775807", "9223372036854775808", "18446744073709551616", "1" + "0" * 40),
    *("1" + "0" * 400, "0." + "3" * 400, "٣٤", "１２", "1e5", "1E+5", "TRUE", "12px", "½"),
)
"""What may stand where a number is meant."""

TIMES = (
    *("2024-06-01T10:00:00Z", "2024-06-01 10:00:00", "2024-06-01T10:00:00+02:00", "10:00:00"),
    *("0000-00-00T00:00:00Z", "0001-01-01T00:00:00Z", "9999-12-31T23:59:59Z", "1970-01-01"),
    *("2024-02-30T10:00:00Z", "2024-06-01T24:00:00Z", "2024-06-01T23:59:60Z", "2024-W22-6"),
    *("2024-06-01T10:00:00+99:00", "01.06.2024 10:00", "20240601T100000Z", "NaT", "now"),
    *("1717236000", "1717236000000", "1717236000000000", "-1717236000", "99999999999999", "1e20"),
    *("2024-06-01T10:00:00.123456789Z", "2024-06-01T10:00Z", " 2024-06-01T10:00:00Z ", "2024"),
)
"""What may stand where a time is meant."""

WORDS = (
    *("", " ", "a" * 5000, "NA", "nan", "-", "0", "<b>&amp;</b>", "]]>", "<![CDATA[", "$x^2$"),
    *(
        "$\\frac{$",
        "%s%n",
        "{0}",
        "../../x",
        "a\nb",
        "\x00",
        "\x1b[31m",
        "\u202e",
        "\ufeff",
        "=1+1",
    ),
    *('"', "'", "\\", ",", ";", "\ud800", "\udcff", "é", "船", "🚤" * 50, "\x85", "\u2028"),
)
"""What may stand where a word is meant."""

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(?::\d\d(?:\.\d+)?)?(?:Z|[+-]\d\d:?\d\d)?")
_MOST = 4_000_000


def decoded(content: bytes) -> str:
    """A text whose bytes come back as they were, whatever they are."""
    return content.decode("utf-8", "surrogateescape")


def encoded(text: str) -> bytes:
    """The bytes of a text; what no UTF-8 may hold is written all the same."""
    try:
        return text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        return text.encode("utf-8", "surrogatepass")


def pick(rng: Rng, values: tuple[str, ...] | list[str]) -> str:
    """One of some texts."""
    return values[int(rng.integers(len(values)))]


def _index(rng: Rng, length: int) -> int:
    """A position in something, its ends more often than they come."""
    end = rng.random()
    if length < 2 or end < 0.1:
        return 0
    return length - 1 if end > 0.9 else int(rng.integers(length))


def _of_lines(change: Callable[[Rng, list[str]], list[str]]) -> Mutator:
    def mutate(rng: Rng, content: bytes) -> bytes:
        return encoded("".join(change(rng, decoded(content).splitlines(keepends=True))))

    mutate.__name__ = change.__name__.removeprefix("_")
    return mutate


def _drop_line(rng: Rng, lines: list[str]) -> list[str]:
    at = _index(rng, len(lines))
    return lines[:at] + lines[at + 1 :]


def _double_line(rng: Rng, lines: list[str]) -> list[str]:
    at = _index(rng, len(lines))
    return lines[:at] + lines[at : at + 1] * int(rng.integers(2, 30)) + lines[at + 1 :]


def _swap_lines(rng: Rng, lines: list[str]) -> list[str]:
    one, other = _index(rng, len(lines)), _index(rng, len(lines))
    if lines:
        lines[one], lines[other] = lines[other], lines[one]
    return lines


def _shuffle_lines(rng: Rng, lines: list[str]) -> list[str]:
    return [lines[i] for i in rng.permutation(len(lines))]


def _reverse_lines(_: Rng, lines: list[str]) -> list[str]:
    return lines[:1] + lines[:0:-1]


def _first_lines(rng: Rng, lines: list[str]) -> list[str]:
    return lines[: int(rng.integers(0, 4))]


def _repeat_all(rng: Rng, lines: list[str]) -> list[str]:
    return lines[:1] + lines[1:] * int(rng.integers(2, 12))


def _blank_line(rng: Rng, lines: list[str]) -> list[str]:
    at = _index(rng, len(lines))
    return [*lines[:at], pick(rng, ["\n", ",,,,\n", " \n", "#\n", "\x00\n"]), *lines[at:]]


def _foreign_line(rng: Rng, lines: list[str]) -> list[str]:
    at = _index(rng, len(lines))
    return [*lines[:at], pick(rng, list(WORDS)) + "\n", *lines[at:]]


def _long_line(rng: Rng, lines: list[str]) -> list[str]:
    at = _index(rng, len(lines))
    return [*lines[:at], pick(rng, ["x", "1,", '"', "<", "[", "$GP"]) * 200_000, *lines[at:]]


LINES: tuple[Mutator, ...] = tuple(
    map(
        _of_lines,
        (
            _drop_line,
            _double_line,
            _swap_lines,
            _shuffle_lines,
            _reverse_lines,
            _first_lines,
            _repeat_all,
            _blank_line,
            _foreign_line,
            _long_line,
        ),
    )
)


def _replaced(rng: Rng, text: str, pattern: re.Pattern[str], values: tuple[str, ...]) -> str:
    """A text with one match replaced, or now and then some, or all by the same."""
    found = list(pattern.finditer(text))
    if not found:
        return text
    value = pick(rng, values)
    if rng.random() < 0.05:
        return pattern.sub(lambda _: value, text)
    rows = sorted({_index(rng, len(found)) for _ in range(int(rng.integers(1, 4)))}, reverse=True)
    for row in rows:
        start, stop = found[row].span()
        text = text[:start] + value + text[stop:]
    return text


def number(rng: Rng, content: bytes) -> bytes:
    """A number becomes another, or none."""
    return encoded(_replaced(rng, decoded(content), _NUMBER, NUMBERS))


def moment(rng: Rng, content: bytes) -> bytes:
    """A time becomes another, or none."""
    return encoded(_replaced(rng, decoded(content), _TIME, TIMES))


def digit(rng: Rng, content: bytes) -> bytes:
    """Some digits become others."""
    text = list(decoded(content))
    digits = [i for i, letter in enumerate(text) if letter.isdigit()]
    for _ in range(int(rng.integers(1, 6)) if digits else 0):
        text[digits[int(rng.integers(len(digits)))]] = pick(rng, list("0123456789.- "))
    return encoded("".join(text))


def letter(rng: Rng, content: bytes) -> bytes:
    """A letter is put in, or one is replaced."""
    text = decoded(content)
    at = _index(rng, len(text) + 1)
    return encoded(text[:at] + pick(rng, list(WORDS)) + text[at + int(rng.integers(2)) :])


def line_ends(rng: Rng, content: bytes) -> bytes:
    """Lines end in another way."""
    end = pick(rng, ["\r\n", "\r", "\n\n", "\x0b", "\x85", "\u2028", "\r\r\n", ""])
    return encoded(end.join(decoded(content).splitlines()))


def encoding(rng: Rng, content: bytes) -> bytes:
    """The text in another encoding, or with a mark that does not fit."""
    text = decoded(content)
    name = pick(rng, ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32", "latin-1", "mark"])
    if name == "mark":
        return b"\xff\xfe" + content
    return text.replace("1", "\u00b9", 1).encode(name, "replace")


def cut(rng: Rng, content: bytes) -> bytes:
    """The end is missing, or the beginning."""
    at = int(rng.integers(len(content) + 1))
    return content[:at] if rng.random() < 0.7 else content[at:]


def compressed(rng: Rng, content: bytes) -> bytes:
    """As a compressed file under the name of one that is not."""
    # What gzip compresses otherwise tells when it did.
    how = [partial(gzip.compress, mtime=0), bz2.compress, lzma.compress][int(rng.integers(3))]
    return bytes(how(content))


TEXT: tuple[Mutator, ...] = (
    *(number, number, number, moment, moment, digit, letter, line_ends, encoding, cut, compressed),
    *LINES,
)
"""For any text."""


# Tables of separated values.


def _of_cells(change: Callable[[Rng, list[list[str]]], list[list[str]]]) -> Mutator:
    def mutate(rng: Rng, content: bytes) -> bytes:
        rows = [line.split(",") for line in decoded(content).splitlines()]
        return encoded("\n".join(",".join(row) for row in change(rng, rows)) + "\n")

    mutate.__name__ = change.__name__.removeprefix("_")
    return mutate


def _column(rng: Rng, rows: list[list[str]]) -> int:
    return _index(rng, len(rows[0])) if rows else 0


def _drop_column(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    at = _column(rng, rows)
    return [row[:at] + row[at + 1 :] for row in rows]


def _double_column(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    at = _column(rng, rows)
    return [row[: at + 1] + row[at:] for row in rows]


def _swap_columns(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    one, other = _column(rng, rows), _column(rng, rows)
    for row in rows[int(rng.integers(2)) :]:
        if max(one, other) < len(row):
            row[one], row[other] = row[other], row[one]
    return rows


def _fill_column(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    at, value = _column(rng, rows), pick(rng, [*NUMBERS, *TIMES, *WORDS])
    for row in rows[1:]:
        if at < len(row):
            row[at] = value
    return rows


def _cell(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    for _ in range(int(rng.integers(1, 4))):
        row = rows[_index(rng, len(rows))] if rows else []
        if row:
            row[_index(rng, len(row))] = pick(rng, [*NUMBERS, *TIMES, *WORDS])
    return rows


def _rename(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    names = ["", "frame", "time_utc", "label", "x1", "latitude_deg", "lat", "Unnamed: 0", "target"]
    names += ["heading_deg", "track_id", "annotator", "confidence", "id", "0", *WORDS]
    if rows and rows[0]:
        rows[0][_column(rng, rows)] = pick(rng, names)
    return rows


def _no_header(_: Rng, rows: list[list[str]]) -> list[list[str]]:
    return rows[1:]


def _ragged(rng: Rng, rows: list[list[str]]) -> list[list[str]]:
    at = _index(rng, len(rows))
    if rows:
        extra = [pick(rng, list(NUMBERS))] * int(rng.integers(1, 5))
        rows[at] = rows[at] + extra if rng.random() < 0.5 else rows[at][:-1]
    return rows


def delimiter(rng: Rng, content: bytes) -> bytes:
    """Another letter between the cells."""
    return content.replace(b",", encoded(pick(rng, [";", "\t", " ", "|", ", ", ",,", '","'])))


TABLE: tuple[Mutator, ...] = (
    *map(
        _of_cells,
        (
            _drop_column,
            _double_column,
            _swap_columns,
            _fill_column,
            _fill_column,
            _cell,
            _cell,
            _cell,
            _rename,
            _no_header,
            _ragged,
        ),
    ),
    delimiter,
    *TEXT,
)
"""For tables of comma-separated values."""


# NMEA 0183 and AIS: what is changed must pass the checksum to be looked at.

_SENTENCE = re.compile(r"[$!][A-Z]{5},[^*\r\n]*\*[0-9A-F]{2}")
_ARMOUR = "0123456789:;<=>?@ABCDEFGHIJKLMNOPQRSTUVW`abcdefghijklmnopqrstuvw"


def _of_sentence(change: Callable[[Rng, list[str]], list[str]]) -> Mutator:
    def mutate(rng: Rng, content: bytes) -> bytes:
        text = decoded(content)
        found = list(_SENTENCE.finditer(text))
        count = len(found) if rng.random() < 0.1 else int(rng.integers(1, 4))
        rows = {_index(rng, len(found)) for _ in range(count)} if found else set()
        for row in sorted(rows, reverse=True):
            start, stop = found[row].span()
            sentence = ",".join(change(rng, found[row][0].split("*")[0].split(",")))
            text = text[:start] + with_checksum(sentence) + text[stop:]
        return encoded(text)

    mutate.__name__ = change.__name__.removeprefix("_")
    return mutate


def _field(rng: Rng, fields: list[str]) -> list[str]:
    at = _index(rng, len(fields))
    values = [*NUMBERS, "N", "S", "E", "A", "V", "T", "235960.00", "246060", "000000", "5460.0"]
    values += ["310299", "000000", "320124", "99999.99", "18000.00", "05419.398"]
    fields[at] = pick(rng, values)
    return fields


def _field_dropped(rng: Rng, fields: list[str]) -> list[str]:
    at = _index(rng, len(fields))
    return fields[:at] + fields[at + 1 :]


def _field_doubled(rng: Rng, fields: list[str]) -> list[str]:
    at = _index(rng, len(fields))
    return fields[: at + 1] + fields[at:]


def _sentence_cut(rng: Rng, fields: list[str]) -> list[str]:
    return fields[: int(rng.integers(1, len(fields) + 1))]


def _talker(rng: Rng, fields: list[str]) -> list[str]:
    kinds = ["RMC", "GGA", "ZDA", "HDT", "THS", "HDG", "VDM", "VDO", "GLL", "RMB"]
    fields[0] = fields[0][:3] + pick(rng, kinds)
    return fields


def _payload(rng: Rng, fields: list[str]) -> list[str]:
    if len(fields) > 5:
        text = list(fields[5])
        for _ in range(int(rng.integers(1, 6)) if text else 0):
            text[_index(rng, len(text))] = pick(rng, list(_ARMOUR))
        if rng.random() < 0.3:
            text = text[: int(rng.integers(len(text) + 1))]
        fields[5] = "".join(text)
    return fields


def _parts(rng: Rng, fields: list[str]) -> list[str]:
    if len(fields) > 3:
        at = int(rng.integers(1, 4))
        fields[at] = pick(rng, ["", "0", "1", "2", "3", "9", "10", "99", "-1", "x"])
    return fields


SENTENCES: tuple[Mutator, ...] = (
    *map(_of_sentence, (_field, _field, _field, _field_dropped, _field_doubled, _sentence_cut)),
    *map(_of_sentence, (_talker, _field)),
    *TEXT,
)
"""For NMEA 0183."""

AIS: tuple[Mutator, ...] = (
    *map(_of_sentence, (_payload, _payload, _payload, _parts, _parts, _field, _field_dropped)),
    *map(_of_sentence, (_sentence_cut, _talker)),
    *TEXT,
)
"""For AIS."""


# XML: tags, attributes, and what stands between them.

_ATTRIBUTE = re.compile(r'(?<==")[^"]*(?=")')
_BETWEEN = re.compile(r"(?<=>)[^<>\s][^<>]*(?=<)")
_TAG = re.compile(r"</?[A-Za-z][^<>]*>")
_NAME = re.compile(r"(?<=[</])[A-Za-z][\w:]*")


def attribute(rng: Rng, content: bytes) -> bytes:
    """The value of an attribute becomes another."""
    return encoded(_replaced(rng, decoded(content), _ATTRIBUTE, (*NUMBERS, *TIMES, *WORDS)))


def between(rng: Rng, content: bytes) -> bytes:
    """What stands between two tags becomes something else."""
    return encoded(_replaced(rng, decoded(content), _BETWEEN, (*TIMES, *NUMBERS, *WORDS)))


def tag(rng: Rng, content: bytes) -> bytes:
    """A tag is lost, or becomes something else."""
    values = ("", "<x>", "</x>", "<trkpt>", "<trk>", "</trk>", "<!-- ", "<![CDATA[", "<?x?>")
    return encoded(_replaced(rng, decoded(content), _TAG, (*values, "<time/>", "<a:b>", "&a;")))


def tag_name(rng: Rng, content: bytes) -> bytes:
    """A kind of tag has another name everywhere."""
    text = decoded(content)
    names = sorted(set(_NAME.findall(text)))
    if not names:
        return content
    new = pick(rng, ["x", "gpx:time", "rte", "rtept", "wpt", "trk", "trkseg", "number", "a:b:c"])
    return encoded(re.sub(rf"(?<=[</]){re.escape(pick(rng, names))}\b", new, text))


def nested(rng: Rng, content: bytes) -> bytes:
    """Something in the text stands a thousand levels deep."""
    text = decoded(content)
    at = _index(rng, len(text))
    levels = int(10 ** rng.uniform(1.0, 5.0))
    left, right = (("<x>", "</x>"), ("[", "]"), ('{"a":', "}"), ("(", ")"))[int(rng.integers(4))]
    return encoded(text[:at] + left * levels + "0" + right * levels + text[at:])[:_MOST]


def entities(rng: Rng, content: bytes) -> bytes:
    """A document type, with entities that grow or that name a file."""
    grown = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 9))
    kinds = [
        f'<!DOCTYPE gpx [<!ENTITY a0 "aaaaaaaaaa">{grown}]>',
        '<!DOCTYPE gpx [<!ENTITY a8 SYSTEM "file:///etc/hostname">]>',
        '<!DOCTYPE gpx SYSTEM "http://127.0.0.1:9/a.dtd">',
    ]
    text = re.sub(r"(?<=>)[^<>\s][^<>]*(?=</name>)", "&a8;", decoded(content))
    return encoded(re.sub(r"(<\?xml[^>]*\?>)?", rf"\1{pick(rng, kinds)}", text, count=1))


XML: tuple[Mutator, ...] = (
    *(attribute, attribute, attribute, between, between, between, tag, tag, tag_name, nested),
    *(entities, *TEXT),
)
"""For GPX and KML."""


# TOML: keys and values.

_VALUE = re.compile(r"(?<== )[^\n#]+")
_KEY = re.compile(r"^[a-z_]+(?= =)", re.MULTILINE)


def value(rng: Rng, content: bytes) -> bytes:
    """A value becomes another, of another type as well."""
    values = [*NUMBERS[:24], "true", '""', "[]", "{}", "[[1]]", '"\\u0000"', '"."', '".."', '"/"']
    values += ["2024-06-01T10:00:00Z", "0001-01-01T00:00:00Z", "10:00:00", "2024-06-01", "[1, 2]"]
    values += ["[0, 0]", "[1e9, 1e9]", "[nan, nan]", '"nothing.csv"', f'"{"a" * 5000}"', "1" * 5000]
    values += ['"still"', '"/dev/zero"', '"http://127.0.0.1:9/x"', "[-1, 5]", "9" * 25, '"\\uD800"']
    return encoded(_replaced(rng, decoded(content), _VALUE, tuple(values)))


def key(rng: Rng, content: bytes) -> bytes:
    """A key becomes another."""
    keys = ["name", "video", "frames", "start_utc", "clock", "boxes", "detections", "fixes", "mmsi"]
    keys += ["platform", "horizon", "water_level_m", "control_points", "image_size_px", "a.b.c"]
    keys += [
        "watched",
        "compensate_rotation",
        '""',
        "latitude_deg",
        "pixel_px",
        "[x]",
        "=",
        "camera",
    ]
    return encoded(_replaced(rng, decoded(content), _KEY, tuple(keys)))


TOML: tuple[Mutator, ...] = (value, value, value, value, key, key, nested, *TEXT)
"""For scene files."""
