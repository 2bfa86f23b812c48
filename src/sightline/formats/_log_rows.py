"""Rows of a log that cannot be used: left out and counted, unless they are half of it.

One row that is wrong says nothing of the others, whatever the format. Where no more than half are
left, the log is another than it is taken for, and the first of them refuses it.
"""

from __future__ import annotations

import logging
import os
import re
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._times import EXPECTED, NotUnderstoodError, read_times
from sightline.plausibility import FASTEST_MPS, HARDEST_MPS2, LONGEST_STRETCH, implausible
from sightline.synchronisation import repeated
from sightline.tally import Tally
from sightline.types import BoolArray, Fixes, FloatArray, IntArray

_logger = logging.getLogger(__name__)

NO_TIME = "without a time"
UNREAD_TIME = "with a time that cannot be read"
NO_PLACE = "without a place"
UNREAD_PLACE = "with a place that cannot be read"
OFF_THE_EARTH = "with a place that is not on the earth"
YEARS_OFF = "with a time that is years from the others"
OUT_OF_ORDER = "with a time that is not between those before and after"

_YEAR_S = 365.0 * 86400.0
# A receiver may take a minute until it knows the date.
_FEW_SHARE = 0.05
_OFTEN_S = 3600.0


# Of a time that names its zone; numbers count from 1970, in UTC.
_ZONED = re.compile(
    r":\d\d.*?(?:Z|UTC|GMT|[+\-\u2212]\d{1,2}(?::?\d\d)?(?![\d-]))|^\s*[-+.,\deE]+\s*$"
    r"|^\d{8}T?\d{6}\S*Z$",
    re.IGNORECASE,
)


def row_times(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    texts: Sequence[str],
    tally: Tally,
    *,
    row: str = "line",
    title: str = "",
    zone_s: float | FloatArray | None = None,
    day_first: bool | None = None,
) -> FloatArray:
    """(N,) POSIX seconds of the rows of a log; NaN of those that are left out.

    Args:
        path: The file.
        rows: (N,) where in the file each stands.
        texts: (N,) times as they stand; empty ones are none.
        tally: Takes what is left out and assumed.
        row: What ``rows`` counts.
        title: Of their column, for messages.
        zone_s: Seconds by which the zone of times that name none is ahead of UTC, one or (N,);
            None where nothing says so, and UTC is assumed.
        day_first: As for `read_times`.

    Raises:
        InputError: The times are not understood, or too many of them.
    """
    numbers = np.asarray(rows)
    named = f" ({title})" if title else ""

    def refused(i: int, why: str) -> InputError:
        why = why.replace("is no time", f"is no time{named}", 1)
        return InputError(f"{path}, {row} {numbers[i]}: {_files.shortened(texts[i])} {why}")

    try:
        read = read_times(texts, strict=False, day_first=day_first)
    except NotUnderstoodError as error:
        raise refused(error.row, error.why) from error
    empty = [i for i, text in enumerate(texts) if not text.strip()]
    if 2 * (len(empty) + len(read.refused)) >= len(texts) > 0:
        first = min([*empty[:1], *list(read.refused)[:1]])
        if first in read.refused:
            raise refused(first, read.refused[first])
        raise InputError(f"{path}, {row} {numbers[first]}: has no time{named}; {EXPECTED}")
    if empty:
        tally.leave_out(NO_TIME, len(empty), row=f"{row} {numbers[empty[0]]}")
    if read.refused:
        first = next(iter(read.refused))
        where = f"{row} {numbers[first]}"
        tally.leave_out(UNREAD_TIME, len(read.refused), row=where, text=texts[first])
    ahead_s = np.broadcast_to(0.0 if zone_s is None else zone_s, len(texts))
    bare = np.array([not _ZONED.search(text) for text in texts], dtype=bool)
    ahead_s = np.where(bare & read.zoneless, ahead_s, 0.0)
    if ahead_s.any():
        hours = " and ".join(f"UTC{hour:+g}" for hour in np.unique(ahead_s / 3600.0)[:3])
        tally.note(f"its times are taken for those of {hours}, as it says")
    _files.note_how_read(read, tally, zone_told=zone_s is not None)
    return np.asarray(read.time_utc_s - ahead_s)


