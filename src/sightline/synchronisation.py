"""Synchronisation: a log interpolated to given times, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.types import BoolArray, Fixes, FloatArray, IntArray, utc_text

LARGEST_GAP_S = 8.0
"""A time counts where the fixes on either side of it are at most this far apart."""

_FEW, _FEW_SHARE = 5, 0.02


@dataclass(frozen=True, eq=False)
class Synchronised:
    """Positions of a logged target at given times.

    Attributes:
        east_m: (N,) float64, metres east of the plane's origin; NaN where not matched.
        north_m: (N,) float64.
        velocity_east_mps: (N,) float64, from the fixes on either side; NaN where not matched.
        velocity_north_mps: (N,) float64.
        gap_s: (N,) float64, seconds between the fixes on either side; infinite outside the log.
    """

    east_m: FloatArray
    north_m: FloatArray
    velocity_east_mps: FloatArray
    velocity_north_mps: FloatArray
    gap_s: FloatArray

    @property
    def matched(self) -> BoolArray:
        """(N,) bool, whether there is a position."""
        return np.isfinite(self.east_m)

    @property
    def share(self) -> float:
        """Share of the times that are matched, 0 to 1; NaN for no times."""
        return float(self.matched.mean()) if self.matched.size else float("nan")


def distinct(fixes: Fixes) -> Fixes:
    """Fixes with distinct times.

    A fix that stands twice, with its time and its place, counts once. Where a log has cut off the
    fractions of its seconds, its fixes are spread evenly over their second; see `spread_times`. In
    any other, fixes that share a time count as one, their mean.
    """
    if (np.diff(fixes.time_utc_s) > 0.0).all():
        return fixes
    log = fixes[~repeated(fixes.time_utc_s, fixes.latitude_deg, fixes.longitude_deg)]
    log = replace(log, time_utc_s=spread_times(log.time_utc_s))
    times, first, group, count = np.unique(
        log.time_utc_s, return_index=True, return_inverse=True, return_counts=True
    )
    if times.size == len(log):
        return log
    return Fixes(
        time_utc_s=times,
        latitude_deg=np.bincount(group, log.latitude_deg) / count,
        longitude_deg=mean_longitudes_deg(log.longitude_deg, group, first),
        name=log.name,
    )


def repeated(
    time_utc_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> BoolArray:
    """(N,) bool, fixes of the time and the place of one before them: they say nothing new."""
    if (np.diff(time_utc_s) > 0.0).all():
        return np.zeros(time_utc_s.size, dtype=bool)
    again = np.ones(time_utc_s.size, dtype=bool)
    rows = np.stack([time_utc_s, latitude_deg, longitude_deg], axis=1)
    again[np.unique(rows, axis=0, return_index=True)[1]] = False
    return again


def spread_times(time_utc_s: FloatArray) -> FloatArray:
    """Times with the fractions that a log cut off, if it did.

    It did where it keeps whole seconds and more than half of its fixes share theirs; or where
    about as many seconds are left out as are shared, and these are not few: then the receiver's
    interval wanders about a second. Fixes are spread evenly over their second, in their order; one
    by itself stands in its middle. A single second that is shared says nothing of the others.

    Args:
        time_utc_s: (N,) POSIX seconds, never decreasing.
    """
    if not np.array_equal(time_utc_s, np.floor(time_utc_s)):
        return time_utc_s
    times, first, group, count = np.unique(
        time_utc_s, return_index=True, return_inverse=True, return_counts=True
    )
    shared, left_out = int((count > 1).sum()), int((np.diff(times) == 2.0).sum())
    most = 2 * count[count > 1].sum() > time_utc_s.size
    wanders = shared >= max(_FEW, _FEW_SHARE * times.size) and shared <= 2 * left_out <= 4 * shared
    if not (most or wanders):
        return time_utc_s
    place = np.arange(time_utc_s.size) - first[group]
    return np.asarray(time_utc_s + (place + 0.5) / count[group])


def mean_longitudes_deg(longitude_deg: FloatArray, group: IntArray, first: IntArray) -> FloatArray:
    """Mean longitude of each group, also across ±180°.

    Args:
        longitude_deg: (N,) degrees east.
        group: (N,) number of the group of each, from 0.
        first: (K,) row of one of each group.
    """
    start = longitude_deg[first]
    beside = (longitude_deg - start[group] + 180.0) % 360.0 - 180.0
    mean = start + np.bincount(group, beside) / np.bincount(group)
    return np.asarray((mean + 180.0) % 360.0 - 180.0)


@dataclass(frozen=True)
class LogSummary:
    """How much a log holds, and how regularly.

    Attributes:
        n: Number of fixes.
        first_utc_s: POSIX seconds of the first; NaN for none.
        last_utc_s: Of the last.
        interval_s: Median time from one fix to the next; NaN for fewer than two.
        gaps: How many times two fixes are more than `LARGEST_GAP_S` apart.
        longest_gap_s: The longest time from one fix to the next; NaN for fewer than two.
    """

    n: int
    first_utc_s: float
    last_utc_s: float
    interval_s: float
    gaps: int
    longest_gap_s: float


def log_summary(fixes: Fixes) -> LogSummary:
    """The span, the usual interval and the gaps of a log, its times as in `distinct`."""
    times = distinct(fixes).time_utc_s
    steps = np.diff(times)
    nothing = float("nan")
    return LogSummary(
        n=len(fixes),
        first_utc_s=float(fixes.time_utc_s[0]) if len(fixes) else nothing,
        last_utc_s=float(fixes.time_utc_s[-1]) if len(fixes) else nothing,
        interval_s=float(np.median(steps)) if steps.size else nothing,
        gaps=int((steps > LARGEST_GAP_S).sum()),
        longest_gap_s=float(steps.max()) if steps.size else nothing,
    )


def synchronise(
    fixes: Fixes,
    time_utc_s: ArrayLike,
    plane: LocalPlane,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
) -> Synchronised:
    """Interpolate a log to given times, linearly in the plane.

    Args:
        fixes: The log.
        time_utc_s: (N,) POSIX seconds; NaN is never matched.
        plane: The plane of the result.
        largest_gap_s: A time between fixes that are further apart is not matched. A time that
            falls on a fix always is.
    """
    times = np.asarray(time_utc_s, dtype=float)
    log = distinct(fixes)
    n = times.size
    nothing = np.full(n, np.nan)
    if len(log) == 0:
        return Synchronised(
            nothing, nothing.copy(), nothing.copy(), nothing.copy(), np.full(n, np.inf)
        )
    east, north = plane.to_plane(log.latitude_deg, log.longitude_deg)
    after = np.clip(np.searchsorted(log.time_utc_s, times, side="left"), 0, len(log) - 1)
    on_fix = log.time_utc_s[after] == times
    before = np.where(on_fix, after, np.maximum(after - 1, 0))
    inside = (times >= log.time_utc_s[0]) & (times <= log.time_utc_s[-1])
    span = log.time_utc_s[after] - log.time_utc_s[before]
    gap = np.where(inside, span, np.inf)
    matched = gap <= largest_gap_s
    weight = np.where(span > 0.0, (times - log.time_utc_s[before]) / np.where(span > 0, span, 1), 0)

    def between(values: FloatArray) -> FloatArray:
        mixed = values[before] + weight * (values[after] - values[before])
        return np.where(matched, mixed, np.nan)

    # On a fix the neighbours on both sides tell the velocity.
    left = np.where(on_fix, np.maximum(after - 1, 0), before)
    right = np.where(on_fix, np.minimum(after + 1, len(log) - 1), after)
    duration = log.time_utc_s[right] - log.time_utc_s[left]

    def slope(values: FloatArray) -> FloatArray:
        rate = (values[right] - values[left]) / np.where(duration > 0.0, duration, np.nan)
        return np.where(matched, rate, np.nan)

    return Synchronised(between(east), between(north), slope(east), slope(north), gap)


def check_overlap(time_utc_s: FloatArray, fixes: Fixes, where: str) -> None:
    """Raise InputError where a log does not overlap a recording in time.

    Args:
        time_utc_s: (N,) POSIX seconds of the recording's boxes or frames.
        fixes: The log.
        where: Which recording, for the message.

    Raises:
        InputError: No time lies between the first and the last fix; states both spans.
    """
    known = time_utc_s[np.isfinite(time_utc_s)]
    if known.size and len(fixes):
        first, last = fixes.time_utc_s[[0, -1]]
        if ((known >= first) & (known <= last)).any():
            return
        raise InputError(
            f"{where}: its log does not overlap it; the recording runs from "
            f"{utc_text(known.min())} to {utc_text(known.max())}, the log from {utc_text(first)} "
            f"to {utc_text(last)} (UTC)"
        )
    raise InputError(f"{where}: has no times or an empty log")
