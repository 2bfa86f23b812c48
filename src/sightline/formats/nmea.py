"""NMEA 0183: the log of a receiver on board."""

from __future__ import annotations

import logging
import os
import re
from array import array
from dataclasses import dataclass, field
from datetime import UTC, date, datetime, time

import numpy as np
import pynmea2

from sightline.errors import InputError
from sightline.formats import _files, _log_rows
from sightline.formats._receivers import Source, runs_beside
from sightline.formats._sentences import (
    DAY_S,
    FIRST_TIME_S,
    LAST_TIME_S,
    ReceptionClock,
    Sentence,
    SentenceReader,
    wrapped_s,
)
from sightline.formats._turns import by_turns
from sightline.tally import Tally
from sightline.types import BoolArray, Fixes, FloatArray, IntArray, utc_text

_logger = logging.getLogger(__name__)

FIX_KINDS = ("RMC", "GGA", "GNS", "GLL")
"""Kinds of sentences that give a place; of two that give as many fixes, the first is used."""
TIMED_KINDS = (*FIX_KINDS, "ZDA")
"""Kinds of sentences that give a time."""

# How good a fix is.
_NONE, _ESTIMATED, _MEASURED = 0, 1, 2
# How far the date of a sentence is trusted: a receiver without a fix may not have it yet.
_UNDATED, _DATE_WITHOUT_FIX, _DATE_OF_CLOCK, _DATE_OF_FIX = range(4)

_ROLLOVER_S = 1024 * 7 * DAY_S
# Nobody films for long with what has a date of so long ago.
_OLD_S = datetime(2010, 1, 1, tzinfo=UTC).timestamp()
_OUT_OF_ORDER = 0.1
_TAG_SOURCE = re.compile(r"(?:^|,)s:([^,*]{1,60})")


@dataclass(frozen=True, eq=False)
class TimedSentences:
    """The sentences of a log that give a time, in their order.

    Attributes:
        order: (N,) int64, their places in the log; see `Sentence.order`.
        line: (N,) int64, from 1.
        kind: (N,) int64, place in `TIMED_KINDS`.
        receiver: (N,) str, the talker, and its source where a TAG block names it.
        time_utc_s: (N,) float64; NaN where nothing gives the date.
        received_s: (N,) float64, when the logger received them; NaN where unknown.
        latitude_deg: (N,) float64; NaN without a place.
        longitude_deg: (N,) float64.
        quality: (N,) int64, whether the fix is none, estimated or measured.
    """

    order: IntArray
    line: IntArray
    kind: IntArray
    receiver: np.ndarray
    time_utc_s: FloatArray
    received_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    quality: IntArray

    def stream(self) -> tuple[int, BoolArray]:
        """The kind of sentence to be used, and the rows (N,) of that kind and of one receiver.

        Talkers of one kind are one receiver where they take turns (``GP``, ``GL``, ``GA``), and
        several where they speak of the same times, or of times between those of another.
        """
        best, best_rows, most = 0, np.zeros(self.line.size, dtype=bool), -1
        for kind in range(len(FIX_KINDS)):
            rows = self._receiver((self.kind == kind) & np.isfinite(self.time_utc_s))
            measured = int((rows & (self.quality == _MEASURED)).sum())
            fixes = measured or int((rows & (self.quality == _ESTIMATED)).sum())
            if fixes > most:
                best, best_rows, most = kind, rows, fixes
        return best, best_rows

    def _receiver(self, rows: BoolArray) -> BoolArray:
        """Of the rows of a kind those of the receiver that has most fixes."""
        fixes: BoolArray = rows & (self.quality > _NONE)
        measured: BoolArray = rows & (self.quality == _MEASURED)
        if measured.any():
            fixes = measured
        names, counts = np.unique(self.receiver[fixes], return_counts=True)
        if names.size < 2:
            return self._of_one_turn(rows, fixes)
        names = names[np.argsort(-counts, kind="stable")]
        kept = self._of_one_turn(rows & (self.receiver == names[0]), fixes)
        # The others are held against it alone: a line of several has more fixes than theirs.
        line = self._source(kept & fixes)
        for name in names[1:]:
            more = rows & (self.receiver == name)
            both_s = self.time_utc_s[(kept | more) & fixes]
            backwards = (np.diff(both_s) < 0.0).mean() > _OUT_OF_ORDER
            own = self._source(more & fixes)
            if not backwards and not runs_beside(line, own, same_times_are_two=True):
                kept |= more
        return kept

    def _of_one_turn(self, rows: BoolArray, fixes: BoolArray) -> BoolArray:
        """Of the rows of a name those of one receiver, where several write by turns."""
        told = np.flatnonzero(rows & fixes)
        turn = by_turns(
            Source(self.time_utc_s[told], self.latitude_deg[told], self.longitude_deg[told])
        )
        if not turn.any():
            return rows
        counts = np.bincount(turn)
        kept = rows & fixes
        kept[told[turn != turn[np.argmax(counts[turn] == counts.max())]]] = False
        return kept

    def _source(self, rows: BoolArray) -> Source:
        return Source(
            self.time_utc_s[rows], self.latitude_deg[rows], self.longitude_deg[rows]
        ).sorted_by_time()


