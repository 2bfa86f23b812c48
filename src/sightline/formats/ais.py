"""AIS: the positions that vessels broadcast, as a receiver logged them."""

from __future__ import annotations

import logging
import math
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Any

import numpy as np
import pyais
import pyais.exceptions
import pyais.messages

from sightline.errors import InputError
from sightline.formats import _files, _log_rows
from sightline.formats._ais_messages import Message, MessageStream, read_messages
from sightline.formats._ais_table import Report, read_table_reports
from sightline.formats._log_table import is_vessel_table
from sightline.formats._sentences import ReceptionClock
from sightline.formats._turns import by_clock
from sightline.plausibility import distance_m
from sightline.tally import Tally
from sightline.types import Fixes, FloatArray, IntArray

_logger = logging.getLogger(__name__)

# Types 2 and 3 are of the class of type 1.
_POSITION_REPORTS = (
    pyais.messages.MessageType1,
    pyais.messages.MessageType18,
    pyais.messages.MessageType19,
    pyais.messages.MessageType27,
)
# Up to the second of the minute, or what comes last before it.
_LEAST_BITS = {1: 143, 2: 143, 3: 143, 18: 139, 19: 139, 27: 94}
# By the first letter of a payload, which is its type (5, 19, 24): up to the end of the dimensions.
_STATIC_BITS = {"5": 270, "C": 301, "H": 162}
_SIDES = ("bow", "stern", "port", "starboard")
_UNTIMED = "position reports without a time of reception"
_KNOT_MPS = 1852.0 / 3600.0
_LONG_RANGE = 27
_FEWEST_FINE = 2

# Networks bring what one station heard and another so much later; their clocks keep to that.
_AGAIN_S = 20.0
_CLOCKS_APART_S = 10.0

# How far reports may lie from what the one before leads to, on top of what its speed does.
_PLACE_M = 30.0
_TIME_S = 3.0
_CHANGE_MPS = 5.0
_ACCELERATION_MPS2 = 0.1
_FASTEST_MPS = 55.0
_ANOTHER_VESSEL = 3
_MOST_NAMED = 5
_MOST_WAYS = 64


@dataclass(frozen=True, eq=False)
class AisVessel:
    """What a receiver logged of one vessel.

    Attributes:
        fixes: Its positions; their name is the MMSI.
        velocity_mps: (N, 2) float64, east and north, from the speed and the course over ground of
            each report; NaN where a report does not tell them.
        sigma_m: (N,) float64, standard deviation of each position along either axis; None where
            nobody tells it.
    """

    fixes: Fixes
    velocity_mps: FloatArray
    sigma_m: FloatArray | None = None


def read_ais(path: str | os.PathLike[str], *, tally: Tally | None = None) -> dict[int, Fixes]:
    r"""The positions of all vessels in a log of AIS sentences (``!AIVDM``, ``!AIVDO``), by MMSI.

    Used are the position reports of types 1, 2, 3, 18, 19 and 27. AIS messages carry the second
    of their minute at most, so each line needs the time of its reception: in a TAG block
    (``\c:1601494584*hh\``), or before or after the sentence, as ISO 8601 or POSIX seconds; where
    there is none, that of the RMC or ZDA before it will do. Where a report tells its second, the
    fix is at that second of the minute nearest to the reception. Reports arrive late and by several
    stations, so fixes are put in order, and repeats count once. Where receivers whose clocks are
    apart wrote into one log by turns, those of that with most reports are kept.

    A table with a column ``mmsi``, as of MarineCadastre or of the Danish Maritime Authority, is
    read as well, with its own times.

    The parts of a message are put together by their number, id, channel, talker and station, and
    only where they come close to each other. Left out and counted are parts whose others are
    missing, sentences with a wrong checksum, and reports without a place or a time. Where two
    vessels use the same MMSI, the reports of that with more of them are kept.

    Args:
        path: The log; read line by line.
        tally: Takes what was read and left out; None: what was left out is logged.

    Raises:
        InputError: No report is usable, or none has a time.
    """
    return {mmsi: vessel.fixes for mmsi, vessel in read_ais_feed(path, tally=tally).items()}


