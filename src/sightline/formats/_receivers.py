"""Whether the fixes of two sources are of one receiver that changes its name, or of two."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.plausibility import distance_m
from sightline.types import BoolArray, FloatArray

# Fixes of one receiver lie an interval apart, whatever it calls itself.
_BESIDE = 0.75
_SHARE = 0.1
FIT_M = 0.5
"""Fixes that lie on a line to this may be of one receiver or of two: it does not matter."""
_SHORT_STEPS = 10.0
_USUAL_S = 1.0
_LEAST_GAP_S, _GAPS = 10.0, 5.0


@dataclass(frozen=True, eq=False)
class Source:
    """Fixes of one source.

    Attributes:
        time_utc_s: (N,) float64, POSIX seconds, at least one; in order after `sorted_by_time`.
        latitude_deg: (N,) float64.
        longitude_deg: (N,) float64.
    """

    time_utc_s: FloatArray
    latitude_deg: FloatArray
    longitude_deg: FloatArray

    def sorted_by_time(self) -> Source:
        """The same fixes in the order of their times."""
        return self[np.argsort(self.time_utc_s, kind="stable")]

    def __getitem__(self, rows: np.ndarray) -> Source:
        return Source(self.time_utc_s[rows], self.latitude_deg[rows], self.longitude_deg[rows])

    def __len__(self) -> int:
        return self.time_utc_s.size

    def with_fixes_of(self, other: Source) -> Source:
        """The fixes of both in the order of their times."""
        return Source(
            np.append(self.time_utc_s, other.time_utc_s),
            np.append(self.latitude_deg, other.latitude_deg),
            np.append(self.longitude_deg, other.longitude_deg),
        ).sorted_by_time()

    def covers(self, time_utc_s: FloatArray) -> BoolArray:
        """Which times lie between two fixes that are as close to each other as is usual here.

        Args:
            time_utc_s: (M,) POSIX seconds.
        """
        steps_s = np.diff(self.time_utc_s)
        if not steps_s.size:
            return np.zeros(np.shape(time_utc_s), dtype=bool)
        most_s = max(_LEAST_GAP_S, _GAPS * float(np.median(steps_s)))
        after = np.clip(np.searchsorted(self.time_utc_s, time_utc_s), 1, steps_s.size)
        inside = (time_utc_s > self.time_utc_s[0]) & (time_utc_s < self.time_utc_s[-1])
        return np.asarray(inside & (steps_s[after - 1] <= most_s))


def runs_beside(first: Source, second: Source, *, same_times_are_two: bool = False) -> bool:
    """Whether the second of two sources is another receiver, which ran while the first one did.

    One receiver that speaks by turns as ``GP`` and as ``GN`` has a fix an interval; two that are
    out of step have more, and to take both would be to zigzag between them. Where the fixes of both
    lie on one line to half a metre, nothing tells them apart, and nothing has to.

    Args:
        first: In the order of its times.
        second: In the order of its times.
        same_times_are_two: Whether a receiver never gives the same time twice.
    """
    nearest_s = _nearest_s(first.time_utc_s, second.time_utc_s)
    if same_times_are_two and (nearest_s == 0.0).mean() > _SHARE:
        return True
    near = nearest_s < _BESIDE * min(_step_s(first.time_utc_s), _step_s(second.time_utc_s))
    if near.mean() <= _SHARE:
        return False
    return float(np.median(apart_m(first, second[near]))) > FIT_M


def of_one_receiver(names: np.ndarray, fixes: Source) -> BoolArray:
    """(N,) bool, the fixes of the source with most of them, and of those that take turns with it.

    Args:
        names: (N,) str, the source of each fix.
        fixes: N of them, in the order of the log; what is not finite has no say.
    """
    known = np.isfinite(fixes.time_utc_s + fixes.latitude_deg + fixes.longitude_deg)
    sources, counts = np.unique(names[known], return_counts=True)
    kept = ~np.isin(names, sources)
    line: Source | None = None
    for name in sources[np.argsort(-counts, kind="stable")]:
        own = fixes[known & (names == name)].sorted_by_time()
        if line is None or not runs_beside(line, own, same_times_are_two=True):
            line = own if line is None else line.with_fixes_of(own)
            kept |= names == name
    return kept


def apart_m(line: Source, fixes: Source) -> FloatArray:
    """(N,) metres of fixes from where another source was at their times.

    Args:
        line: In the order of its times.
        fixes: N of them.
    """
    beside_deg = (line.longitude_deg - line.longitude_deg[0] + 180.0) % 360.0 - 180.0
    north = np.interp(fixes.time_utc_s, line.time_utc_s, line.latitude_deg)
    east = np.interp(fixes.time_utc_s, line.time_utc_s, beside_deg) + line.longitude_deg[0]
    return distance_m(fixes.latitude_deg, fixes.longitude_deg, north, east)


def _nearest_s(times_s: FloatArray, others_s: FloatArray) -> FloatArray:
    """(N,) seconds from each of other times to the nearest of some."""
    after = np.searchsorted(times_s, others_s)
    back_s = np.abs(others_s - times_s[np.maximum(after - 1, 0)])
    return np.minimum(back_s, np.abs(others_s - times_s[np.minimum(after, times_s.size - 1)]))


def _step_s(times_s: FloatArray) -> float:
    """What lies between two fixes at least, but for a few."""
    steps_s = np.diff(times_s)
    steps_s = steps_s[steps_s > 0.0]
    return float(np.percentile(steps_s, _SHORT_STEPS)) if steps_s.size else _USUAL_S
