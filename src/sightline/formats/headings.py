"""Where a platform's bow pointed: from CSV logs with ``heading_deg``, and from NMEA 0183."""

from __future__ import annotations

import logging
import os
import re
from collections import Counter
from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files, _log_rows
from sightline.formats._log_table import is_log_table, read_log_table, zone_s
from sightline.formats._sentences import ReceptionClock, Sentence, SentenceReader
from sightline.formats.fixes_csv import newest_first
from sightline.formats.nmea import TIMED_KINDS, read_timed
from sightline.synchronisation import LARGEST_GAP_S, spread_times
from sightline.tally import Tally
from sightline.types import BoolArray, FloatArray, Headings, IntArray

_logger = logging.getLogger(__name__)

_KINDS = ("HDT", "THS", "HDG", "HDM")
_TRUE = ("HDT", "THS")
_NUMBER = re.compile(r"-?\d{1,3}(?:\.\d*)?")
_MAGNETIC = "magnetic headings (HDM, and HDG without variation)"
_NO_DEVIATION = "the deviation of the compass is not given (HDG); it is taken for none"
# A log that pauses has too few headings for its time.
_PAUSE = 1.5
_ALMOST_ALL = 0.9
_EMPTY = ("", "na", "n/a", "nan", "none", "null")


@dataclass(frozen=True)
class _Heading:
    order: int
    address: str
    heading_deg: float
    received_s: float
    deviation_untold: bool = False


def read_headings(path: str | os.PathLike[str], *, tally: Tally | None = None) -> Headings | None:
    """The headings that a log holds beside its places; None where it holds none.

    A table has them in a column ``heading_deg`` (or ``true_heading``); empty cells are left out. In
    NMEA 0183 they are HDT and THS (of mode A or E), and HDG with its variation, where there are
    none of these. They have no time. Where the logger wrote when it received each sentence, that
    tells it; otherwise those between two fixes share the time between them: a log that begins with
    a heading has it before its fix, and any other has the fix first. The times are of the sentences
    that the fixes come from; a ZDA of another clock is passed over. Of several sensors the one with
    most headings is used.

    Left out and counted are magnetic headings without a variation, THS of other modes, and what is
    damaged or no number. A compass that corrects its deviation itself leaves that field empty, as
    one does that knows of none: it is taken for none, and that is noted.

    Args:
        path: A log that `sightline.formats.read_fixes` reads.
        tally: Takes what was read and left out; None: what was left out is logged.

    Raises:
        InputError: A cell is no number, or the times of the headings do not increase.
    """
    own = Tally(path) if tally is None else tally
    found = (
        _in_table(path, own) if is_log_table(_files.beginning(path)) else _in_sentences(path, own)
    )
    if found is not None:
        own.count("headings", len(found))
    if tally is None:
        own.warn(_logger)
    return found


def _in_table(path: str | os.PathLike[str], tally: Tally) -> Headings | None:
    table = read_log_table(path, heading=True)
    if table.heading is None:
        return None
    given = table.heading[~table.heading.str.lower().isin(_EMPTY)]
    values = _files.floats(given)
    if 2 * np.isnan(values).sum() >= values.size > 0:
        _files.numbers(path, given)
    unread = ~np.isfinite(values)
    if unread.any():
        i = int(np.argmax(unread))
        row, text = f"line {given.index[i]}", str(given.iloc[i])
        tally.leave_out("with a heading that is no number", int(unread.sum()), row=row, text=text)
    title, when = str(table.time.name), table.time[given.index[~unread]]
    # What is wrong with times is said of the fixes.
    unsaid = Tally(path)
    times = _log_rows.row_times(
        path,
        when.index,
        when.tolist(),
        unsaid,
        title=title,
        zone_s=zone_s(path, table, when),
        day_first=table.day_first,
    )
    timed = np.isfinite(times)
    lines, times, values = when.index.to_numpy()[timed], times[timed], values[~unread][timed]
    if newest_first(times):
        lines, times, values = lines[::-1], times[::-1], values[::-1]
    kept = _log_rows.timely(path, lines, times, unsaid)
    return _headings(path, spread_times(times[kept]), values[kept])


