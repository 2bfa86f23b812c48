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
_OFTEN_S = 1.05
_FEWEST = 3
_CERTAIN = 4.0
_EARTH_M = 6_371_008.8
_DEGREE_M = np.radians(1.0) * _EARTH_M
_USUAL_S = 1.0
# So long before and after a course is taken from, of what goes as fast, most of the time.
_COURSE_S = 3.0
_UNDER_WAY_MPS = 1.0
_MOSTLY = 0.5
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

    def at(self, time_utc_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Latitude and longitude on the line through the fixes, degrees."""
        beside_deg = (self.longitude_deg - self.longitude_deg[0] + 180.0) % 360.0 - 180.0
        north = np.interp(time_utc_s, self.time_utc_s, self.latitude_deg)
        east = np.interp(time_utc_s, self.time_utc_s, beside_deg) + self.longitude_deg[0]
        return north, east

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
    steps_s = _step_s(first.time_utc_s), _step_s(second.time_utc_s)
    near = nearest_s < _BESIDE * min(steps_s)
    if near.mean() <= _SHARE or float(np.median(apart_m(first, second[near]))) <= FIT_M:
        return False
    # What has a fix a second or more often does not wait for the turn of another name.
    return max(steps_s) <= _OFTEN_S or offset_is_certain(first, second[near])


def offset_is_certain(first: Source, second: Source) -> bool:
    """Whether two sources miss each other's line to opposite sides.

    A turn or a gap takes both off the other's line to the same side; another antenna does not.
    """
    ahead = _off_line_m(first, second)
    behind = _off_line_m(second, first)
    for there, back in zip(ahead, behind, strict=True):
        if min(len(there), len(back)) < _FEWEST:
            return True
        offset_m = (np.mean(there, axis=0) - np.mean(back, axis=0)) / 2.0
        # The noise of one takes both means along, so that their deviations add up.
        sigma_m = sum(
            float(np.sqrt(np.var(off_m, axis=0).sum() / len(off_m))) for off_m in (there, back)
        )
        if np.hypot(*offset_m) > max(FIT_M, _CERTAIN * sigma_m / 2.0):
            return True
    return False


def _off_and_way(line: Source, fixes: Source, lag_s: float) -> tuple[FloatArray, FloatArray]:
    """(N, 2) metres east and north of fixes from a line, and degrees of latitude of its way there.

    Args:
        line: In the order of its times.
        fixes: N of them.
        lag_s: From so long before each to so long after it the way goes.
    """
    north_deg, east_deg = line.at(fixes.time_utc_s)
    across = np.cos(np.radians(north_deg))
    east_m = ((fixes.longitude_deg - east_deg + 180.0) % 360.0 - 180.0) * _DEGREE_M * across
    off_m = np.stack([east_m, (fixes.latitude_deg - north_deg) * _DEGREE_M], axis=1)
    before, after = (line.at(fixes.time_utc_s + apart_s) for apart_s in (-lag_s, lag_s))
    return off_m, np.stack([(after[1] - before[1]) * across, after[0] - before[0]], axis=1)


def _off_line_m(line: Source, fixes: Source) -> tuple[FloatArray, FloatArray]:
    """(M, 2) metres by which fixes miss the line of others: east and north, and across and ahead.

    Args:
        line: In the order of its times.
        fixes: Those beyond its ends do not count.
    """
    fixes = fixes[line.covers(fixes.time_utc_s)]
    off_m, way = _off_and_way(line, fixes, _USUAL_S)
    length = np.hypot(*way.T)
    moves = length > 0.0
    way = way[moves] / length[moves, None]
    right = np.stack([way[:, 1], -way[:, 0]], axis=1)
    turned = np.stack(
        [(off_m[moves] * right).sum(axis=1), (off_m[moves] * way).sum(axis=1)], axis=1
    )
    return off_m, turned if moves.any() else off_m


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
            line = own if line is None else line
            kept |= names == name
    return kept


def apart_m(line: Source, fixes: Source) -> FloatArray:
    """(N,) metres of fixes from where another source was at their times.

    Args:
        line: In the order of its times.
        fixes: N of them.
    """
    return distance_m(fixes.latitude_deg, fixes.longitude_deg, *line.at(fixes.time_utc_s))


def off_board_m(line: Source, fixes: Source) -> FloatArray:
    """Metres of fixes from where, on board of what goes along a line, they mostly are.

    Of what hardly moves nobody knows how it points: then by how much they are further from it, or
    nearer, than mostly.

    Args:
        line: In the order of its times.
        fixes: N of them.
    """
    off_m, way = _off_and_way(line, fixes, _COURSE_S)
    way_m = way * _DEGREE_M
    length_m = np.hypot(*way_m.T)
    moves = length_m > 2.0 * _COURSE_S * _UNDER_WAY_MPS
    if moves.mean() < _MOSTLY:
        apart = np.hypot(*off_m.T)
        return np.asarray(np.abs(apart - np.median(apart)))
    way = way_m[moves] / length_m[moves, None]
    ahead = (off_m[moves] * way).sum(axis=1)
    aside = off_m[moves, 0] * way[:, 1] - off_m[moves, 1] * way[:, 0]
    return np.asarray(np.hypot(ahead - np.median(ahead), aside - np.median(aside)))


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