def read_ais_feed(
    path: str | os.PathLike[str], *, tally: Tally | None = None
) -> dict[int, AisVessel]:
    """As `read_ais`, with the velocities that the reports tell.

    Args:
        path: The log.
        tally: As for `read_ais`.

    Raises:
        InputError: As `read_ais`.
    """
    own = Tally(path) if tally is None else tally
    vessels = _vessels(path, own)
    feed = _feed(path, vessels, sorted(vessels), own)
    if tally is None:
        own.warn(_logger)
    return feed


def read_ais_vessel(
    path: str | os.PathLike[str], mmsi: int | None, *, tally: Tally | None = None
) -> Fixes:
    """The positions of one vessel in a log of AIS sentences, or in a table with their MMSIs.

    Args:
        path: The log.
        mmsi: The vessel; None where the log is of one alone.
        tally: As for `read_ais`.

    Raises:
        InputError: As `read_ais`; the vessel is not in the log; or there are several and none is
            chosen. The message lists those that there are.
    """
    own = Tally(path) if tally is None else tally
    vessels = _vessels(path, own)
    if mmsi is None and len(vessels) == 1:
        mmsi = next(iter(vessels))
    if mmsi not in vessels:
        most = sorted(sorted(vessels), key=lambda number: -len(vessels[number]))
        listed = ", ".join(f"{number} ({len(vessels[number])} fixes)" for number in most[:10])
        if len(most) > 10:
            listed += f" and {len(most) - 10} more"
        if mmsi is None:
            raise InputError(f"{path}: holds {len(vessels)} vessels, say which MMSI: {listed}")
        raise InputError(f"{path}: holds no vessel with the MMSI {mmsi}; it holds {listed}")
    found = _feed(path, vessels, [mmsi], own)[mmsi].fixes
    if tally is None:
        own.warn(_logger)
    return found


def read_ais_dimensions(
    path: str | os.PathLike[str], mmsi: int, *, tally: Tally | None = None
) -> tuple[float, float, float, float] | None:
    """Distances from a vessel's antenna to its bow, stern, port and starboard, metres.

    As its static reports (types 5, 19 and 24) state them most often; None where none does. Where a
    report tells length and beam and not where the antenna is, bow and port are zero.

    Args:
        path: A log of AIS sentences.
        mmsi: The vessel.
        tally: Takes how many static reports tell them, and the sentences that were read.
    """
    own = Tally(path) if tally is None else tally
    told: Counter[tuple[float, float, float, float]] = Counter()
    for message in read_messages(path, ReceptionClock(), own):
        needed = _STATIC_BITS.get(message.payload[0])
        if needed is None or 6 * len(message.payload) - message.fill_bits < needed:
            continue
        report = _decoded(message)
        if report is None or int(report.mmsi) != mmsi:
            continue
        sides = [getattr(report, f"to_{side}", None) for side in _SIDES]
        bow, stern, port, starboard = (math.inf if one is None else float(one) for one in sides)
        # Of 511 and 63 m it is so much or more, and zero to both ends says that nobody knows.
        if max(bow, stern) >= 511.0 or max(port, starboard) >= 63.0 or bow + stern == 0.0:
            continue
        told[bow, stern, port, starboard] += 1
    if not told:
        return None
    own.count("reports of dimensions", told.total())
    return told.most_common(1)[0][0]


@dataclass(frozen=True, slots=True)
class AisReport:
    """What a vessel says of itself in one message.

    Attributes:
        mmsi: Of the vessel.
        time_utc_s: POSIX seconds; NaN in a message that tells no place.
        latitude_deg: Degrees north; NaN in a message that tells no place.
        longitude_deg: Degrees east.
        velocity_mps: East and north; NaN where it tells none.
        name: Its name; empty in a message that tells none.
    """

    mmsi: int
    time_utc_s: float
    latitude_deg: float
    longitude_deg: float
    velocity_mps: tuple[float, float]
    name: str = ""


