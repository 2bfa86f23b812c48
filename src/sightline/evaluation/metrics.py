"""Errors of positions against a log: absolute, relative, by range, and beside what was stated.

All of it acts on `ScoredPairs`: positions and where the log says that the target was at the same
times. The camera stands at the origin of the plane.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.platform import Platform
from sightline.synchronisation import LARGEST_GAP_S, synchronise
from sightline.types import BoolArray, Fixes, FloatArray, IntArray, Positions, Track

DELTA_S = 1.0
"""The time over which the relative error is taken, where none is given."""

RANGE_EDGES_M = (
    *(0.0, 25.0, 50.0, 75.0, 100.0, 150.0, 200.0, 300.0, 500.0, 750.0),
    *(1000.0, 1500.0, 2000.0, 3000.0, 5000.0, 7500.0, 10000.0, np.inf),
)
"""Edges of the bins of range, fixed so that the reports of two scenes can be compared."""

_AT_CAMERA_M = 1e-3
"""A target this near to the camera has no direction from it, nor an error per range."""

_SAME_TIME_S = 1e-6
"""Times closer than this are one: POSIX seconds in float64 are good to a quarter of it."""


@dataclass(frozen=True, eq=False)
class ScoredPairs:
    """Positions beside the log's positions at the same times.

    Attributes:
        time_utc_s: (N,) float64, finite.
        east_m: (N,) float64, estimated, finite.
        north_m: (N,) float64.
        covariance_m2: (N, 2, 2) float64, as stated by the estimate; NaN where it states none.
        true_east_m: (N,) float64, from the log, finite.
        true_north_m: (N,) float64.
        segment: (N,) int64. Relative errors are taken inside a segment, never from one to the
            next: a segment is a recording or a track.
        asked: How many times were looked up; at least N.
        without_position: How many of those the log knows but the estimate has no position for.
        camera_position_m: (N, 2) float64, east and north of the camera; absent: at the origin.
        reference_sigma_m: (N,) float64, how far off the log itself is believed to be, east and
            north;
            absent: not at all.

    Raises:
        InputError: A column is of another length, or a position is not finite.
    """

    time_utc_s: FloatArray
    east_m: FloatArray
    north_m: FloatArray
    covariance_m2: FloatArray
    true_east_m: FloatArray
    true_north_m: FloatArray
    segment: IntArray
    asked: int
    without_position: int = 0
    camera_position_m: FloatArray | None = None
    reference_sigma_m: FloatArray | None = None

    def __post_init__(self) -> None:
        n = np.size(self.time_utc_s)
        for name in ("time_utc_s", "east_m", "north_m", "true_east_m", "true_north_m"):
            self._freeze(name, np.array(getattr(self, name), dtype=np.float64), (n,))
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"ScoredPairs.{name} has a value that is no number")
        self._freeze("covariance_m2", np.array(self.covariance_m2, dtype=np.float64), (n, 2, 2))
        self._freeze("segment", np.array(self.segment, dtype=np.int64), (n,))
        camera_position_m = (
            np.zeros((n, 2)) if self.camera_position_m is None else self.camera_position_m
        )
        self._freeze("camera_position_m", np.array(camera_position_m, dtype=np.float64), (n, 2))
        reference_sigma_m = (
            np.zeros(n) if self.reference_sigma_m is None else self.reference_sigma_m
        )
        self._freeze("reference_sigma_m", np.array(reference_sigma_m, dtype=np.float64), (n,))
        if self.asked < n:
            raise InputError(f"{n} pairs cannot come from {self.asked} times")

    def _freeze(self, name: str, array: NDArray[np.generic], shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            raise InputError(f"ScoredPairs.{name} has shape {array.shape}, expected {shape}")
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return int(self.time_utc_s.size)

    @classmethod
    def concatenate(cls, tables: Iterable[ScoredPairs]) -> ScoredPairs:
        """One table with the rows of all; no segment of one is a segment of another."""
        parts: list[ScoredPairs] = []
        first = 0
        for table in tables:
            names, segment = np.unique(table.segment, return_inverse=True)
            parts.append(replace(table, segment=segment + first))
            first += names.size
        if not parts:
            empty = np.empty(0)
            return cls(
                empty, empty, empty, np.empty((0, 2, 2)), empty, empty, np.empty(0, np.int64), 0
            )
        columns = ("time_utc_s", "east_m", "north_m", "covariance_m2", "true_east_m")
        return cls(
            **{
                name: np.concatenate([getattr(part, name) for part in parts])
                for name in (
                    *columns,
                    "true_north_m",
                    "segment",
                    "camera_position_m",
                    "reference_sigma_m",
                )
            },
            asked=sum(part.asked for part in parts),
            without_position=sum(part.without_position for part in parts),
        )

    def with_log_error(self) -> ScoredPairs:
        """The same, with covariances that answer for the log's own error as well."""
        assert self.reference_sigma_m is not None, "filled in where it is absent"
        of_log = np.square(self.reference_sigma_m)[:, None, None] * np.eye(2)
        return replace(self, covariance_m2=self.covariance_m2 + of_log)

    @property
    def error_m(self) -> FloatArray:
        """(N,) metres from the true position to the estimated one."""
        return np.hypot(self.east_m - self.true_east_m, self.north_m - self.true_north_m)

    @property
    def true_sight_m(self) -> FloatArray:
        """(N, 2) metres east and north from the camera to the true position."""
        assert self.camera_position_m is not None, "filled in where it is absent"
        return np.stack([self.true_east_m, self.true_north_m], axis=1) - self.camera_position_m

    @property
    def true_range_m(self) -> FloatArray:
        """(N,) metres from the camera to the true position."""
        return np.asarray(np.hypot(*self.true_sight_m.T))

    @property
    def share(self) -> float:
        """The share of the times asked for that are compared, 0 to 1; NaN if none was asked."""
        return len(self) / self.asked if self.asked else float("nan")