def _in_sentences(path: str | os.PathLike[str], tally: Tally) -> Headings | None:
    reception = ReceptionClock()
    seen: list[_Heading] = []
    reader = SentenceReader(path, _KINDS, tally, "sentences with a heading")
    for sentence in reader:
        received_s = reception.time_s(sentence)
        value, reason = _true_deg(sentence)
        if value is None:
            tally.leave_out(reason, row=sentence.row, text=sentence.text)
        else:
            at_s = float("nan") if received_s is None else received_s
            untold = _without_deviation(sentence)
            seen.append(_Heading(sentence.order, sentence.address, value, at_s, untold))
    seen = _of_one_sensor(seen, tally)
    if any(heading.deviation_untold for heading in seen):
        tally.note(_NO_DEVIATION)
    found = None
    if seen:
        order = np.array([heading.order for heading in seen], dtype=np.int64)
        stamps_s = np.array([heading.received_s for heading in seen])
        times, outside = _times_s(path, order, stamps_s)
        tally.leave_out("headings long before the first fix or after the last", int(outside.sum()))
        values = np.array([heading.heading_deg for heading in seen])
        found = _headings(path, times[~outside], values[~outside])
    if reader.seen and found is None:
        tally.note("it holds no two headings that can be used; the course over ground is to do")
    return found


def _true_deg(sentence: Sentence) -> tuple[float | None, str]:
    """The true heading of a sentence, degrees, and why there is none."""
    fields = [text.strip() for text in (*sentence.fields, "", "", "", "", "")]
    kind = sentence.kind
    if kind == "THS" and fields[1] not in ("A", "E"):
        return None, f"THS in mode {fields[1][:1] or 'none'}, not A or E"
    if not fields[0]:
        return None, f"{kind} without a heading"
    if not _NUMBER.fullmatch(fields[0]) or not -360.0 <= float(fields[0]) <= 720.0:
        return None, f"{kind} with a heading that cannot be read"
    if kind == "HDM" or (kind == "HDT" and fields[1] == "M"):
        return None, _MAGNETIC
    heading = float(fields[0])
    if kind != "HDG":
        return heading % 360.0, ""
    deviation, variation = (fields[1], fields[2]), (fields[3], fields[4])
    for amount, side in (variation,) if _without_deviation(sentence) else (deviation, variation):
        if not _NUMBER.fullmatch(amount) or side not in ("E", "W"):
            return None, _MAGNETIC
        heading += float(amount) if side == "E" else -float(amount)
    return heading % 360.0, ""


def _without_deviation(sentence: Sentence) -> bool:
    return sentence.kind == "HDG" and not any(text.strip() for text in sentence.fields[1:3])


def _of_one_sensor(seen: list[_Heading], tally: Tally) -> list[_Heading]:
    """The headings of the sensor, and of the kind of sentence, with most of them."""
    numbers = Counter(heading.address for heading in seen)
    if len(numbers) < 2:
        return seen
    best = max(numbers, key=lambda address: (address[2:] in _TRUE, numbers[address]))
    for address, number in numbers.items():
        if address != best:
            tally.leave_out(f"headings of {address}, which {best} gives as well", number)
    return [heading for heading in seen if heading.address == best]