class AisStream:
    """Reports of vessels, of sentences that come line by line, as from a receiver."""

    def __init__(self, tally: Tally) -> None:
        """Begin.

        Args:
            tally: Counts position reports, and what is left out.
        """
        self._messages, self._tally = MessageStream(tally), tally

    def add(self, text: str, now_utc_s: float | None) -> list[AisReport]:
        """The reports that a line completes.

        Args:
            text: The line.
            now_utc_s: When it was received, where the line does not say so itself; None: what
                does not is left out.
        """
        found = []
        for message in self._messages.add(text):
            report = _decoded(message)
            if report is None or report.mmsi is None:
                self._tally.leave_out("AIS messages that cannot be read")
                continue
            name = str(getattr(report, "shipname", None) or "").strip(" @")
            nan = float("nan")
            told = AisReport(int(report.mmsi), nan, nan, nan, (nan, nan), name)
            received_s = now_utc_s if message.received_s is None else message.received_s
            if isinstance(report, _POSITION_REPORTS):
                reason = _no_place(report) or ("" if received_s is not None else _UNTIMED)
                if reason or received_s is None:
                    self._tally.leave_out(reason)
                    continue
                second = getattr(report, "second", 60)
                told = AisReport(
                    told.mmsi,
                    _refined_s(received_s, second) if second < 60 else received_s,
                    float(report.lat),
                    float(report.lon),
                    _velocity_mps(report),
                    name,
                )
                self._tally.count("position reports")
            elif not name:
                continue
            found.append(told)
        return found


def _vessels(path: str | os.PathLike[str], tally: Tally) -> dict[int, list[Report]]:
    """The reports of each vessel in the order of time, each place and time once."""
    tally.format = "AIS"
    seen: dict[int, dict[tuple[float, float, float], Report]] = {}
    repeats = 0
    for report in _reports(path, tally):
        place = (report.time_utc_s, report.latitude_deg, report.longitude_deg)
        own = seen.setdefault(report.mmsi, {})
        repeats += place in own
        own.setdefault(place, report)
    if repeats:
        tally.count("reports received again", repeats)
    return {mmsi: _fine([own[place] for place in sorted(own)], tally) for mmsi, own in seen.items()}


def _fine(reports: list[Report], tally: Tally) -> list[Report]:
    """Of a vessel's reports those of fine places; all where there are too few."""
    rough = [one for one in reports if one.rough]
    if not rough:
        return reports
    if len(reports) - len(rough) >= _FEWEST_FINE:
        reason = "reports of long range (type 27), whose places are told to a tenth of a minute"
        tally.leave_out(reason, len(rough), row=f"line {rough[0].line}")
        return [one for one in reports if not one.rough]
    tally.note(
        f"{len(rough)} reports of vessel {rough[0].mmsi} are of long range (type 27): their places "
        "may be 130 m off"
    )
    return reports


def _feed(
    path: str | os.PathLike[str],
    vessels: dict[int, list[Report]],
    wanted: list[int],
    tally: Tally,
) -> dict[int, AisVessel]:
    """What is told of some vessels, without what is of others or cannot be true."""
    feed = {}
    shared: list[str] = []
    for mmsi in wanted:
        reports = vessels[mmsi]
        columns = np.array(
            [
                (r.time_utc_s, r.latitude_deg, r.longitude_deg, *r.velocity_mps, r.line)
                for r in reports
            ]
        )
        ways = _ways(columns)
        usual = int(np.argmax(np.bincount(ways)))
        kept = ways == usual
        others = np.bincount(ways[~kept], minlength=1)
        # A feed may have hundreds of vessels: they are counted together.
        of = f" {mmsi}" if len(wanted) == 1 else ""
        reason = f"reports from where the vessel{of} cannot have come"
        if others.max() >= _ANOTHER_VESSEL:
            reason = f"reports of another vessel that uses the same MMSI{of}"
            shared.append(str(mmsi))
        if not kept.all():
            first = columns[int(np.argmin(kept))]
            text = f"{first[1]:.6f}, {first[2]:.6f} at {_files.rfc3339(first[0])}"
            tally.leave_out(reason, int((~kept).sum()), row=f"line {first[5]:.0f}", text=text)
        columns = columns[kept]
        rows, (time_s, latitude, longitude) = columns[:, 5].astype(np.int64), columns[:, :3].T
        try:
            usable = _log_rows.usable(path, rows, time_s, latitude, longitude, tally=tally)
        except InputError:
            if len(wanted) == 1:
                raise
            # One vessel that is nowhere is no reason to do without the others.
            tally.leave_out("reports of vessels that no way explains", len(rows))
            continue
        feed[mmsi] = AisVessel(
            Fixes(time_s[usable], latitude[usable], longitude[usable], name=str(mmsi)),
            columns[usable, 3:5],
        )
    if shared:
        named = ", ".join(shared[:_MOST_NAMED]) + (" ..." if len(shared) > _MOST_NAMED else "")
        tally.note(
            f"two vessels or more use the same MMSI ({named}); the reports of that with most of "
            "them are kept"
        )
    tally.count("fixes", sum(len(vessel.fixes) for vessel in feed.values()))
    return feed


