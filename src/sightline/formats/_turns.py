"""Fixes of two receivers of one name that wrote into one log by turns."""

from __future__ import annotations

import numpy as np

from sightline.formats._receivers import FIT_M, Source, apart_m, offset_is_certain
from sightline.types import BoolArray, FloatArray, IntArray

_FEWEST = 10
_OUT_OF_ORDER = 0.1
# Of the fixes of the smaller receiver, between how many the other one speaks.
_TURNS = 0.5
_LEAST_GAP_S, _GAPS = 10.0, 5.0
# Steps within such a share of their interval are alike, and so many have to be.
_ALIKE = 0.1
_MOST_ARE = 0.9
_PAIRS = 0.8
# Of what two clocks are apart.
_STEADY = 0.5
_STALE = 0.4


def by_turns(fixes: Source, *, most_m: float = float("inf")) -> IntArray:
    """(N,) int64, which of several receivers that take turns each fix is of; zero if of one.

    Two whose clocks differ by more than an interval go to and fro in time. Two whose clocks are
    less apart have each a fix an interval, and miss each other's line to opposite sides: another
    antenna does, or a clock that is some tenths off, and a single receiver does not. Where nothing
    tells the two apart, taking both for one does no harm.

    Args:
        fixes: N of them, of one name, in the order of the log.
        most_m: Further apart they are not of one vessel, and not told apart.
    """
    one = np.zeros(len(fixes), dtype=np.int64)
    if len(fixes) < 2 * _FEWEST:
        return one
    if (np.diff(fixes.time_utc_s) < 0.0).mean() > _OUT_OF_ORDER:
        return by_clock(fixes.time_utc_s)
    stands = (np.diff(fixes.latitude_deg) == 0.0) & (np.diff(fixes.longitude_deg) == 0.0)
    if stands.mean() > _STALE:
        # A receiver that writes more often than it finds a place.
        return one
    turn, own_s = _by_step(fixes.time_utc_s)
    second = turn == 1
    if min(second.sum(), (~second).sum()) < _FEWEST:
        return one
    dated = Source(own_s, fixes.latitude_deg, fixes.longitude_deg)
    # By the times that stand there: what is written twice is of no other receiver.
    apart = float(np.median(apart_m(fixes[~second], fixes[second])))
    if not FIT_M < apart < most_m:
        return one
    first, other = dated[~second].sorted_by_time(), dated[second].sorted_by_time()
    return turn if offset_is_certain(first, other) else one


def by_clock(time_s: FloatArray, *, least_s: float = 0.0) -> IntArray:
    """Which of several clocks each of times that go to and fro is of; zero if they are of one.

    What arrives late is late by now this, now that; clocks stay as far apart as they are.

    Args:
        time_s: (N,) seconds, in the order of the log.
        least_s: Clocks nearer than this are not told apart.
    """
    if time_s.size < 2 * _FEWEST or not (np.diff(time_s) < 0.0).mean() > _OUT_OF_ORDER:
        return np.zeros(time_s.size, dtype=np.int64)
    steps_s = np.abs(np.concatenate([np.diff(time_s), time_s[2:] - time_s[:-2]]))
    longest_s = max(_LEAST_GAP_S, _GAPS * float(np.percentile(steps_s, 25.0)))
    clock = np.zeros(time_s.size, dtype=np.int64)
    last_s: list[float] = []
    for i, now_s in enumerate(time_s.tolist()):
        waits = [now_s - before_s for before_s in last_s]
        able = [k for k, wait_s in enumerate(waits) if 0.0 <= wait_s <= longest_s]
        clock[i] = min(able, key=waits.__getitem__) if able else len(last_s)
        if able:
            last_s[clock[i]] = now_s
        else:
            last_s.append(now_s)
    counts = np.bincount(clock)
    few = counts < _FEWEST
    if counts.size - few.sum() < 2 or counts[few].sum() > _OUT_OF_ORDER * time_s.size:
        return np.zeros_like(clock)
    usual = np.flatnonzero(~few)
    turns = (np.diff(clock) != 0).sum()
    if turns < _TURNS * (time_s.size - counts.max()):
        # One after the other: a clock that was set, or two logs in one file.
        return np.zeros_like(clock)
    # As others of a clock stand around it; the first of one may be near to the last of another.
    off_s = np.stack([time_s - _between(time_s, clock == number) for number in usual])
    clock = np.asarray(np.argmin(np.abs(off_s), axis=0), dtype=np.int64)
    for number in range(usual.size):
        for own_s in off_s[np.arange(usual.size) != number][:, clock == number]:
            lag_s = float(np.median(own_s))
            if abs(lag_s) < least_s or np.mean(np.abs(own_s - lag_s) < _STEADY * abs(lag_s)) < 0.5:
                return np.zeros_like(clock)
    return clock


def _between(time_s: FloatArray, rows: BoolArray) -> FloatArray:
    """(N,) times of a clock at each place of the log, from its rows before and after the place."""
    own = np.flatnonzero(rows)
    at = np.arange(time_s.size)
    before = own[np.maximum(np.searchsorted(own, at, side="left") - 1, 0)]
    after = own[np.minimum(np.searchsorted(own, at, side="right"), own.size - 1)]
    # Before the first and after the last the nearer one stands for both.
    before = np.where(before >= at, after, before)
    after = np.where(after <= at, before, after)
    share = (at - before) / np.maximum(after - before, 1)
    return np.asarray(time_s[before] + share * (time_s[after] - time_s[before]))


def _by_step(time_s: FloatArray) -> tuple[IntArray, FloatArray]:
    """(N,) whose turn it is at times that never decrease, and when it would be if of one alone.

    Zero where the steps are not those of two that take turns, nor of one that has a fix twice as
    often.
    """
    none = np.zeros(time_s.size, dtype=np.int64)
    times_s, first, group, count = np.unique(
        time_s, return_index=True, return_inverse=True, return_counts=True
    )
    if count[count == 2].sum() > _PAIRS * time_s.size and times_s.size > 1:
        place = np.minimum(np.arange(time_s.size) - first[group], 1)
        return place, time_s + place * 0.5 * float(np.median(np.diff(times_s)))
    interval_s = float(np.median(time_s[2:] - time_s[:-2]))
    if interval_s <= 0.0:
        return none, time_s
    share = np.mod(np.diff(time_s) / interval_s, 1.0)
    again = np.minimum(share, 1.0 - share) < _ALIKE
    turns = np.minimum(share, 1.0 - share)[~again]
    if turns.size < _MOST_ARE * share.size:
        return none, time_s
    alike = np.abs(turns - np.median(turns)) < _ALIKE
    if alike.mean() < _MOST_ARE:
        return none, time_s
    return np.append(0, np.cumsum(~again)) % 2, time_s