def fixes(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    time_utc_s: ArrayLike,
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    *,
    name: str = "",
    row: str = "line",
    tally: Tally | None = None,
) -> Fixes:
    """Fixes of a file that can be true; the others are left out and counted.

    Args:
        path: The file.
        rows: (N,) where in the file each fix stands.
        time_utc_s: (N,) POSIX seconds.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        name: Whose log it is.
        row: What ``rows`` counts.
        tally: Takes what is left out; None: it is logged.

    Raises:
        InputError: Half of the places are not on the earth, times decrease, or half of the fixes
            cannot be true.
    """
    when, latitude, longitude = (
        np.asarray(values, dtype=np.float64) for values in (time_utc_s, latitude_deg, longitude_deg)
    )
    kept = usable(path, rows, when, latitude, longitude, row=row, tally=tally)
    return Fixes(when[kept], latitude[kept], longitude[kept], name=name)


def usable(
    path: str | os.PathLike[str],
    rows: ArrayLike,
    time_utc_s: FloatArray,
    latitude_deg: FloatArray,
    longitude_deg: FloatArray,
    *,
    row: str = "line",
    tally: Tally | None = None,
) -> BoolArray:
    """Which fixes of a file can be true, (N,) bool, for readers with further columns; see `fixes`.

    Args:
        path: The file.
        rows: (N,) where in the file each fix stands.
        time_utc_s: (N,) POSIX seconds.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        row: What ``rows`` counts.
        tally: Takes what is left out; None: it is logged.

    Raises:
        InputError: As `fixes`.
    """
    numbers = np.asarray(rows)
    own = tally if tally is not None else Tally(path)
    placed = on_the_earth(latitude_deg, longitude_deg)
    if 2 * placed.sum() <= placed.size:
        _files.check_places(path, numbers, latitude_deg, longitude_deg, row=row)

    def leave_out(reason: str, which: BoolArray) -> None:
        if which.any():
            i = int(np.argmax(which))
            when = _files.rfc3339(time_utc_s[i])
            text = f"{latitude_deg[i]:.6f}, {longitude_deg[i]:.6f} at {when}"
            own.leave_out(reason, int(which.sum()), row=f"{row} {numbers[i]}", text=text)

    leave_out(OFF_THE_EARTH, ~placed)
    once = placed.copy()
    once[placed] = ~repeated(time_utc_s[placed], latitude_deg[placed], longitude_deg[placed])
    kept = placed.copy()
    kept[once] = timely(path, numbers[once], time_utc_s[once], own, row=row)
    again = placed & ~once & np.isin(time_utc_s, time_utc_s[placed & ~kept])
    kept &= ~again
    found = implausible(time_utc_s[kept], latitude_deg[kept], longitude_deg[kept])
    nowhere = _within(kept, found.nowhere)
    for reason, which in (
        ("that stand twice", again | _within(kept, found.repeated)),
        ("at 0° north, 0° east, which receivers write that have no fix", nowhere),
        (
            f"that nothing could have reached at {FASTEST_MPS:g} m/s",
            _within(kept, found.out_of_reach),
        ),
        (f"off the track and back at over {HARDEST_MPS2:g} m/s²", _within(kept, found.astray)),
    ):
        leave_out(reason, which)
    kept = _within(kept, found.kept)
    if kept.size and 2 * kept.sum() <= ((once | ~placed) & ~nowhere).sum():
        raise InputError(
            f"{path}: no more than {kept.sum()} of its {kept.size} fixes can be true; left out: "
            f"{own.reasons()}"
        )
    if tally is None:
        own.warn(_logger)
    return kept


