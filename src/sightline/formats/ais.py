"""AIS: the positions that vessels broadcast, as a receiver logged them."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pyais
import pyais.exceptions
import pyais.messages

from sightline.errors import InputError
from sightline.formats import _files
from sightline.types import Fixes, FloatArray

_logger = logging.getLogger(__name__)

# Types 2 and 3 are of the class of type 1.
_POSITION_REPORTS = (
    pyais.messages.MessageType1,
    pyais.messages.MessageType18,
    pyais.messages.MessageType19,
    pyais.messages.MessageType27,
)
_SENTENCE = re.compile(
    r"(?:\\(?P<tag>[^\\]*)\\)?"
    r"(?P<sentence>![A-Z]{2}VD[MO],(?P<parts>\d),(?P<part>\d),(?P<group>\d?),(?P<channel>[^,]*),"
    r"[^,]*,\d\*[0-9A-Fa-f]{2})"
)
_TAG_TIME = re.compile(r"(?:^|,)c:(\d+)")
_ISO_TIME = re.compile(
    r"\d{4}[-/]\d{2}[-/]\d{2}[T ]\d{2}:\d{2}:\d{2}(?:\.\d+)?(?:Z|[+-]\d{2}:?\d{2})?"
)
_POSIX_TIME = re.compile(r"(?<![\w.])(\d{13}|\d{10}(?:\.\d+)?)(?![\w.])")
_KNOT_MPS = 1852.0 / 3600.0
_LONG_RANGE = 27
_WAITING = 64
"""How many unfinished messages are remembered; their parts follow each other closely."""


@dataclass(frozen=True)
class _Report:
    mmsi: int
    time_utc_s: float
    latitude_deg: float
    longitude_deg: float
    velocity_mps: tuple[float, float]


@dataclass(frozen=True, eq=False)
class AisVessel:
    """What a receiver logged of one vessel.

    Attributes:
        fixes: Its positions; their name is the MMSI.
        velocity_mps: (N, 2) float64, east and north, from the speed and the course over ground of
            each report; NaN where a report does not tell them.
    """

    fixes: Fixes
    velocity_mps: FloatArray


def read_ais(path: str | os.PathLike[str]) -> dict[int, Fixes]:
    r"""The positions of all vessels in a log of AIS sentences (``!AIVDM``, ``!AIVDO``), by MMSI.

    Used are the position reports of types 1, 2, 3, 18, 19 and 27. AIS messages carry the second
    of their minute at most, so each line needs the time of its reception: in a TAG block
    (``\c:1601494584*hh\``), or before or after the sentence, as ISO 8601 or POSIX seconds. Where
    a report tells its second, the fix is at that second of the minute nearest to the reception.
    Reports arrive late and by several stations, so fixes are put in order, and repeats are left
    out. Sentences with a wrong checksum are skipped, and a warning is logged that says how many.

    Args:
        path: The log; read line by line.

    Raises:
        InputError: No report is usable, or none has a time.
    """
    return {mmsi: vessel.fixes for mmsi, vessel in read_ais_feed(path).items()}


def read_ais_feed(path: str | os.PathLike[str]) -> dict[int, AisVessel]:
    """As `read_ais`, with the velocities that the reports tell.

    Args:
        path: The log.

    Raises:
        InputError: As `read_ais`.
    """
    vessels: dict[int, dict[tuple[float, float, float], tuple[float, float]]] = {}
    for report in _reports(path):
        place = (report.time_utc_s, report.latitude_deg, report.longitude_deg)
        vessels.setdefault(report.mmsi, {}).setdefault(place, report.velocity_mps)
    feed = {}
    for mmsi in sorted(vessels):
        places = sorted(vessels[mmsi])
        columns = np.array(places)
        feed[mmsi] = AisVessel(
            Fixes(columns[:, 0], columns[:, 1], columns[:, 2], name=str(mmsi)),
            np.array([vessels[mmsi][place] for place in places]),
        )
    return feed


def read_ais_vessel(path: str | os.PathLike[str], mmsi: int | None) -> Fixes:
    """The positions of one vessel in a log of AIS sentences.

    Args:
        path: The log.
        mmsi: The vessel; None where the log is of one alone.

    Raises:
        InputError: As `read_ais`; the vessel is not in the log; or there are several and none is
            chosen. The message lists those that there are.
    """
    vessels = read_ais(path)
    if mmsi is None and len(vessels) == 1:
        return next(iter(vessels.values()))
    if mmsi in vessels:
        return vessels[mmsi]
    most = sorted(vessels, key=lambda number: -len(vessels[number]))
    listed = ", ".join(f"{number} ({len(vessels[number])} fixes)" for number in most[:10])
    if len(most) > 10:
        listed += f" and {len(most) - 10} more"
    if mmsi is None:
        raise InputError(f"{path}: holds {len(vessels)} vessels, say which MMSI: {listed}")
    raise InputError(f"{path}: holds no vessel with the MMSI {mmsi}; it holds {listed}")


def _reports(path: str | os.PathLike[str]) -> Iterator[_Report]:
    waiting: dict[tuple[str, str, str], tuple[list[str], float | None]] = {}
    usable = spoilt = untimed = 0
    for _, text in _files.log_lines(path):
        for match in _SENTENCE.finditer(text):
            parts, time_s = [match["sentence"]], _reception_s(text, match)
            if match["parts"] != "1":
                key = (match["parts"], match["group"], match["channel"])
                if match["part"] == "1":
                    waiting.pop(key, None)
                    if len(waiting) >= _WAITING:
                        waiting.pop(next(iter(waiting)))
                    waiting[key] = (parts, time_s)
                    continue
                if key not in waiting:
                    continue
                before, first_s = waiting[key]
                before.append(match["sentence"])
                if match["part"] != match["parts"]:
                    continue
                del waiting[key]
                parts, time_s = before, first_s if first_s is not None else time_s
            try:
                message = pyais.decode(*parts, error_if_checksum_invalid=True)
            except (pyais.exceptions.AISBaseException, ValueError, IndexError):
                spoilt += 1
                continue
            if not isinstance(message, _POSITION_REPORTS):
                continue
            # 91 and 181 degrees say that the position is not available.
            if not (abs(message.lat) <= 90.0 and abs(message.lon) <= 180.0):
                continue
            if time_s is None:
                untimed += 1
                continue
            usable += 1
            second = getattr(message, "second", 60)
            yield _Report(
                int(message.mmsi),
                _refined_s(time_s, second) if second < 60 else time_s,
                float(message.lat),
                float(message.lon),
                _velocity_mps(message),
            )
    if not usable and untimed:
        raise InputError(
            f"{path}: none of its {untimed} AIS position reports has a time of reception; log it "
            "in a TAG block (\\c:1601494584*hh\\) or before each sentence "
            "(2020-09-30T19:36:24Z !AIVDM,...)"
        )
    if not usable:
        raise InputError(f"{path}: holds no usable AIS position report; {spoilt} are spoilt")
    if spoilt:
        _logger.warning("%s: %d AIS messages are spoilt and left out", path, spoilt)


def _velocity_mps(message: Any) -> tuple[float, float]:
    """East and north, metres a second; NaN where one of the two is not available."""
    speed_knots, course_deg = message.speed, message.course
    # 102.3 knots and 360 degrees say so, in type 27 it is 63 knots and 511 degrees.
    no_speed_knots = 63.0 if message.msg_type == _LONG_RANGE else 102.3
    if not (speed_knots < no_speed_knots and course_deg < 360.0):
        return float("nan"), float("nan")
    speed, course = speed_knots * _KNOT_MPS, np.radians(course_deg)
    return float(speed * np.sin(course)), float(speed * np.cos(course))


def _reception_s(text: str, match: re.Match[str]) -> float | None:
    """When a sentence was received, from its TAG block or from what surrounds it in the line."""
    tagged = _TAG_TIME.search(match["tag"] or "")
    if tagged:
        return _seconds(tagged[1])
    for around in (text[: match.start()], text[match.end() :]):
        iso = _ISO_TIME.search(around)
        if iso:
            try:
                moment = datetime.fromisoformat(iso[0].replace("/", "-"))
            except ValueError:
                continue
            return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
        posix = _POSIX_TIME.search(around)
        if posix:
            return _seconds(posix[1])
    return None


def _seconds(digits: str) -> float:
    """POSIX seconds, from seconds or milliseconds."""
    return int(digits) / 1000.0 if digits.isdigit() and len(digits) == 13 else float(digits)


def _refined_s(reception_s: float, second: int) -> float:
    """The time nearest to the reception that falls on a second of a minute."""
    return reception_s + (second - reception_s % 60.0 + 30.0) % 60.0 - 30.0
