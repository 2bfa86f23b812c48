"""Crossings of a boundary by one track, each with its probability.

The error of a smooth track lasts longer than it takes to cross a line, so it is one standard normal
number for the passage: the true distance from the boundary is d(t) + σ(t) e, with σ² = nᵀ P n the
variance across it. With z = d / σ the target is on the right side, or inside, with Φ(z), and
crosses while z goes from a to b with |Φ(b) - Φ(a)|. What a line has beyond its ends does not count:
the place along it, of variance tᵀ P t, is between them with a probability of its own.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, ndtri

from sightline.counting.boundaries import Boundary
from sightline.types import FloatArray, Track

# What the path goes back and forth by less is noise.
_NOISE = 0.01
_LIKELIER_THAN_NOT = 0.5
_LEAST_SIGMA_M = 1e-3
_MOST_PARTS = 256
_QUANTILES = (np.arange(40) + 0.5) / 40.0


@dataclass(frozen=True, eq=False)
class Crossing:
    """A track from one side of a boundary to the other.

    Attributes:
        rising: Whether from left to right, or inwards.
        time_s: (K,) POSIX seconds.
        z: (K,) distances in standard deviations at these, which go one way.
        between_ends: Probability that it is between the ends of the line.
        time_utc_s: When it is expected.
        time_sigma_s: Standard deviation of that.
        speed_mps: Over ground, then.
        speed_sigma_mps: Its standard deviation; NaN where it is not known.
    """

    rising: bool
    time_s: FloatArray
    z: FloatArray
    between_ends: float
    time_utc_s: float
    time_sigma_s: float
    speed_mps: float
    speed_sigma_mps: float

    @property
    def probability(self) -> float:
        """That it was crossed, whenever."""
        return self.between_ends * float(abs(ndtr(self.z[-1]) - ndtr(self.z[0])))

    def levels(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Between which values of Φ(z) the path is in a part of the time, the lower first."""
        a, b = ndtr(np.interp([begin_s, end_s], self.time_s, self.z))
        return float(min(a, b)), float(max(a, b))


@dataclass(frozen=True, eq=False)
class Passage:
    """What a track does at a boundary.

    Attributes:
        known: Whether the track says how unsure it is.
        time_s: (N,) POSIX seconds, the track's own and more where it moves fast.
        z: (N,) distances from the boundary, in standard deviations.
        moored: (N,) 1 while the target is moored, else 0.
        counted: Crossings that are likelier than not.
        possible: All of them, for expectations.
    """

    known: bool
    time_s: FloatArray
    z: FloatArray
    moored: FloatArray
    counted: tuple[Crossing, ...]
    possible: tuple[Crossing, ...]


def passage(track: Track, boundary: Boundary) -> Passage:
    """What a track does at a boundary.

    Args:
        track: Of at least one point.
        boundary: In the plane of the track.
    """
    assert track.moored is not None, "filled in"
    time = _close_times(track, boundary.step_m)

    def column(values: FloatArray) -> FloatArray:
        flat = values.reshape(len(track), -1)
        rows = [np.interp(time, track.time_utc_s, one) for one in flat.T]
        return np.stack(rows, axis=-1).reshape(-1, *values.shape[1:])

    known = bool(np.isfinite(track.covariance_m2).all())
    covariance = column(track.covariance_m2) if known else np.zeros((len(time), 2, 2))
    sides = boundary.sides(column(np.column_stack([track.east_m, track.north_m])))
    normal = sides.normal
    along = np.column_stack([normal[:, 1], -normal[:, 0]])
    across_m, along_m = _sigma(covariance, normal), _sigma(covariance, along)
    moored = column(track.moored.astype(float))
    z = sides.distance_m / across_m
    velocity = np.column_stack([track.velocity_east_mps, track.velocity_north_mps])
    speed = track.speed_mps
    heading = velocity / np.where(speed > 0.0, speed, 1.0)[:, None]
    speed_variance = np.einsum("ni,nij,nj->n", heading, track.velocity_covariance_m2ps2, heading)

    def crossings(least: float) -> tuple[Crossing, ...]:
        found = []
        for begin, end in _legs(ndtr(z), least):
            part = slice(begin, end + 1)
            rising = bool(z[end] > z[begin])
            way = np.maximum.accumulate(z[part]) if rising else np.minimum.accumulate(z[part])
            moments = _times(time[part], way)
            at = float(moments.mean())
            if np.interp(at, time, moored) > 0.5:
                continue
            here = float(np.interp(at, time, sides.along_m))
            sigma = float(np.interp(at, time, along_m))
            ends = 1.0
            if np.isfinite(boundary.length_m):
                ends = float(ndtr(here / sigma) - ndtr((here - boundary.length_m) / sigma))
            variance = float(np.interp(at, track.time_utc_s, speed_variance))
            found.append(
                Crossing(
                    rising=rising,
                    time_s=time[part],
                    z=way,
                    between_ends=ends,
                    time_utc_s=at,
                    time_sigma_s=float(moments.std()) if known else float("nan"),
                    speed_mps=float(np.interp(at, track.time_utc_s, speed)),
                    speed_sigma_mps=float(np.sqrt(max(variance, 0.0)))
                    if variance == variance
                    else float("nan"),
                )
            )
        return tuple(found)

    counted = (
        one for one in crossings(_LIKELIER_THAN_NOT) if one.between_ends > _LIKELIER_THAN_NOT
    )
    return Passage(known, time, z, moored, tuple(counted), crossings(_NOISE))