def pair_positions(
    time_utc_s: ArrayLike,
    positions: Positions,
    fixes: Fixes,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
    platform: Platform | None = None,
    reference_sigma_m: float = 0.0,
) -> ScoredPairs:
    """Single positions beside a log, as one segment.

    Args:
        time_utc_s: (N,) POSIX seconds of the positions; NaN is never matched.
        positions: N positions.
        fixes: The log.
        largest_gap_s: Times between fixes that are further apart are not compared.
        platform: What the camera stood on, where that moved.
        reference_sigma_m: How far off the log itself is believed to be, metres east and north.

    Raises:
        InputError: There are more times than positions or the reverse.
    """
    times = np.asarray(time_utc_s, dtype=np.float64)
    if times.shape != (len(positions),):
        raise InputError(f"{len(positions)} positions need as many times, not {times.shape}")
    log = synchronise(fixes, times, positions.plane, largest_gap_s=largest_gap_s)
    keep = log.matched & positions.known
    return ScoredPairs(
        time_utc_s=times[keep],
        east_m=positions.east_m[keep],
        north_m=positions.north_m[keep],
        covariance_m2=positions.covariance_m2[keep],
        true_east_m=log.east_m[keep],
        true_north_m=log.north_m[keep],
        segment=np.zeros(int(keep.sum()), dtype=np.int64),
        asked=times.size,
        without_position=int((log.matched & ~positions.known).sum()),
        camera_position_m=_camera_position(platform, times[keep], positions.plane),
        reference_sigma_m=np.full(int(keep.sum()), reference_sigma_m),
    )


def _camera_position(
    platform: Platform | None, times: FloatArray, plane: LocalPlane
) -> FloatArray | None:
    return None if platform is None else platform.pose(times, plane).en_m


def pair_track(
    track: Track,
    fixes: Fixes,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
    platform: Platform | None = None,
    reference_sigma_m: float = 0.0,
) -> ScoredPairs:
    """A track beside a log at the track's own times, as one segment.

    Args:
        track: The track.
        fixes: The log.
        largest_gap_s: Times between fixes that are further apart are not compared.
        platform: What the camera stood on, where that moved.
        reference_sigma_m: How far off the log itself is believed to be, metres east and north.
    """
    log = synchronise(fixes, track.time_utc_s, track.plane, largest_gap_s=largest_gap_s)
    keep = log.matched
    return ScoredPairs(
        time_utc_s=track.time_utc_s[keep],
        east_m=track.east_m[keep],
        north_m=track.north_m[keep],
        covariance_m2=track.covariance_m2[keep],
        true_east_m=log.east_m[keep],
        true_north_m=log.north_m[keep],
        segment=np.zeros(int(keep.sum()), dtype=np.int64),
        asked=len(track),
        camera_position_m=_camera_position(platform, track.time_utc_s[keep], track.plane),
        reference_sigma_m=np.full(int(keep.sum()), reference_sigma_m),
    )


