"""NMEA 0183 sentences, wherever they stand in the lines of a log."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import xor

import numpy as np
from numpy.typing import ArrayLike

from sightline.formats import _files
from sightline.tally import Tally
from sightline.types import FloatArray

DAY_S = 86400.0
FIRST_TIME_S = datetime(1980, 1, 6, tzinfo=UTC).timestamp()
"""When the time of GPS begins; what is dated earlier has no date."""
LAST_TIME_S = datetime(2100, 1, 1, tzinfo=UTC).timestamp()

NO_CHECKSUM = "its sentences have no checksum, so that nothing tells which of them are damaged"

# $P... is proprietary: $PGRMC is no RMC. What ends a sentence without a checksum stands in none.
_SENTENCE = re.compile(
    r"(?P<start>[$!])"
    r"(?:(?P<body>(?!P)[A-Z][A-Z0-9][A-Z]{3},[^$!*\"\r\n]*)"
    r"\*(?P<checksum>[0-9A-Fa-f]{2}|[0-9A-Fa-f](?![0-9A-Za-z]))"
    r"|(?P<bare>(?!P)[A-Z][A-Z0-9][A-Z]{3},[^$!*\"'\s\\|]*))"
)
_TAG = re.compile(r"\\([^\\$!]*)\\[\"' ]*$")
_TAG_TIME = re.compile(r"(?:^|,)c:([0-9.]+)")
_ISO_TIME = re.compile(
    r"(?P<year>\d{4})[-/](?P<month>\d{2})[-/](?P<day>\d{2})(?:T|[ ,;_]+)"
    r"(?P<clock>\d{2}:\d{2}:\d{2}(?:\.\d+|,\d{3}(?=[\s\]]))?)"
    r"(?P<zone> ?(?:Z|UTC|GMT|[+-]\d{2}:?\d{2}))?"
)
_COMPACT_TIME = re.compile(
    r"(?<!\d)(?P<year>\d{4})(?P<month>\d{2})(?P<day>\d{2})[T_ -]?"
    r"(?P<clock>\d{6}(?:\.\d+)?)(?P<zone>Z)?(?!\d)"
)
_POSIX_TIME = re.compile(r"(?<![\w.])(\d{16}|\d{13}|\d{10}(?:\.\d+)?)(?![\w.])")
_LONGEST_TIME = 20
_MOST_AROUND = 500


@dataclass(frozen=True, slots=True)
class Sentence:
    """A sentence in a line of a log.

    Attributes:
        line: Number of the line, from 1.
        column: Where in the line it begins, from 0.
        text: As it stands, from ``$`` or ``!`` to the checksum.
        address: Talker and kind: ``GPRMC``.
        fields: What follows the address.
        whole: Whether its checksum is right; None where it has none.
        tag: The TAG block before it, or ``""``.
        ahead: What stands before the first sentence of the line.
        between: What stands between the sentence before in the line and this one.
        after: What stands between it and the next sentence, or the end of the line.
    """

    line: int
    column: int
    text: str
    address: str
    fields: tuple[str, ...]
    whole: bool | None
    tag: str
    ahead: str
    between: str
    after: str

    @property
    def talker(self) -> str:
        """The two letters of what spoke: ``GP``."""
        return self.address[:2]

    @property
    def kind(self) -> str:
        """The three letters of what it says: ``RMC``."""
        return self.address[2:]

    @property
    def order(self) -> int:
        """A number that grows from sentence to sentence of a log."""
        return (self.line << 32) + self.column

    @property
    def row(self) -> str:
        """Its line, for a message."""
        return f"line {self.line}"

    @property
    def body(self) -> str:
        """What the checksum is of."""
        return ",".join((self.address, *self.fields))


class SentenceReader:
    """The sentences of some kinds in a log; those that are damaged are left out and counted.

    A log that has checksums has them in every sentence: what has none is cut short. Where no
    sentence has one, all are read, and a note says so.
    """

    def __init__(
        self, path: str | os.PathLike[str], kinds: tuple[str, ...], tally: Tally, things: str
    ) -> None:
        """Prepare to read.

        Args:
            path: The log; read line by line.
            kinds: Three letters each.
            tally: Takes what is counted and left out.
            things: What they are counted as, by the plural.
        """
        self._path, self._kinds, self._tally, self._things = path, frozenset(kinds), tally, things
        self._checked = any(sentence.whole is not None for sentence in self._all())
        self.seen = 0

    def __iter__(self) -> Iterator[Sentence]:
        """The sentences, in their order."""
        for sentence in self._all():
            self.seen += 1
            self._tally.count(self._things)
            if sentence.whole is False:
                self._leave_out(f"{self._things} with a wrong checksum", sentence)
            elif sentence.whole is None and self._checked:
                self._leave_out(f"{self._things} without a checksum", sentence)
            else:
                yield sentence
        if self.seen and not self._checked:
            self._tally.note(NO_CHECKSUM)

    def _all(self) -> Iterator[Sentence]:
        for line, text in _files.log_lines(self._path):
            yield from sentences_in(line, text, self._kinds)

    def _leave_out(self, reason: str, sentence: Sentence) -> None:
        self._tally.leave_out(reason, row=sentence.row, text=sentence.text)


def sentences_in(line: int, text: str, kinds: frozenset[str]) -> Iterator[Sentence]:
    """The sentences of some kinds in a line, damaged ones among them.

    Args:
        line: Its number.
        text: What stands in it.
        kinds: Three letters each.
    """
    if "$" not in text and "!" not in text:
        return
    matches = list(_SENTENCE.finditer(text))
    ends = [match.start() for match in matches[1:]] + [len(text)]
    for i, (match, end) in enumerate(zip(matches, ends, strict=False)):
        body = match["body"] or match["bare"]
        if body[2:5] not in kinds:
            continue
        ahead = text[max(0, matches[0].start() - _MOST_AROUND) : matches[0].start()]
        begin = max(matches[i - 1].end(), match.start() - _MOST_AROUND) if i else 0
        between = text[begin : match.start()] if i else ""
        after = text[match.end() : min(end, match.end() + _MOST_AROUND)]
        tag = _TAG.search(between if i else ahead)
        address, *fields = body.split(",")
        yield Sentence(
            line=line,
            column=match.start(),
            text=match[0],
            address=address,
            fields=tuple(fields),
            whole=_whole(body, match["checksum"]),
            tag=tag[1] if tag else "",
            ahead=_TAG.sub("", ahead),
            between=_TAG.sub("", between),
            after=_TAG.sub("", after),
        )


def _whole(body: str, checksum: str | None) -> bool | None:
    if checksum is None:
        return None
    return reduce(xor, map(ord, body), 0) == int(checksum, 16)


class ReceptionClock:
    """Times at which a logger received sentences, from TAG blocks or from what stands around them.

    Attributes:
        unreadable: What looks like a time and is none, the first of them, and its line.
        zoneless: Whether a time names no zone, and was taken for UTC.
    """

    def __init__(self) -> None:
        self.unreadable = ("", "")
        self.zoneless = False
        self._line = 0
        self._of_line_s: float | None = None

    def time_s(self, sentence: Sentence) -> float | None:
        """POSIX seconds; None where nothing tells.

        A time at the beginning of a line is of all sentences in it.
        """
        tagged = _TAG_TIME.search(sentence.tag)
        if tagged:
            return self._plausible(_posix_s(tagged[1]), tagged[1], sentence)
        if sentence.line != self._line:
            self._line = sentence.line
            self._of_line_s = self._written_s(sentence.ahead, sentence)
        if self._of_line_s is None:
            return self._written_s(sentence.after, sentence)
        if sentence.between:
            own_s = self._written_s(sentence.between, sentence)
            self._of_line_s = self._of_line_s if own_s is None else own_s
        return self._of_line_s

    def _written_s(self, text: str, sentence: Sentence) -> float | None:
        if not any(map(str.isdigit, text)):
            return None
        iso = _ISO_TIME.search(text)
        if iso:
            return self._plausible(self._iso_s(iso), iso[0], sentence)
        compact = _COMPACT_TIME.search(text)
        found_s = self._iso_s(compact) if compact else None
        if found_s is not None and FIRST_TIME_S <= found_s < LAST_TIME_S:
            return found_s
        posix = _POSIX_TIME.search(text)
        return self._plausible(_posix_s(posix[1]), posix[1], sentence) if posix else None

    def _iso_s(self, match: re.Match[str]) -> float | None:
        year, month, day, clock, zone = match.group("year", "month", "day", "clock", "zone")
        if ":" not in clock:
            clock = f"{clock[:2]}:{clock[2:4]}:{clock[4:]}"
        offset = "Z" if zone and zone.strip() in ("UTC", "GMT") else (zone or "").strip()
        try:
            moment = datetime.fromisoformat(
                f"{year}-{month}-{day}T{clock.replace(',', '.')}{offset}"
            )
        except ValueError:
            return None
        if moment.tzinfo is None:
            self.zoneless = True
            moment = moment.replace(tzinfo=UTC)
        return moment.timestamp()

    def _plausible(self, time_s: float | None, text: str, sentence: Sentence) -> float | None:
        if time_s is not None and FIRST_TIME_S <= time_s < LAST_TIME_S:
            return time_s
        if not self.unreadable[0]:
            self.unreadable = (text, sentence.row)
        return None


def _posix_s(digits: str) -> float | None:
    """POSIX seconds, from seconds, or whole milli- or microseconds."""
    if len(digits) > _LONGEST_TIME:
        return None
    try:
        number = float(digits)
    except ValueError:
        return None
    if digits.isdigit() and len(digits) >= 13:
        return number / (1e3 if len(digits) < 16 else 1e6)
    return number


def wrapped_s(seconds: ArrayLike) -> FloatArray:
    """Differences of times of day, from minus to plus half a day."""
    return np.asarray((np.asarray(seconds) + DAY_S / 2.0) % DAY_S - DAY_S / 2.0)