def _within(rows: BoolArray, which: BoolArray) -> BoolArray:
    """(N,) bool, from flags of some rows."""
    flags = np.zeros_like(rows)
    flags[rows] = which
    return flags


def on_the_earth(latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
    """(N,) bool, which places can be."""
    return np.asarray((np.abs(latitude_deg) <= 90.0) & (np.abs(longitude_deg) <= 180.0))


def years_off(time_utc_s: FloatArray) -> BoolArray:
    """(N,) bool, a few times that are over a year from all others: of 1970, of 2080.

    Of a log that has a fix a week, or a month, nothing tells.

    Args:
        time_utc_s: (N,) POSIX seconds in any order.
    """
    order = np.argsort(time_utc_s, kind="stable")
    gaps = np.diff(time_utc_s[order]) > _YEAR_S
    if not gaps.any():
        return np.zeros(time_utc_s.size, dtype=bool)
    group = np.append(0, np.cumsum(gaps))
    counts = np.bincount(group)
    few = counts <= max(LONGEST_STRETCH, _FEW_SHARE * time_utc_s.size)
    most = int(np.argmax(counts))
    few[most] = False
    steps_s = np.diff(time_utc_s[order][group == most])
    if not steps_s.size or np.median(steps_s) > _OFTEN_S:
        few[:] = False
    off = np.zeros(time_utc_s.size, dtype=bool)
    off[order] = few[group]
    return off


def out_of_order(time_utc_s: FloatArray) -> BoolArray:
    """(N,) bool, the fewest times without which none is earlier than the one before it.

    Where there is a choice, what is left takes less time.

    Args:
        time_utc_s: (N,) POSIX seconds in the order of the log.
    """
    if not (np.diff(time_utc_s) < 0.0).any():
        return np.zeros(time_utc_s.size, dtype=bool)
    ways = [_increasing(time_utc_s), _increasing(-time_utc_s[::-1])[::-1]]
    return ~min(ways, key=lambda kept: np.ptp(time_utc_s[kept]))


def _increasing(values: FloatArray) -> BoolArray:
    """(N,) bool, the longest subsequence that never decreases, of those the one that ends least."""
    # The least end of one of each length, and where it stands.
    ends: list[float] = []
    last: list[int] = []
    before = np.full(values.size, -1)
    for i, value in enumerate(values.tolist()):
        length = bisect_right(ends, value)
        before[i] = last[length - 1] if length else -1
        ends[length : length + 1] = [value]
        last[length : length + 1] = [i]
    kept = np.zeros(values.size, dtype=bool)
    at = last[-1]
    while at >= 0:
        kept[at] = True
        at = int(before[at])
    return kept


def timely(
    path: str | os.PathLike[str],
    rows: IntArray,
    time_utc_s: FloatArray,
    tally: Tally,
    *,
    row: str = "line",
) -> BoolArray:
    """(N,) bool, which rows have a time that can be; the others are counted.

    Args:
        path: The file.
        rows: (N,) where in the file each time stands.
        time_utc_s: (N,) POSIX seconds in the order of the log.
        tally: Takes what is left out.
        row: What ``rows`` counts.

    Raises:
        InputError: Times decrease for many rows, or in half of them.
    """
    off = years_off(time_utc_s)
    backwards = np.zeros_like(off)
    backwards[~off] = out_of_order(time_utc_s[~off])
    kept = ~(off | backwards)
    if backwards.any() and (
        _longest(backwards[~off]) > LONGEST_STRETCH or 2 * kept.sum() <= kept.size
    ):
        _files.check_order(path, rows[~off], time_utc_s[~off], row=row)
    for which, reason in ((off, YEARS_OFF), (backwards, OUT_OF_ORDER)):
        if which.any():
            i = int(np.argmax(which))
            text = str(_files.rfc3339(time_utc_s[i]))
            tally.leave_out(reason, int(which.sum()), row=f"{row} {rows[i]}", text=text)
    return kept


def _longest(flags: BoolArray) -> int:
    """Length of the longest run of flags."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max(initial=0))