@dataclass(frozen=True)
class AbsoluteError:
    """The absolute pose error of section 4.4, of positions (they have no orientation).

    Attributes:
        n: Correspondences compared.
        rmse: Metres; NaN, as all others, where there is no pair.
        mse: Square metres.
        mean: Metres.
        median: Metres.
        p90: Metres, the 90th percentile.
        max: Metres.
        per_range: Mean of error divided by the true distance from the camera.
    """

    n: int
    rmse: float
    mse: float
    mean: float
    median: float
    p90: float
    max: float
    per_range: float


@dataclass(frozen=True)
class RelativeError:
    """The relative pose error of section 4.4 over a fixed time, of positions.

    Attributes:
        delta_s: Seconds from the one pose of a pair to the other.
        n: Correspondences of poses.
        rmse: Metres; NaN, as all others, where there is no pair.
        mse: Square metres.
        mean: Metres.
        median: Metres.
    """

    delta_s: float
    n: int
    rmse: float
    mse: float
    mean: float
    median: float


@dataclass(frozen=True)
class Coverage:
    """How often the log lies inside the stated ellipse; an honest estimate has p50 = 0.5.

    Ellipses are about the target itself, and a log is off as well. Where it is known by how much,
    an honest estimate has ``p50_with_log`` = 0.5, and ``p50`` below.

    Attributes:
        p50: Share of the log's positions inside the stated 50 % ellipse; NaN where none is stated.
        p95: The same of the 95 % ellipse.
        n: Correspondences that state a covariance.
        reference_sigma_m: How far off the log itself is believed to be, metres east and north, root
            mean square; 0 where nobody says.
        p50_with_log: As ``p50``, of ellipses that answer for the log's own error as well.
        p95_with_log: The same of the 95 % ellipse.
    """

    p50: float
    p95: float
    n: int
    reference_sigma_m: float
    p50_with_log: float
    p95_with_log: float


@dataclass(frozen=True)
class LineOfSight:
    """The error along the camera's line of sight to the true position, and across it.

    Attributes:
        bias_along: Metres, mean; positive is too far from the camera.
        bias_across: Metres, mean; positive is too far clockwise, to the right as the camera sees.
        rmse_along: Metres.
        rmse_across: Metres.
    """

    bias_along: float
    bias_across: float
    rmse_along: float
    rmse_across: float


@dataclass(frozen=True)
class RangeBin:
    """The absolute error of the pairs whose true distance from the camera lies in an interval.

    Attributes:
        from_m: Metres, included.
        to_m: Metres, excluded; may be infinite.
        n: Correspondences.
        rmse: Metres.
        median: Metres.
    """

    from_m: float
    to_m: float
    n: int
    rmse: float
    median: float


def absolute_error(pairs: ScoredPairs) -> AbsoluteError:
    """Absolute pose error, equation of section 4.4: the mean over time of ``(x ⊖ x*)²``.

    Estimate and log share the plane, so nothing is aligned.
    """
    error = pairs.error_m
    if error.size == 0:
        nan = float("nan")
        return AbsoluteError(0, nan, nan, nan, nan, nan, nan, nan)
    distance = pairs.true_range_m
    away = distance > _AT_CAMERA_M
    mse = float(error @ error) / error.size
    median, p90 = np.percentile(error, (50.0, 90.0))
    return AbsoluteError(
        n=error.size,
        rmse=float(np.sqrt(mse)),
        mse=mse,
        mean=float(error.mean()),
        median=float(median),
        p90=float(p90),
        max=float(error.max()),
        per_range=_mean(error[away] / distance[away]),
    )