@dataclass
class _Columns:
    order: array[int] = field(default_factory=lambda: array("q"))
    line: array[int] = field(default_factory=lambda: array("q"))
    kind: array[int] = field(default_factory=lambda: array("b"))
    receiver: list[str] = field(default_factory=list)
    of_day_s: array[float] = field(default_factory=lambda: array("d"))
    midnight_s: array[float] = field(default_factory=lambda: array("d"))
    trust: array[int] = field(default_factory=lambda: array("b"))
    received_s: array[float] = field(default_factory=lambda: array("d"))
    latitude_deg: array[float] = field(default_factory=lambda: array("d"))
    longitude_deg: array[float] = field(default_factory=lambda: array("d"))
    quality: array[int] = field(default_factory=lambda: array("b"))


def read_nmea(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Fixes:
    """The positions in a log of NMEA 0183 sentences.

    RMC gives time, date and place. RMC without a date, GGA, GNS and GLL take it from the RMC or ZDA
    nearest to them, over midnight as well; where there is none, from the times at which the logger
    received them, if these stand in a TAG block or beside the sentences. ZDA is UTC, whatever zone
    it names. Where a log has several kinds, that with most fixes is used, so that no fix counts
    twice, and of receivers that ran at the same time (talkers, or sources that a TAG block names)
    that with most.

    Left out and counted are sentences with a wrong checksum, without one in a log that has them,
    without a fix, or with a place or time that cannot be read. Anything may stand around a
    sentence: quotes, times, TAG blocks.

    Args:
        path: The log; read line by line.
        tally: Takes what was read and left out; None: what was left out is logged.

    Raises:
        InputError: No sentence gives a fix, or times decrease.
    """
    own = Tally(path) if tally is None else tally
    own.format = "NMEA 0183"
    log = read_timed(path, own)
    kind, rows = log.stream()
    name = FIX_KINDS[kind]
    others = (log.kind == kind) & ~rows & (log.quality > _NONE) & np.isfinite(log.time_utc_s)
    for receiver in np.unique(log.receiver[others]).tolist():
        which = others & (log.receiver == receiver)
        shown = _files.shortened(receiver)
        row = f"line {log.line[int(np.argmax(which))]}"
        reason = f"{name} of another receiver ({shown})"
        if (rows & (log.receiver == receiver)).any():
            reason = f"{name} of another receiver of the same name ({shown})"
            own.note(
                f"two receivers of one name ({shown}) wrote into it by turns; that with most fixes "
                "is used, of as many the first: log each by itself, or with its source in a TAG "
                "block (s:), to choose"
            )
        own.leave_out(reason, int(which.sum()), row=row)
    fixes = rows & (log.quality == _MEASURED)
    estimated = rows & (log.quality == _ESTIMATED)
    if fixes.any():
        first = int(np.argmax(estimated))
        own.leave_out(
            f"{name} that are estimated, entered or simulated, not measured",
            int(estimated.sum()),
            row=f"line {log.line[first]}",
        )
    elif estimated.any():
        fixes = estimated
        own.note("none of its fixes is measured; all are estimated, entered or simulated")
    if not fixes.any():
        raise InputError(f"{path}: {_why_none(log, own)}")
    found = _log_rows.fixes(
        path,
        log.line[fixes],
        log.time_utc_s[fixes],
        log.latitude_deg[fixes],
        log.longitude_deg[fixes],
        tally=own,
    )
    own.count("fixes", len(found))
    if tally is None:
        own.warn(_logger)
    return found


def read_timed(path: str | os.PathLike[str], tally: Tally) -> TimedSentences:
    """All sentences of a log that give a time, with their dates.

    Args:
        path: The log.
        tally: Takes what was read, left out and assumed.
    """
    reader = SentenceReader(path, TIMED_KINDS, tally, "sentences")
    reception = ReceptionClock()
    columns = _Columns()
    for sentence in reader:
        received_s = reception.time_s(sentence)
        reason = _add(columns, sentence, float("nan") if received_s is None else received_s)
        if reason:
            tally.leave_out(f"{sentence.kind} {reason}", row=sentence.row, text=sentence.text)
    return TimedSentences(
        order=np.array(columns.order, dtype=np.int64),
        line=np.array(columns.line, dtype=np.int64),
        kind=np.array(columns.kind, dtype=np.int64),
        receiver=np.array(columns.receiver, dtype=np.str_),
        time_utc_s=_dated(columns, tally),
        received_s=np.array(columns.received_s, dtype=np.float64),
        latitude_deg=np.array(columns.latitude_deg, dtype=np.float64),
        longitude_deg=np.array(columns.longitude_deg, dtype=np.float64),
        quality=np.array(columns.quality, dtype=np.int64),
    )


def clock_s(sentence: Sentence) -> float | None:
    """POSIX seconds of an RMC or ZDA; None where it does not tell them."""
    parsed = pynmea2.parse(f"${sentence.body}")
    day_s, since_midnight_s = _midnight_s(parsed), _of_day_s(parsed)
    if day_s is None or since_midnight_s is None:
        return None
    if sentence.kind == "RMC" and _quality(parsed, "RMC") == _NONE:
        return None
    return day_s + since_midnight_s


def _midnight_s(sentence: pynmea2.TalkerSentence) -> float | None:
    """POSIX seconds of the day that an RMC or ZDA names; None where it names none that can be."""
    try:
        day = sentence.datestamp
        if not isinstance(day, date):
            return None
        start_s = datetime.combine(day, time(tzinfo=UTC)).timestamp()
    except (TypeError, ValueError, OverflowError):
        return None
    return start_s if FIRST_TIME_S <= start_s < LAST_TIME_S else None


def _of_day_s(sentence: pynmea2.TalkerSentence) -> float | None:
    """Seconds since midnight that a sentence tells; None where it tells none."""
    clock = sentence.timestamp
    if not isinstance(clock, time):
        return None
    return clock.hour * 3600 + clock.minute * 60 + clock.second + clock.microsecond * 1e-6


def _add(columns: _Columns, sentence: Sentence, received_s: float) -> str:
    """Take a sentence in; what is returned says why it gives no fix (or, of ZDA, no date)."""
    parsed = pynmea2.parse(f"${sentence.body}")
    kind = sentence.kind
    since_midnight_s = _of_day_s(parsed)
    quality, place, reason = _NONE, (float("nan"), float("nan")), ""
    if kind != "ZDA":
        quality = _quality(parsed, kind)
        if quality == _NONE:
            reason = "without a fix"
        else:
            place, reason = _place(parsed)
    day_s = _midnight_s(parsed) if kind in ("RMC", "ZDA") else None
    if since_midnight_s is None:
        return reason or (
            "with a time that cannot be read" if _written(parsed) else "without a time"
        )
    if kind == "ZDA" and day_s is None:
        return "with an impossible date"
    columns.order.append(sentence.order)
    columns.line.append(sentence.line)
    columns.kind.append(TIMED_KINDS.index(kind))
    source = _TAG_SOURCE.search(sentence.tag)
    columns.receiver.append(sentence.talker + (f", {source[1]}" if source else ""))
    columns.of_day_s.append(since_midnight_s)
    columns.midnight_s.append(float("nan") if day_s is None else day_s)
    columns.trust.append(_trust(kind, quality, day_s))
    columns.received_s.append(received_s)
    columns.latitude_deg.append(place[0])
    columns.longitude_deg.append(place[1])
    columns.quality.append(_NONE if reason else quality)
    return reason


def _written(parsed: pynmea2.TalkerSentence) -> bool:
    return bool(str(parsed.timestamp or "").strip())


def _trust(kind: str, quality: int, day_s: float | None) -> int:
    if day_s is None:
        return _UNDATED
    if kind == "ZDA":
        return _DATE_OF_CLOCK
    return _DATE_WITHOUT_FIX if quality == _NONE else _DATE_OF_FIX


def _quality(parsed: pynmea2.TalkerSentence, kind: str) -> int:
    """Whether a fix is none, estimated (or entered by hand, or simulated) or measured."""
    if kind == "GGA":
        grade = str(parsed.gps_qual or 0)
        if grade in ("6", "7", "8"):
            return _ESTIMATED
        return _MEASURED if grade.isdigit() and grade != "0" else _NONE
    if kind == "GNS":
        # One letter a constellation, and N for one that has no share in the fix.
        modes = set(str(parsed.mode_indicator).strip())
        if modes & set("ADFPR"):
            return _MEASURED
        return _ESTIMATED if modes & set("EMS") else _NONE
    status = str(parsed.status).strip()
    # GLL had no status before NMEA 0183 2.0.
    if status != "A" and not (kind == "GLL" and not status):
        return _NONE
    mode = str(parsed.faa_mode if kind == "GLL" else parsed.mode_indicator).strip()[:1]
    if mode == "N":
        return _NONE
    return _ESTIMATED if mode in ("E", "M", "S") else _MEASURED


def _place(parsed: pynmea2.TalkerSentence) -> tuple[tuple[float, float], str]:
    """Latitude and longitude, degrees, and why there are none."""
    none = (float("nan"), float("nan"))
    texts = [str(parsed.lat).strip(), str(parsed.lon).strip()]
    signs = [str(parsed.lat_dir).strip(), str(parsed.lon_dir).strip()]
    if not all(texts):
        return none, "without a place"
    if signs[0] not in ("N", "S") or signs[1] not in ("E", "W"):
        return none, "without a hemisphere"
    try:
        latitude, longitude = map(_degrees, texts)
    except ValueError:
        return none, "with a place that cannot be read"
    if latitude > 90.0 or longitude > 180.0:
        return none, "with a place that is not on the earth"
    if latitude == 0.0 and longitude == 0.0:
        return none, "at 0° north, 0° east, which receivers write that have no fix"
    return (
        -latitude if signs[0] == "S" else latitude,
        -longitude if signs[1] == "W" else longitude,
    ), ""


def _degrees(text: str) -> float:
    """Degrees of ``dddmm.mmmm``."""
    whole, _, fraction = text.partition(".")
    if not (whole + fraction).isdecimal() or not (whole + fraction).isascii() or len(whole) > 5:
        raise ValueError(text)
    minutes = float(f"{whole[-2:] or 0}.{fraction or 0}")
    if minutes >= 60.0:
        raise ValueError(text)
    return float(whole[:-2] or 0) + minutes / 60.0


def _dated(columns: _Columns, tally: Tally) -> FloatArray:
    """(N,) POSIX seconds of sentences; NaN where nothing gives the date."""
    clock_s = np.array(columns.of_day_s, dtype=np.float64)
    received_s = np.array(columns.received_s, dtype=np.float64)
    trust = np.array(columns.trust, dtype=np.int64)
    times_s = np.array(columns.midnight_s, dtype=np.float64) + clock_s
    if not clock_s.size:
        return times_s
    undated = np.isnan(times_s)
    if undated.any():
        given = np.flatnonzero((trust == trust.max()) & ~undated)
        given_s = times_s[given]
        if not given.size:
            given = np.flatnonzero(np.isfinite(received_s))
            given_s = received_s[given] + wrapped_s(clock_s[given] - received_s[given] % DAY_S)
            if given.size:
                tally.note(
                    "its dates are those of the times at which its logger received the sentences"
                )
        if given.size:
            times_s[undated] = _nearest(clock_s, given, given_s)[undated]
    return times_s + _rolled_over_s(times_s, received_s, tally)


def _nearest(clock_s: FloatArray, given: IntArray, given_s: FloatArray) -> FloatArray:
    """(N,) POSIX seconds of times of day, by the times of some of them.

    Args:
        clock_s: (N,) times of day, in the order of the log.
        given: (K,) rows whose time is known, at least one.
        given_s: (K,) their times.
    """
    # Days go by where a log has no date for long; after a break the next date may tell more.
    since_s = np.cumsum(np.append(clock_s[0], wrapped_s(np.diff(clock_s))))
    after = np.searchsorted(given, np.arange(clock_s.size))
    before = np.maximum(after - 1, 0)
    after = np.minimum(after, given.size - 1)
    back_s, ahead_s = since_s - since_s[given[before]], since_s - since_s[given[after]]
    near = np.where(
        np.abs(back_s) <= np.abs(ahead_s), given_s[before] + back_s, given_s[after] + ahead_s
    )
    return np.asarray(np.round((near - clock_s) / DAY_S) * DAY_S + clock_s)


def _rolled_over_s(times_s: FloatArray, received_s: FloatArray, tally: Tally) -> float:
    """What is to be added to dates that are whole turns of the GPS week number too early."""
    off_s = received_s - times_s
    off_s = off_s[np.isfinite(off_s)]
    if off_s.size:
        median_s = float(np.median(off_s))
        turns = round(median_s / _ROLLOVER_S)
        if turns < 1 or abs(median_s - turns * _ROLLOVER_S) > DAY_S:
            return 0.0
        tally.note(
            f"its dates are {1024 * turns} weeks before those at which its logger received them: "
            "the week number of the receiver has rolled over, and they are taken as so much later"
        )
        return turns * _ROLLOVER_S
    known = times_s[np.isfinite(times_s)]
    if known.size and known.max() < _OLD_S:
        first_s = float(known.min())
        tally.note(
            f"its first fix is dated {utc_text(first_s)[:10]}; a receiver whose week number has "
            f"rolled over writes that for {utc_text(first_s + _ROLLOVER_S)[:10]}, 1024 weeks later"
        )
    return 0.0


def _why_none(log: TimedSentences, tally: Tally) -> str:
    undated = np.isnan(log.time_utc_s) & (log.quality > _NONE)
    if undated.any():
        kinds = " and ".join(FIX_KINDS[kind] for kind in np.unique(log.kind[undated]))
        return (
            f"its {int(undated.sum())} {kinds} sentences have no date, and there is no RMC with a "
            "date and no ZDA sentence to give it; log one of these as well"
        )
    if tally.left_out:
        return f"no sentence gives a fix; left out: {tally.reasons()}"
    return "holds no RMC, GGA, GNS or GLL sentence"
