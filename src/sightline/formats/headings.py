"""Where a platform's bow pointed: from CSV logs with ``heading_deg``, and from NMEA 0183."""

from __future__ import annotations

import logging
import os
import re

import numpy as np
import pynmea2

from sightline.formats import _files
from sightline.formats.nmea import dated
from sightline.types import Headings

_logger = logging.getLogger(__name__)
_SENTENCE = re.compile(r"(\$[A-Z]{2}(RMC|ZDA|HDT|THS),[^$!]*)")


def read_headings(path: str | os.PathLike[str]) -> Headings | None:
    """The headings that a log holds beside its places; None where it holds none.

    A CSV table has them in the column ``heading_deg``; empty cells are left out. In NMEA 0183 they
    are HDT and THS sentences, which have no time: each is taken to be of the RMC or ZDA before it.
    Magnetic headings (HDG, HDM) are left out, since nothing here knows the deviation. Those with a
    wrong or no checksum, or that are no number, are skipped, and a warning is logged that says how
    many.

    Args:
        path: A log that `sightline.formats.read_fixes` reads.

    Raises:
        InputError: A cell is no number, or the times of the headings do not increase.
    """
    if "time_utc" in _files.beginning(path).split("\n", 1)[0]:
        (rows,) = _files.table(path, required=("time_utc",))
        if "heading_deg" not in rows:
            return None
        rows = rows.dropna(subset=["heading_deg"])
        times = _files.times(path, rows["time_utc"])
        return _headings(times, _files.numbers(path, rows["heading_deg"]))
    times_s: list[float] = []
    headings: list[float] = []
    now_s = float("nan")
    seen = spoilt = 0
    for _, text in _files.log_lines(path):
        for written, kind in _SENTENCE.findall(text):
            # The reader of the fixes counts those that tell a time.
            tells_heading = kind in ("HDT", "THS")
            seen += tells_heading
            try:
                sentence = pynmea2.parse(written.strip(), check=True)
                if not tells_heading:
                    now_s = dated(sentence)
                elif sentence.data[0]:
                    headings.append(float(sentence.data[0]))
                    times_s.append(now_s)
            except (pynmea2.ParseError, ValueError, TypeError, AttributeError, IndexError):
                spoilt += tells_heading
    if spoilt:
        _logger.warning("%s: %d of %d headings are spoilt and left out", path, spoilt, seen)
    return _headings(np.array(times_s), np.array(headings))


def _headings(times: np.ndarray, heading_deg: np.ndarray) -> Headings | None:
    known = np.isfinite(times)
    # Several under one time count as the last of them.
    last = known & np.append(np.diff(times) != 0.0, True)
    if last.sum() < 2:
        return None
    return Headings(times[last], heading_deg[last] % 360.0)