def relative_error(
    pairs: ScoredPairs, delta_s: float = DELTA_S, *, largest_gap_s: float = LARGEST_GAP_S
) -> RelativeError:
    """Relative pose error, section 4.4: how far movement over a time differs from the log's.

    The mean of ``((x*(t+Δ) ⊖ x*(t)) ⊖ (x(t+Δ) ⊖ x(t)))²`` over the times ``t`` of the pairs,
    where ``t+Δ`` lies in the same segment. Estimate and log are interpolated to ``t+Δ``, so
    irregular times are compared over exactly Δ. Where Δ is shorter than the time between poses
    the error is the chord's, and looks smaller than that of any pose.

    Args:
        pairs: The pairs.
        delta_s: Δ in seconds, positive.
        largest_gap_s: Nothing is interpolated between poses that are further apart.

    Raises:
        InputError: Δ is not positive.
    """
    error = relative_errors(pairs, delta_s, largest_gap_s=largest_gap_s)
    if error.size == 0:
        nan = float("nan")
        return RelativeError(delta_s, 0, nan, nan, nan, nan)
    mse = float(error @ error) / error.size
    return RelativeError(
        delta_s=delta_s,
        n=error.size,
        rmse=float(np.sqrt(mse)),
        mse=mse,
        mean=float(error.mean()),
        median=float(np.median(error)),
    )


def relative_errors(
    pairs: ScoredPairs, delta_s: float = DELTA_S, *, largest_gap_s: float = LARGEST_GAP_S
) -> FloatArray:
    """The single relative errors that `relative_error` sums up: (M,) metres.

    Args:
        pairs: The pairs.
        delta_s: Δ in seconds, positive.
        largest_gap_s: Nothing is interpolated between poses that are further apart.

    Raises:
        InputError: Δ is not positive.
    """
    if not (np.isfinite(delta_s) and delta_s > 0.0):
        raise InputError(f"the time of the relative error is {delta_s:g} s; it must be positive")
    order = np.lexsort((pairs.time_utc_s, pairs.segment))
    times, segment = pairs.time_utc_s[order], pairs.segment[order]
    # Interpolation is linear, so the difference of the interpolated paths is the interpolated
    # difference, and the order of the two ⊖ does not matter without rotations.
    offset = np.column_stack(
        [pairs.east_m - pairs.true_east_m, pairs.north_m - pairs.true_north_m]
    )[order]
    bounds = np.flatnonzero(np.diff(segment)) + 1
    parts = [
        _relative_in_segment(part_times, part_offset, delta_s, largest_gap_s)
        for part_times, part_offset in zip(
            np.split(times, bounds), np.split(offset, bounds), strict=True
        )
    ]
    return np.concatenate(parts)


def _relative_in_segment(
    times: FloatArray, offset: FloatArray, delta_s: float, largest_gap_s: float
) -> FloatArray:
    if times.size and (np.diff(times) == 0.0).any():
        # Two boxes of one picture are two opinions on one pose.
        times, group = np.unique(times, return_inverse=True)
        count = np.bincount(group)
        offset = np.column_stack([np.bincount(group, offset[:, k]) / count for k in (0, 1)])
    if times.size < 2:
        return np.empty(0)
    later = times + delta_s
    start = int(np.searchsorted(later, times[-1] + _SAME_TIME_S, side="right"))
    later = np.minimum(later[:start], times[-1])
    after = np.clip(np.searchsorted(times, later, side="left"), 1, times.size - 1)
    span = times[after] - times[after - 1]
    weight = (later - times[after - 1]) / span
    on_pose = np.minimum(weight, 1.0 - weight) * span <= _SAME_TIME_S
    usable = (span <= largest_gap_s) | on_pose
    moved = offset[after - 1] + weight[:, None] * (offset[after] - offset[after - 1])
    difference = (moved - offset[:start])[usable]
    size: FloatArray = np.hypot(difference[:, 0], difference[:, 1])
    return size


def mahalanobis_squared(pairs: ScoredPairs) -> FloatArray:
    """The squared distance from the estimate to the truth in units of the stated covariance.

    Returns:
        (N,) float64, chi-square distributed with two degrees of freedom if the covariances are
        true and the errors normal. NaN where no covariance is stated. A covariance without an
        inverse claims certainty: infinite unless the error is nought.
    """
    east = pairs.true_east_m - pairs.east_m
    north = pairs.true_north_m - pairs.north_m
    c = pairs.covariance_m2
    var_east, var_north, cross = c[:, 0, 0], c[:, 1, 1], (c[:, 0, 1] + c[:, 1, 0]) / 2.0
    determinant = var_east * var_north - cross**2
    proper = (determinant > 0.0) & (var_east > 0.0)
    form = var_north * east**2 - 2.0 * cross * east * north + var_east * north**2
    distance = form / np.where(proper, determinant, 1.0)
    certain = np.where((east == 0.0) & (north == 0.0), 0.0, np.inf)
    stated = np.isfinite(c).all(axis=(1, 2))
    return np.where(stated, np.where(proper, distance, certain), np.nan)


