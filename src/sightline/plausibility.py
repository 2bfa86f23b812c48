"""Plausibility: the fixes of a log that cannot be true, whoever wrote them.

Three things are looked for, each with a bound that no vessel and no vehicle reaches, so that a
good log loses nothing:

* A fix at 0° north, 0° east, which receivers write that have none (unless the others lie there).
* A fix that nothing could have reached from the others: the longest chain of fixes that follow
  each other at `FASTEST_MPS` is kept, as wrong fixes come in short stretches.
* A short stretch off the track and back. Who leaves his line by d metres within a time t, from
  rest to rest against it, accelerates by 4 d / t² at least; what would take more than
  `HARDEST_MPS2` both out and back again, between fixes that fit each other without it, did not
  happen. A jump counts only where it stands out from the noise of its log, from what its places
  were rounded to, and from `SMALLEST_JUMP_M`.

A step to another place without a return is left: nothing tells which side of it is right.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sightline.errors import InputError
from sightline.synchronisation import repeated, spread_times
from sightline.types import BoolArray, Fixes, FloatArray, IntArray

FASTEST_MPS = 100.0
"""No vessel and no vehicle on the ground is faster; trains reach 90 m/s."""

HARDEST_MPS2 = 10.0
"""Tyres hold about 1 g; vessels reach a third of it."""

SMALLEST_JUMP_M = 10.0
"""Receivers without corrections wander by some metres from fix to fix, and mean it."""

LONGEST_STRETCH = 10
"""Most fixes in a stretch off the track; longer ones are looked at for what could be reached."""

FARTHEST_M = 1_000_000.0
"""No camera sees a vessel or a vehicle that is further away than this, by far."""

FARTHEST_SEEN_M = 100_000.0
"""What one camera sees lies closer together; from a hill of 500 m the sea ends at 80 km."""

_EARTH_M = 6_371_008.8
_REACH_SLACK_M = 50.0
_NOISES = 8.0
_LOCAL_NOISES = 4.0
_MAD = 1.4826
_GRIDS, _ON_GRID = 2.5, 1e-3
_NEIGHBOURS = 4
_LOCAL = 15
_AT_AN_END = 2
_LOOK_BACK = 300
_NO_PLACE_DEG = 1e-5
_NEAR_ZERO_DEG = 0.5


@dataclass(frozen=True, eq=False)
class Implausible:
    """Which fixes of a log cannot be true, or say nothing new; each is in one of the four.

    Attributes:
        nowhere: (N,) bool, at 0° north, 0° east.
        repeated: (N,) bool, of the time and the place of one before.
        out_of_reach: (N,) bool, not to be reached from the others at `FASTEST_MPS`.
        astray: (N,) bool, off the track and back at more than `HARDEST_MPS2`.
    """

    nowhere: BoolArray
    repeated: BoolArray
    out_of_reach: BoolArray
    astray: BoolArray

    @property
    def kept(self) -> BoolArray:
        """(N,) bool, what is left."""
        return ~(self.nowhere | self.repeated | self.out_of_reach | self.astray)


def implausible(
    time_utc_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> Implausible:
    """Find the fixes of a log that cannot be true.

    Args:
        time_utc_s: (N,) POSIX seconds, never decreasing but for what stands twice.
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
    """
    nowhere = _nowhere(latitude_deg, longitude_deg)
    twice = np.zeros_like(nowhere)
    rows = np.flatnonzero(~nowhere)
    twice[rows] = repeated(time_utc_s[rows], latitude_deg[rows], longitude_deg[rows])
    out_of_reach, astray = np.zeros_like(nowhere), np.zeros_like(nowhere)
    rows = np.flatnonzero(~(nowhere | twice))
    reached = _longest_chain(time_utc_s[rows], latitude_deg[rows], longitude_deg[rows])
    out_of_reach[rows[~reached]] = True
    rows = rows[reached]
    times = spread_times(time_utc_s[rows])
    while True:
        off = _astray(times, latitude_deg[rows], longitude_deg[rows])
        if not off.any():
            return Implausible(nowhere, twice, out_of_reach, astray)
        astray[rows[off]] = True
        rows, times = rows[~off], times[~off]


def _nowhere(latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
    zero = (np.abs(latitude_deg) < _NO_PLACE_DEG) & (np.abs(longitude_deg) < _NO_PLACE_DEG)
    if zero.any() and not zero.all():
        others = np.hypot(latitude_deg[~zero], longitude_deg[~zero])
        if np.median(others) < _NEAR_ZERO_DEG:
            return np.zeros_like(zero)
    return np.asarray(zero)


def distance_m(
    latitude_deg: FloatArray,
    longitude_deg: FloatArray,
    other_latitude_deg: FloatArray,
    other_longitude_deg: FloatArray,
) -> FloatArray:
    """Great-circle distance on a sphere, metres; good to half a per cent, also across ±180°."""
    first, second = np.radians(latitude_deg), np.radians(other_latitude_deg)
    across = np.radians(np.subtract(other_longitude_deg, longitude_deg))
    half = (
        np.sin((second - first) / 2.0) ** 2
        + np.cos(first) * np.cos(second) * np.sin(across / 2.0) ** 2
    )
    return np.asarray(2.0 * _EARTH_M * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0))))


def check_together(
    latitude_deg: FloatArray, longitude_deg: FloatArray, names: Sequence[str], where: str
) -> None:
    """Raise InputError where a place is further from the middle of all than one camera sees.

    Args:
        latitude_deg: (N,) degrees north.
        longitude_deg: (N,) degrees east.
        names: (N,) what to call each place, for the message.
        where: The file, for the message.

    Raises:
        InputError: One is; with fewer than three places nobody could tell which.
    """
    if len(names) < 3:
        return
    beside = (longitude_deg - longitude_deg[0] + 180.0) % 360.0 - 180.0
    north, east = np.median(latitude_deg, keepdims=True), np.median(beside, keepdims=True)
    away_m = distance_m(latitude_deg, longitude_deg, north, longitude_deg[0] + east)
    i = int(np.argmax(away_m))
    if away_m[i] > FARTHEST_SEEN_M:
        raise InputError(
            f"{where}: {names[i]} lies {away_m[i] / 1000.0:,.0f} km from the others, at "
            f"{latitude_deg[i]:.6f}, {longitude_deg[i]:.6f}; one camera does not see so far"
        )


def check_near(
    fixes: Fixes, latitude_deg: float, longitude_deg: float, where: str, what: str
) -> None:
    """Raise InputError where no fix of a log is within `FARTHEST_M` of a place.

    Nor may one be within `FARTHEST_SEEN_M` only with latitude and longitude the other way round.

    Args:
        fixes: The log.
        latitude_deg: Of the place, degrees north.
        longitude_deg: Degrees east.
        where: Which log, for the message.
        what: What is at the place, for the message: ``the camera``.

    Raises:
        InputError: None is; says how far the nearest is, and whether it would be near with latitude
            and longitude the other way round.
    """
    if not len(fixes):
        return
    place = np.array([latitude_deg]), np.array([longitude_deg])
    away_m = distance_m(fixes.latitude_deg, fixes.longitude_deg, *place)
    nearest = int(np.argmin(away_m))
    if away_m[nearest] <= FARTHEST_SEEN_M:
        return
    swapped = fixes.longitude_deg[nearest : nearest + 1], fixes.latitude_deg[nearest : nearest + 1]
    turned_m = float(distance_m(*swapped, *place)[0]) if abs(swapped[0][0]) <= 90.0 else np.inf
    mend = "is it the right log?"
    # Near the line of equal latitude and longitude what is swapped stays near.
    if turned_m <= min(FARTHEST_M, 0.1 * away_m[nearest]):
        mend = "are latitude and longitude swapped?"
    elif away_m[nearest] <= FARTHEST_M:
        return
    raise InputError(
        f"{where}: its nearest fix is {away_m[nearest] / 1000.0:,.0f} km from {what}, at "
        f"{fixes.latitude_deg[nearest]:.6f}, {fixes.longitude_deg[nearest]:.6f}; {mend}"
    )


def _longest_chain(
    time_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> BoolArray:
    """(N,) bool, the most fixes of which each could be reached from the one before.

    Of chains of the same length it is the one with the shortest way.
    """
    # Whole seconds may have lost almost one.
    cut_off_s = 1.0 if np.array_equal(time_s, np.floor(time_s)) else 0.0
    slack_m = max(_REACH_SLACK_M, _GRIDS * _grid_m(latitude_deg, longitude_deg))

    def way(before: IntArray, after: IntArray) -> tuple[FloatArray, BoolArray]:
        """Metres between fixes, and whether they could be gone."""
        way_m = distance_m(
            latitude_deg[before], longitude_deg[before], latitude_deg[after], longitude_deg[after]
        )
        most_s = time_s[after] - time_s[before] + cut_off_s
        return way_m, np.asarray(way_m <= FASTEST_MPS * most_s + slack_m)

    n = time_s.size
    rows = np.arange(n)
    breaks = np.flatnonzero(~way(rows[:-1], rows[1:])[1]) + 1
    if not breaks.size:
        return np.ones(n, dtype=bool)
    # The way to a wrong fix may be just short enough, and only that back too long: what is near a
    # break is taken fix by fix, all else in one piece.
    near = np.unique(breaks[:, None] + np.arange(-LONGEST_STRETCH, LONGEST_STRETCH + 1))
    breaks = near[(near > 0) & (near < n)]
    first, last = np.append(0, breaks), np.append(breaks, n) - 1
    most = (last - first + 1).astype(float)
    previous = np.full(first.size, -1)
    for i in range(1, first.size):
        start = max(0, i - _LOOK_BACK)
        way_m, ok = way(last[start:i], np.full(i - start, first[i]))
        if ok.any():
            # No way on the earth is long enough to weigh as much as a fix.
            score = np.where(ok, most[start:i] - way_m / (_LOOK_BACK * 1e9), -np.inf)
            best = int(np.argmax(score))
            most[i] += score[best]
            previous[i] = start + best
    kept = np.zeros(n, dtype=bool)
    at = int(np.argmax(most))
    while at >= 0:
        kept[first[at] : last[at] + 1] = True
        at = int(previous[at])
    return kept


def _astray(time_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
    """(N,) bool, fixes of short stretches off the track."""
    n = time_s.size
    off = np.zeros(n, dtype=bool)
    if n < _NEIGHBOURS + 1:
        return off
    step_s, jump_m = _jumps(time_s, latitude_deg, longitude_deg)
    size_m = np.hypot(*jump_m.T)
    noise_m = np.maximum(
        _NOISES * _MAD * float(np.median(size_m)),
        _LOCAL_NOISES * _rolling_median(size_m[:, None], _LOCAL)[:, 0],
    )
    floor_m = np.maximum(
        max(SMALLEST_JUMP_M, _GRIDS * _grid_m(latitude_deg, longitude_deg)), noise_m
    )
    bound_m = np.maximum(floor_m, HARDEST_MPS2 * step_s**2 / 4.0)
    breaks = np.flatnonzero(size_m > bound_m)
    if not breaks.size:
        return off
    total = np.vstack([np.zeros(2), np.cumsum(jump_m, axis=0)])
    free = 0
    for i, out in enumerate(breaks):
        if out < free:
            continue
        for back in breaks[i + 1 :]:
            if back - out > LONGEST_STRETCH:
                break
            left_m = np.hypot(*(total[back + 1] - total[out]))
            if left_m < 0.5 * max(size_m[out], size_m[back]) and _lonely(
                breaks, n, int(out), int(back)
            ):
                off[out + 1 : back + 1] = True
                free = back + 1
                break
    if not off.any():
        off[_at_ends(step_s, size_m / bound_m)] = True
    return off


def _grid_m(latitude_deg: FloatArray, longitude_deg: FloatArray) -> float:
    """Metres to which places were rounded, as decimals of degrees or of minutes; 0 for finer."""
    grid_deg = max(_grid_deg(latitude_deg), _grid_deg(longitude_deg))
    return float(np.radians(grid_deg) * _EARTH_M)


def _grid_deg(values_deg: FloatArray) -> float:
    for grid_deg in (1e-2, 1e-2 / 6.0, 1e-3, 1e-3 / 6.0, 1e-4, 1e-4 / 6.0):
        steps = values_deg / grid_deg
        if (np.abs(steps - np.round(steps)) < _ON_GRID).all():
            return grid_deg
    return 0.0


def _lonely(breaks: IntArray, n: int, out: int, back: int) -> bool:
    """Whether a stretch is no longer than what is whole on both sides of it."""
    before = breaks[breaks < out]
    after = breaks[breaks > back]
    left = out - (before[-1] if before.size else -1)
    right = (after[0] if after.size else n - 1) - back
    return bool(back - out <= min(left, right))


def _at_ends(step_s: FloatArray, excess: FloatArray) -> IntArray:
    """Fixes at an end of the log, or beside a gap, that lie far off what follows or precedes.

    Nothing comes back there, so that three times the bound is asked for.
    """
    gaps = np.flatnonzero(step_s > max(10.0, 5.0 * float(np.median(step_s))))
    found = []
    # A piece is the fixes first to last, the steps first to last - 1.
    for first, last in zip(np.append(0, gaps + 1), np.append(gaps, step_s.size), strict=True):
        if last - first < _AT_AN_END + _NEIGHBOURS:
            continue
        far = excess[first:last] > 3.0
        if far.sum() != 1:
            continue
        at = first + int(np.argmax(far))
        if at - first < _AT_AN_END:
            found.append(np.arange(first, at + 1))
        elif last - at <= _AT_AN_END:
            found.append(np.arange(at + 1, last + 1))
    return np.concatenate(found) if found else np.empty(0, dtype=np.int64)


def _jumps(
    time_s: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Seconds of each step, (N - 1,), and metres by which it misses those around, (N - 1, 2)."""
    step_s = np.diff(time_s)
    across_deg = (np.diff(longitude_deg) + 180.0) % 360.0 - 180.0
    metres = np.radians(1.0) * _EARTH_M
    east_m = across_deg * metres * np.cos(np.radians(latitude_deg[1:] + latitude_deg[:-1]) / 2.0)
    way_m = np.stack([east_m, np.diff(latitude_deg) * metres], axis=1)
    usual_mps = _rolling_median(way_m / np.maximum(step_s, 1e-3)[:, None], 2 * _NEIGHBOURS + 1)
    return step_s, way_m - usual_mps * step_s[:, None]


def _rolling_median(values: FloatArray, width: int) -> FloatArray:
    """Median of each column over the rows around each row, fewer at the ends."""
    half = width // 2
    padded = np.pad(values, ((half, half), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
    return np.asarray(np.nanmedian(windows, axis=-1))
