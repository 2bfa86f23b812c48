"""Closest approaches of tracks to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from sightline.types import FloatArray, Track


@dataclass(frozen=True)
class NearMiss:
    """The closest point of approach of two tracks, while they are nearer than a limit.

    Attributes:
        track_ids: Of both, in the order of their tracks.
        labels: Their classes.
        time_utc_s: When they were closest.
        distance_m: How far apart they were.
        distance_sigma_m: Its standard deviation; NaN where a track says none.
        probability: That they truly were nearer than the limit; NaN likewise.
        east_m: Halfway between them.
        north_m: Halfway between them.
    """

    track_ids: tuple[int, int]
    labels: tuple[str, str]
    time_utc_s: float
    distance_m: float
    distance_sigma_m: float
    probability: float
    east_m: float
    north_m: float


def near_misses(tracks: Sequence[Track], limit_m: float) -> list[NearMiss]:
    """Closest approaches under a limit, in the order of time.

    Two targets that are both moored then miss nothing. Between their points tracks go straight.

    Args:
        tracks: In one plane.
        limit_m: Metres.
    """
    order = sorted(
        (track for track in tracks if len(track)), key=lambda one: float(one.time_utc_s[0])
    )
    found: list[NearMiss] = []
    for i, first in enumerate(order):
        for second in order[i + 1 :]:
            if second.time_utc_s[0] > first.time_utc_s[-1]:
                break
            if not (first.never_moves and second.never_moves) and _come_near(
                first, second, limit_m
            ):
                found += _of_two(first, second, limit_m)
    return sorted(found, key=lambda one: (one.time_utc_s, one.track_ids))


def _come_near(first: Track, second: Track, limit_m: float) -> bool:
    """Whether the rectangles around two tracks do."""
    return all(
        a.min() - limit_m <= b.max() and b.min() - limit_m <= a.max()
        for a, b in ((first.east_m, second.east_m), (first.north_m, second.north_m))
    )


def _of_two(first: Track, second: Track, limit_m: float) -> Iterator[NearMiss]:
    begin = max(first.time_utc_s[0], second.time_utc_s[0])
    end = min(first.time_utc_s[-1], second.time_utc_s[-1])
    time = np.union1d(first.time_utc_s, second.time_utc_s)
    time = time[(time >= begin) & (time <= end)]
    apart = _place(second, time) - _place(first, time)
    # The closest point within each piece is a moment of its own.
    step = np.diff(apart, axis=0)
    squared = (step**2).sum(axis=1)
    share = -(apart[:-1] * step).sum(axis=1) / np.where(squared > 0.0, squared, 1.0)
    inner = (share > 0.0) & (share < 1.0)
    time = np.union1d(time, (time[:-1] + share * np.diff(time))[inner])
    apart = _place(second, time) - _place(first, time)
    distance = np.hypot(*apart.T)
    still = (_moored(first, time) > 0.5) & (_moored(second, time) > 0.5)
    near = (distance < limit_m) & ~still
    edges = np.flatnonzero(np.diff(np.r_[False, near, False]))
    for a, b in edges.reshape(-1, 2):
        k = a + int(np.argmin(distance[a:b]))
        sigma = _sigma(first, second, float(time[k]), apart[k])
        chance = float("nan")
        if sigma == sigma:
            chance = float(ndtr((limit_m - distance[k]) / max(sigma, 1e-9)))
        middle = _place(first, time[k : k + 1])[0] + 0.5 * apart[k]
        yield NearMiss(
            track_ids=(first.track_id, second.track_id),
            labels=(first.label, second.label),
            time_utc_s=float(time[k]),
            distance_m=float(distance[k]),
            distance_sigma_m=sigma,
            probability=chance,
            east_m=float(middle[0]),
            north_m=float(middle[1]),
        )


def _sigma(first: Track, second: Track, time_s: float, apart_m: FloatArray) -> float:
    """Standard deviation of a distance; along the widest axis where it is zero."""
    covariance = np.zeros((2, 2))
    for track in (first, second):
        flat = track.covariance_m2.reshape(-1, 4).T
        covariance += np.reshape([np.interp(time_s, track.time_utc_s, c) for c in flat], (2, 2))
    if not np.isfinite(covariance).all():
        return float("nan")
    distance = float(np.hypot(*apart_m))
    if distance < 1e-9:
        return float(np.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)))
    direction = apart_m / distance
    return float(np.sqrt(max(float(direction @ covariance @ direction), 0.0)))


def _place(track: Track, time_s: FloatArray) -> FloatArray:
    columns = (track.east_m, track.north_m)
    return np.column_stack([np.interp(time_s, track.time_utc_s, one) for one in columns])


def _moored(track: Track, time_s: FloatArray) -> FloatArray:
    assert track.moored is not None, "filled in"
    return np.asarray(np.interp(time_s, track.time_utc_s, track.moored.astype(float)))