def _ways(columns: FloatArray) -> IntArray:
    """Which way each report of one MMSI belongs to, (N,) from 0.

    A report goes on with the way that leads there soonest; where none does, it begins one.

    Args:
        columns: (N, 6) time, latitude, longitude, velocity east and north, line.
    """
    time_s, latitude_deg, longitude_deg = columns[:, :3].T
    speed_mps = np.hypot(columns[:, 3], columns[:, 4])
    speed_mps = np.where(np.isnan(speed_mps), _FASTEST_MPS, speed_mps)
    lag_s = np.diff(time_s)
    way_m = distance_m(latitude_deg[:-1], longitude_deg[:-1], latitude_deg[1:], longitude_deg[1:])
    faster = np.maximum(speed_mps[:-1], speed_mps[1:])
    ways = np.zeros(time_s.size, dtype=np.int64)
    if (way_m <= _reach_m(faster, lag_s)).all():
        return ways
    # What each way is, where it ended, and how many it has.
    open_ways = np.array([[0, 0, 1]])
    for i in range(1, time_s.size):
        before = open_ways[:, 1]
        way_m = distance_m(
            latitude_deg[before], longitude_deg[before], latitude_deg[[i]], longitude_deg[[i]]
        )
        faster = np.maximum(speed_mps[before], speed_mps[i])
        share = way_m / _reach_m(faster, time_s[i] - time_s[before])
        best = int(np.argmin(share))
        if share[best] > 1.0:
            if len(open_ways) == _MOST_WAYS:
                open_ways = np.delete(open_ways, np.argmin(open_ways[:, 2]), axis=0)
            best = len(open_ways)
            open_ways = np.vstack([open_ways, [ways[:i].max() + 1, i, 0]])
        ways[i] = open_ways[best, 0]
        open_ways[best, 1:] = i, open_ways[best, 2] + 1
    return ways


def _reach_m(speed_mps: FloatArray, lag_s: FloatArray) -> FloatArray:
    """How far from each other two reports of one vessel may be."""
    most_mps = np.minimum(speed_mps + _CHANGE_MPS + _ACCELERATION_MPS2 * lag_s, _FASTEST_MPS)
    return np.asarray(_PLACE_M + most_mps * lag_s + np.minimum(speed_mps, _FASTEST_MPS) * _TIME_S)


def _reports(path: str | os.PathLike[str], tally: Tally) -> Iterator[Report]:
    if is_vessel_table(_files.beginning(path)):
        yield from read_table_reports(path, tally)
        return
    found: list[tuple[Report, float, str]] = []
    reception = ReceptionClock()
    for message in read_messages(path, reception, tally):
        first, received_s = message.first, message.received_s
        report = _decoded(message)
        if report is None:
            tally.leave_out("AIS messages that cannot be read", row=first.row, text=first.text)
            continue
        tally.count("AIS messages")
        if not isinstance(report, _POSITION_REPORTS):
            continue
        tally.count("position reports")
        reason = _no_place(report) or ("" if received_s is not None else _UNTIMED)
        if reason:
            tally.leave_out(reason, row=first.row, text=first.text)
            continue
        assert received_s is not None, "there would be a reason"
        second = getattr(report, "second", 60)
        told = Report(
            first.line,
            int(report.mmsi),
            _refined_s(received_s, second) if second < 60 else received_s,
            float(report.lat),
            float(report.lon),
            _velocity_mps(report),
            rough=int(report.msg_type) == _LONG_RANGE,
        )
        found.append((told, received_s, message.payload))
    if not found:
        raise InputError(f"{path}: {_why_none(reception, tally)}")
    yield from _once(_of_one_clock(found, tally), tally)


