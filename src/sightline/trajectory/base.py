"""Base of all trajectory methods: the protocol, input validation and kinds of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.types import BoolArray, EastNorthPositions, FloatArray, IntArray, PointKind, Track

SAME_TIME_S = 1e-6
"""Times closer than this are one time: stored POSIX seconds are good to a quarter of it."""


class TrajectoryMethod(Protocol):
    """Estimates a smooth track from the positions of one target."""

    def apply(
        self,
        time_utc_s: FloatArray,
        positions: EastNorthPositions,
        *,
        confidence: FloatArray | None = None,
        at_utc_s: FloatArray | None = None,
        track_id: int = 0,
        label: str = "",
    ) -> Track:
        """Estimate the track of one target.

        Args:
            time_utc_s: (N,) float64, POSIX seconds of the positions, in any order; rows without
                a time are left out.
            positions: N rows; rows without a position (NaN) are left out, as if the target had
                not been seen.
            confidence: (N,) float64 in [0, 1], of the boxes; absent: 1.
            at_utc_s: (M,) float64, the times to answer for; absent: the distinct times at which
                there is a position. They come back in rising order, each once.
            track_id: Number of the track, passed on.
            label: Class of the target, passed on.

        Raises:
            InputError: Columns of different lengths, no position at all, or a time asked for
                that is no number.
        """
        ...


@dataclass(frozen=True, eq=False)
class Measurements:
    """Usable positions of one target, in the order of time.

    Attributes:
        time_utc_s: (N,) float64, finite, never decreasing.
        en_m: (N, 2) float64, metres east and north, finite.
        covariance_m2: (N, 2, 2) float64, symmetric and positive definite: of what differs from
            one position to the next.
        shared_m2: (N, 2, 2) float64, of what the positions of a target have in common. Averaging
            does not lessen it.
        confidence: (N,) float64.
        rows: (N,) int64, where they stood in what was given.
    """

    time_utc_s: FloatArray
    en_m: FloatArray
    covariance_m2: FloatArray
    shared_m2: FloatArray
    confidence: FloatArray
    rows: IntArray

    def shared_at(self, time_utc_s: FloatArray) -> FloatArray:
        """(M, 2, 2) shared covariance of a track, interpolated between its positions."""
        out = np.zeros((2, 2, time_utc_s.size))
        if self.shared_m2.any():
            for i, j in ((0, 0), (0, 1), (1, 1)):
                out[i, j] = np.interp(time_utc_s, self.time_utc_s, self.shared_m2[:, i, j])
            out[1, 0] = out[0, 1]
        return out.transpose(2, 0, 1)


SMALLEST_SIGMA_M = 1e-4
"""A position is never taken for more precise than this, so that covariances stay invertible."""

_LEAST_OWN_SHARE = 0.05
"""At least this share of a stated variance is a position's own."""


def measurements(
    time_utc_s: FloatArray,
    positions: EastNorthPositions,
    confidence: FloatArray | None,
    at_utc_s: FloatArray | None,
    track_id: int,
) -> tuple[Measurements, FloatArray]:
    """Validate positions; return usable rows in the order of time, and the output times.

    Args:
        time_utc_s: (N,) POSIX seconds.
        positions: N rows.
        confidence: (N,), or None for 1.
        at_utc_s: (M,) POSIX seconds, or None for the distinct times of the usable rows.
        track_id: For messages.

    Raises:
        InputError: See `TrajectoryMethod.apply`.
    """
    times = np.asarray(time_utc_s, dtype=np.float64)
    n = len(positions)
    weights = np.ones(n) if confidence is None else np.asarray(confidence, dtype=np.float64)
    for name, column in (("times", times), ("confidences", weights)):
        if column.shape != (n,):
            raise InputError(
                f"track {track_id}: {column.size} {name} for {n} positions; expected one each"
            )
    usable = positions.known & np.isfinite(times) & np.isfinite(weights)
    usable &= np.isfinite(positions.covariance_m2).all(axis=(1, 2))
    if not usable.any():
        raise InputError(
            f"track {track_id}: none of its {n} boxes has a position, a covariance and a time; "
            "a track needs at least one"
        )
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(times[rows], kind="stable")]
    total = _positive_definite(positions.covariance_m2[rows])
    assert positions.shared_covariance_m2 is not None, "positions fill it in"
    shared = positions.shared_covariance_m2[rows]
    measured = Measurements(
        time_utc_s=times[rows],
        en_m=np.stack([positions.east_m[rows], positions.north_m[rows]], axis=1),
        covariance_m2=_positive_definite(_own(total, shared)) if shared.any() else total,
        shared_m2=shared,
        confidence=weights[rows],
        rows=rows,
    )
    if at_utc_s is None:
        return measured, distinct(measured.time_utc_s)
    asked = np.atleast_1d(np.asarray(at_utc_s, dtype=np.float64))
    if not np.isfinite(asked).all():
        raise InputError(f"track {track_id}: a time that is asked for is no number")
    return measured, distinct(np.sort(asked))