def _times_s(
    path: str | os.PathLike[str], order: IntArray, received_s: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """(H,) POSIX seconds of headings; and which lie too far outside of the fixes to tell.

    Args:
        path: The log.
        order: (H,) their places among its sentences.
        received_s: (H,) POSIX seconds at which the logger received them; NaN where unknown.
    """
    epochs = _epochs(path)
    if not epochs.time_s.size:
        return np.full(order.size, np.nan), np.ones(order.size, dtype=bool)
    late_s = epochs.time_s - epochs.received_s
    stamped = np.diff(received_s) > 0.0
    if np.isfinite(late_s).any() and stamped.sum() >= _ALMOST_ALL * stamped.size:
        # Both have lain in the same buffers for as long, whatever the logger's clock says.
        times = received_s + np.nanmedian(late_s)
    else:
        times = _shared_out_s(order, epochs)
    first_s, last_s = epochs.time_s[[0, -1]]
    return times, ~((times >= first_s - LARGEST_GAP_S) & (times <= last_s + LARGEST_GAP_S))


@dataclass(frozen=True, eq=False)
class _Epochs:
    """The sentences that tell the time of a log: of its fixes, and what speaks of the same times.

    Attributes:
        order: (E,) their places in the log.
        time_s: (E,) POSIX seconds, never decreasing.
        received_s: (E,) when the logger received them.
        first: The place of the first sentence of their kind, with or without a fix.
    """

    order: IntArray
    time_s: FloatArray
    received_s: FloatArray
    first: int


def _epochs(path: str | os.PathLike[str]) -> _Epochs:
    log = read_timed(path, Tally(path))
    dated = np.isfinite(log.time_utc_s)
    _, rows = log.stream()
    if not rows.any():
        rows = log.kind == TIMED_KINDS.index("ZDA")
    first = int(log.order[rows][0]) if rows.any() else 0
    rows = dated & (rows | np.isin(log.time_utc_s, log.time_utc_s[rows & dated]))
    time_s, fixes = log.time_utc_s[rows], log.quality[rows] > 0
    if fixes.any():
        # What tells a time without a fix may tell a wrong one.
        since_s = np.maximum.accumulate(np.where(fixes, time_s, -np.inf))
        until_s = np.minimum.accumulate(np.where(fixes, time_s, np.inf)[::-1])[::-1]
        kept = (time_s >= since_s) & (time_s <= until_s)
        kept &= np.isfinite(since_s) & np.isfinite(until_s)
    else:
        kept = time_s >= np.maximum.accumulate(time_s)
    return _Epochs(log.order[rows][kept], time_s[kept], log.received_s[rows][kept], first)


def _shared_out_s(order: IntArray, epochs: _Epochs) -> FloatArray:
    """(H,) POSIX seconds of headings that share the time from one epoch to the next.

    Args:
        order: (H,) their places in the log.
        epochs: At least one.
    """
    after = np.searchsorted(epochs.order, order)
    _, first, group, count = np.unique(
        after, return_index=True, return_inverse=True, return_counts=True
    )
    place, number = np.arange(order.size) - first[group], count[group]
    at_beginning, at_end = after == 0, after == epochs.order.size
    before_s = epochs.time_s[np.maximum(after - 1, 0)]
    after_s = epochs.time_s[np.minimum(after, epochs.order.size - 1)]
    span_s = after_s - before_s
    shared = span_s > 0.0
    usual_s = float(np.median((span_s / number)[shared])) if shared.any() else 0.0
    paused = span_s > _PAUSE * number * usual_s
    step_s = np.where(at_beginning | at_end | paused, usual_s, span_s / number)
    if order[0] < epochs.first:
        # Each heading, or the last of several, comes just before the fix that it belongs to.
        end_s = np.where(at_end, before_s + number * usual_s, after_s)
        return np.asarray(end_s - (number - 1 - place) * step_s)
    start_s = np.where(at_beginning, after_s - number * usual_s, before_s)
    return np.asarray(start_s + place * step_s)


def _headings(
    path: str | os.PathLike[str], times: FloatArray, heading_deg: FloatArray
) -> Headings | None:
    # Several under one time count as the last of them.
    last = np.append(np.diff(times) != 0.0, True)
    if times.size == 0 or last.sum() < 2:
        return None
    try:
        return Headings(times[last], heading_deg[last] % 360.0)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
