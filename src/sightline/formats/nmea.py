"""NMEA 0183: the log of a receiver on board."""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass, field
from datetime import datetime, time

import pynmea2

from sightline.errors import InputError
from sightline.formats import _files
from sightline.types import Fixes

_logger = logging.getLogger(__name__)
_SENTENCE = re.compile(r"\$[A-Z]{2}(?:RMC|GGA|ZDA),[^$!]*")
_DAY_S = 86400.0


@dataclass
class _Log:
    lines: list[int] = field(default_factory=list)
    time_utc_s: list[float] = field(default_factory=list)
    latitude_deg: list[float] = field(default_factory=list)
    longitude_deg: list[float] = field(default_factory=list)

    def add(self, line: int, time_utc_s: float, sentence: pynmea2.TalkerSentence) -> None:
        self.lines.append(line)
        self.time_utc_s.append(time_utc_s)
        self.latitude_deg.append(sentence.latitude)
        self.longitude_deg.append(sentence.longitude)


def read_nmea(path: str | os.PathLike[str]) -> Fixes:
    """The positions in a log of NMEA 0183 sentences.

    RMC gives time, date and place. GGA has no date and takes it from the RMC or ZDA nearest to
    it, over midnight as well. Where a log has both, the kind with more fixes is used, RMC if they
    are equal, so that no fix counts twice. Sentences without a fix are left out. Those with a
    wrong or no checksum, or that cannot be understood, are skipped, and a warning is logged that
    says how many. Anything may stand before the ``$`` of a sentence.

    Args:
        path: The log; read line by line.

    Raises:
        InputError: No sentence is usable, times decrease, or a place is not on the earth.
    """
    rmc, gga = _Log(), _Log()
    undated: list[tuple[int, pynmea2.TalkerSentence]] = []
    reference_s: float | None = None
    seen = spoilt = 0
    for line, text in _files.log_lines(path):
        for written in _SENTENCE.findall(text):
            seen += 1
            try:
                sentence = pynmea2.parse(written.strip(), check=True)
                kind = sentence.sentence_type
                if kind == "GGA":
                    if not sentence.gps_qual or sentence.timestamp is None:
                        continue
                    _ = sentence.latitude, sentence.longitude
                    if reference_s is None:
                        undated.append((line, sentence))
                        continue
                    reference_s = _dated(sentence, reference_s)
                    gga.add(line, reference_s, sentence)
                    continue
                if sentence.timestamp is None or sentence.datestamp is None:
                    continue
                moment_s = dated(sentence)
                for earlier, waiting in undated:
                    gga.add(earlier, _dated(waiting, moment_s), waiting)
                undated.clear()
                reference_s = moment_s
                if kind == "RMC" and sentence.status == "A":
                    rmc.add(line, moment_s, sentence)
            except (pynmea2.ParseError, ValueError, TypeError, AttributeError):
                spoilt += 1
    log = gga if len(gga.lines) > len(rmc.lines) else rmc
    if not log.lines:
        raise InputError(f"{path}: {_why_none(seen, spoilt, len(undated))}")
    if spoilt:
        _logger.warning("%s: %d of %d sentences are spoilt and left out", path, spoilt, seen)
    return _files.fixes(path, log.lines, log.time_utc_s, log.latitude_deg, log.longitude_deg)


def dated(sentence: pynmea2.TalkerSentence) -> float:
    """POSIX seconds of a sentence with time and date, RMC or ZDA.

    Raises:
        TypeError: It has neither.
    """
    return datetime.combine(sentence.datestamp, sentence.timestamp).timestamp()


def _dated(sentence: pynmea2.TalkerSentence, reference_s: float) -> float:
    """POSIX seconds of a time of day, on the day that brings it nearest to a reference."""
    clock: time = sentence.timestamp
    of_day_s = clock.hour * 3600 + clock.minute * 60 + clock.second + clock.microsecond * 1e-6
    ahead_s = (of_day_s - reference_s % _DAY_S + _DAY_S / 2.0) % _DAY_S - _DAY_S / 2.0
    return reference_s + ahead_s


def _why_none(seen: int, spoilt: int, undated: int) -> str:
    if undated:
        return (
            f"its {undated} GGA sentences have no date, and there is no RMC or ZDA sentence to "
            "give it; log one of these as well"
        )
    if spoilt:
        return f"no sentence is usable; {spoilt} of {seen} are spoilt (checksum or content)"
    return f"none of its {seen} RMC, GGA and ZDA sentences has a fix"