def covered(pairs: ScoredPairs, probability: ArrayLike) -> FloatArray:
    """The share of true positions inside the ellipses of one or more stated probabilities.

    Args:
        pairs: The pairs; those without a stated covariance do not count.
        probability: (K,) each in [0, 1).

    Returns:
        (K,) float64 in [0, 1]; NaN where no covariance is stated.
    """
    # Chi-square with two degrees of freedom has the distribution function 1 - exp(-d/2).
    limit = -2.0 * np.log1p(-np.atleast_1d(np.asarray(probability, dtype=np.float64)))
    distance = mahalanobis_squared(pairs)
    stated = np.sort(distance[~np.isnan(distance)])
    if stated.size == 0:
        return np.full(limit.shape, np.nan)
    return np.searchsorted(stated, limit, side="right") / stated.size


def coverage(pairs: ScoredPairs) -> Coverage:
    """How often the truth lies inside the stated 50 % and 95 % ellipses."""
    assert pairs.reference_sigma_m is not None, "filled in where it is absent"
    p50, p95 = covered(pairs, (0.5, 0.95))
    p50_with_log, p95_with_log = covered(pairs.with_log_error(), (0.5, 0.95))
    stated = np.isfinite(pairs.covariance_m2).all(axis=(1, 2))
    return Coverage(
        p50=float(p50),
        p95=float(p95),
        n=int(stated.sum()),
        reference_sigma_m=float(np.sqrt(_mean(pairs.reference_sigma_m[stated] ** 2)))
        if stated.any()
        else 0.0,
        p50_with_log=float(p50_with_log),
        p95_with_log=float(p95_with_log),
    )


def line_of_sight_errors(pairs: ScoredPairs) -> tuple[FloatArray, FloatArray]:
    """The error along the line of sight to the true position (outward) and across it (clockwise).

    Returns:
        Two (N,) float64 arrays, metres; NaN where the true position is the camera's.
    """
    east, north = pairs.east_m - pairs.true_east_m, pairs.north_m - pairs.true_north_m
    distance = pairs.true_range_m
    away = distance > _AT_CAMERA_M
    scale = np.where(away, distance, 1.0)
    toward_east, toward_north = pairs.true_sight_m.T / scale
    along = east * toward_east + north * toward_north
    across = east * toward_north - north * toward_east
    return np.where(away, along, np.nan), np.where(away, across, np.nan)


def line_of_sight(pairs: ScoredPairs) -> LineOfSight:
    """Mean and root mean square of the error along and across the line of sight."""
    along, across = line_of_sight_errors(pairs)
    known = np.isfinite(along)
    along, across = along[known], across[known]
    return LineOfSight(
        bias_along=_mean(along),
        bias_across=_mean(across),
        rmse_along=float(np.sqrt(_mean(along**2))),
        rmse_across=float(np.sqrt(_mean(across**2))),
    )


def by_range(pairs: ScoredPairs, edges_m: Sequence[float] = RANGE_EDGES_M) -> tuple[RangeBin, ...]:
    """The absolute error in bins of the true distance from the camera; empty bins are left out.

    Args:
        pairs: The pairs.
        edges_m: Edges of the bins, increasing metres.
    """
    error, place = pairs.error_m, np.digitize(pairs.true_range_m, edges_m)
    bins = []
    for k, (low, high) in enumerate(pairwise(edges_m), start=1):
        inside: BoolArray = place == k
        if inside.any():
            chosen = error[inside]
            bins.append(
                RangeBin(
                    from_m=float(low),
                    to_m=float(high),
                    n=chosen.size,
                    rmse=float(np.sqrt(np.mean(chosen**2))),
                    median=float(np.median(chosen)),
                )
            )
    return tuple(bins)


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")