def _own(total_m2: FloatArray, shared_m2: FloatArray) -> FloatArray:
    """Covariances without their shared part, at least a share of them."""
    own = total_m2 - shared_m2
    # The shared part may have no eigenvalue, in units of the whole, above what it may take: by
    # the determinant of what that would leave, and by its trace.
    rest = (1.0 - _LEAST_OWN_SHARE) * total_m2 - shared_m2
    a, b, c = rest[:, 0, 0], rest[:, 0, 1], rest[:, 1, 1]
    clipped = np.flatnonzero((a * c < b * b) | (a + c < 0.0))
    if clipped.size:
        lower = np.linalg.cholesky(total_m2[clipped])
        half = np.linalg.solve(lower, shared_m2[clipped])
        relative = np.linalg.solve(lower, np.swapaxes(half, 1, 2))
        values, vectors = np.linalg.eigh(0.5 * (relative + np.swapaxes(relative, 1, 2)))
        axes = lower @ vectors
        kept = np.maximum(1.0 - values, _LEAST_OWN_SHARE)
        own[clipped] = (axes * kept[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return np.asarray(own)


def _positive_definite(covariance_m2: FloatArray) -> FloatArray:
    symmetric = 0.5 * (covariance_m2 + np.swapaxes(covariance_m2, 1, 2))
    a, b, c = symmetric[:, 0, 0], symmetric[:, 0, 1], symmetric[:, 1, 1]
    smallest = 0.5 * (a + c) - np.hypot(0.5 * (a - c), b)
    flat = smallest < SMALLEST_SIGMA_M**2
    if flat.any():
        values, vectors = np.linalg.eigh(symmetric[flat])
        values = np.maximum(values, SMALLEST_SIGMA_M**2)
        symmetric[flat] = (vectors * values[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return symmetric


def distinct(sorted_utc_s: FloatArray) -> FloatArray:
    """Distinct values of a sorted array, those within `SAME_TIME_S` of the one before left out."""
    if not sorted_utc_s.size:
        return sorted_utc_s
    kept: FloatArray = sorted_utc_s[np.diff(sorted_utc_s, prepend=-np.inf) > SAME_TIME_S]
    return kept


def point_kinds(
    at_utc_s: FloatArray, used_utc_s: FloatArray, longest_gap_s: float
) -> NDArray[np.int8]:
    """Kinds of a track's points: measured, interpolated or extrapolated.

    Args:
        at_utc_s: (M,) times of the points, rising.
        used_utc_s: (N,) times of the measurements that were used, rising, at least one.
        longest_gap_s: Between measurements further apart than this a point is extrapolated.

    Returns:
        (M,) `PointKind` values.
    """
    after = np.searchsorted(used_utc_s, at_utc_s)
    last = used_utc_s.size - 1
    before_s = at_utc_s - used_utc_s[np.clip(after - 1, 0, last)]
    after_s = used_utc_s[np.clip(after, 0, last)] - at_utc_s
    measured = (np.abs(before_s) <= SAME_TIME_S) | (np.abs(after_s) <= SAME_TIME_S)
    inside: BoolArray = (after > 0) & (after <= last) & (before_s + after_s <= longest_gap_s)
    return np.select(
        [measured, inside],
        [PointKind.MEASURED, PointKind.INTERPOLATED],
        PointKind.EXTRAPOLATED,
    ).astype(np.int8)