def moments(low: ArrayLike, high: ArrayLike, weight: ArrayLike) -> tuple[float, float]:
    """Mean and variance of the summed weights of the intervals that an even number falls into.

    Args:
        low: (N,) lower ends, in [0, 1].
        high: (N,) upper ends.
        weight: (N,).
    """
    ends = np.concatenate([np.ravel(low), np.ravel(high)])
    change = np.concatenate([np.ravel(weight), -np.ravel(weight)])
    order = np.argsort(ends, kind="stable")
    level, width = np.cumsum(change[order])[:-1], np.diff(ends[order])
    mean = float((level * width).sum())
    return mean, max(float((level**2 * width).sum()) - mean**2, 0.0)


def time_inside(z_begin: FloatArray, z_end: FloatArray) -> FloatArray:
    """Mean of Φ(z) where z goes evenly from one value to another; (N,)."""
    step = z_end - z_begin
    level = np.abs(step) < 1e-6

    def integral(z: FloatArray) -> FloatArray:
        return np.asarray(z * ndtr(z) + np.exp(-0.5 * z**2) / np.sqrt(2.0 * np.pi))

    mean = (integral(z_end) - integral(z_begin)) / np.where(level, 1.0, step)
    return np.asarray(np.clip(np.where(level, ndtr(0.5 * (z_begin + z_end)), mean), 0.0, 1.0))


def _sigma(covariance: FloatArray, direction: FloatArray) -> FloatArray:
    variance = np.einsum("ni,nij,nj->n", direction, covariance, direction)
    return np.asarray(np.sqrt(np.maximum(variance, _LEAST_SIGMA_M**2)))


def _close_times(track: Track, step_m: float) -> FloatArray:
    """The times of a track, and others between them where its steps are long."""
    steps = np.hypot(np.diff(track.east_m), np.diff(track.north_m))
    parts = np.clip(np.ceil(steps / step_m), 1.0, _MOST_PARTS).astype(np.int64)
    if not len(parts):
        return track.time_utc_s
    begin = np.repeat(track.time_utc_s[:-1], parts)
    which = np.arange(len(begin)) - np.repeat(np.cumsum(parts) - parts, parts)
    between = np.r_[
        begin + which * np.repeat(np.diff(track.time_utc_s) / parts, parts), track.time_utc_s[-1]
    ]
    return np.asarray(between)


def _legs(level: FloatArray, least: float) -> Sequence[tuple[int, int]]:
    """Where the level goes one way, but for less than the least, by the least or more."""
    step = np.sign(np.diff(level))
    moving = np.flatnonzero(step)
    turns = moving[1:][step[moving[1:]] != step[moving[:-1]]]
    corners = [0, *turns.tolist(), len(level) - 1]
    pivots: list[int] = []
    trend, low, high = 0, 0, 0
    for i in corners:
        if trend <= 0 and level[i] < level[low]:
            low = i
        if trend >= 0 and level[i] > level[high]:
            high = i
        if trend <= 0 and level[i] - level[low] >= least:
            pivots.append(low)
            trend, high = 1, i
        elif trend >= 0 and level[high] - level[i] >= least:
            pivots.append(high)
            trend, low = -1, i
    if trend:
        pivots.append(high if trend > 0 else low)
    return list(itertools.pairwise(pivots))


def _times(time: FloatArray, z: FloatArray) -> FloatArray:
    """Quantiles of when a boundary is crossed, given that it is."""
    a, b = ndtr(z[0]), ndtr(z[-1])
    wanted = ndtri(a + (b - a) * _QUANTILES)
    rising = z if z[-1] > z[0] else -z
    return np.asarray(np.interp(wanted if z[-1] > z[0] else -wanted, rising, time))