def _of_one_clock(
    found: list[tuple[Report, float, str]], tally: Tally
) -> list[tuple[Report, float, str]]:
    """Reports with when they were received, of the clock of most where receivers had several."""
    received_s = np.array([one[1] for one in found])
    clock = by_clock(received_s, least_s=_CLOCKS_APART_S)
    if not clock.any():
        return found
    counts = np.bincount(clock)
    kept = clock == clock[np.argmax(counts[clock] == counts.max())]
    first = found[int(np.argmin(kept))][0]
    tally.leave_out(
        "position reports received by another clock", int((~kept).sum()), row=f"line {first.line}"
    )
    tally.note(
        "several receivers wrote into it by turns, whose clocks disagree; what that with most "
        "reports received is used, of as many the first: log each by itself to choose"
    )
    return [one for one, own in zip(found, kept.tolist(), strict=True) if own]


def _once(found: list[tuple[Report, float, str]], tally: Tally) -> Iterator[Report]:
    """Reports, each as it was received first: what several stations heard is one report."""
    last: dict[tuple[int, str], float] = {}
    again = np.zeros(len(found), dtype=bool)
    for i in sorted(range(len(found)), key=lambda i: found[i][1]):
        report, received_s, payload = found[i]
        key = report.mmsi, payload
        before_s = last.get(key, -math.inf)
        again[i] = received_s - before_s <= _AGAIN_S
        if not again[i]:
            last[key] = received_s
    if again.any():
        tally.count("reports received again", int(again.sum()))
    return (one[0] for one, repeat in zip(found, again.tolist(), strict=True) if not repeat)


def _no_place(report: Any) -> str:
    # 91 and 181 degrees say that the position is not available.
    if not (abs(report.lat) <= 90.0 and abs(report.lon) <= 180.0):
        return "position reports without a place"
    if report.lat == 0.0 and report.lon == 0.0:
        return "position reports at 0° north, 0° east, which transponders send that have no fix"
    return ""


def _why_none(reception: ReceptionClock, tally: Tally) -> str:
    untimed = tally.left_out.get(_UNTIMED)
    if untimed is not None:
        text, row = reception.unreadable
        shown = f" ({row}: {_files.shortened(text, 40)} is none)" if text else ""
        return (
            f"none of its {untimed.count} AIS position reports has a time of reception{shown}; log "
            "it in a TAG block (\\c:1601494584*hh\\) or before each sentence "
            "(2020-09-30T19:36:24Z !AIVDM,...)"
        )
    said = f"; left out: {tally.reasons()}" if tally.left_out else ""
    return f"holds no usable AIS position report{said}"


def _decoded(message: Message) -> Any:
    """What a message says; None where it says nothing that can be understood."""
    # One sentence whatever its talker, ids and channels were: the parts have been looked at.
    body = f"AIVDM,1,1,,A,{message.payload},{message.fill_bits}"
    try:
        found = pyais.decode(f"!{body}*{reduce(xor, body.encode()):02X}")
    except (pyais.exceptions.AISBaseException, ArithmeticError, LookupError, TypeError, ValueError):
        return None
    # What a message that is cut short no longer says is None, or made of what is left of it.
    needed = _LEAST_BITS.get(int(found.msg_type), 0)
    if 6 * len(message.payload) - message.fill_bits < needed:
        return None
    told = (getattr(found, name, None) for name in ("lat", "lon", "speed", "course"))
    return None if isinstance(found, _POSITION_REPORTS) and None in told else found


def _velocity_mps(message: Any) -> tuple[float, float]:
    """East and north, metres a second; NaN where one of the two is not available."""
    speed_knots, course_deg = message.speed, message.course
    # 102.3 knots and 360 degrees say so, in type 27 it is 63 knots and 511 degrees.
    no_speed_knots = 63.0 if message.msg_type == _LONG_RANGE else 102.3
    if not (speed_knots < no_speed_knots and course_deg < 360.0):
        return float("nan"), float("nan")
    speed, course = speed_knots * _KNOT_MPS, np.radians(course_deg)
    return float(speed * np.sin(course)), float(speed * np.cos(course))


def _refined_s(reception_s: float, second: int) -> float:
    """The time nearest to the reception that falls on a second of a minute."""
    return reception_s + (second - reception_s % 60.0 + 30.0) % 60.0 - 30.0
