"""The clock offset of a recording whose boxes a model has placed, by the log of their target.

One parameter, with the camera held: where the places lie along the path of the log. What places
have in common (the camera's own uncertainty, along and across the line of sight), the slow error of
the log and where the receiver stands on its hull are estimated with it, since they shift places as
a clock does.
"""

from __future__ import annotations

import numpy as np

from sightline.clock_offset import LARGEST_OFFSET_S, ZONES_S, ClockOffset, ClockPrior
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.synchronisation import LARGEST_GAP_S
from sightline.types import BoolArray, Fixes, FloatArray, IntArray, Positions

_STEP_S = 1.0
_DEGREES = 3.0
_UNMATCHED = 60.0
_LARGEST = 2e3
_GOOD = 8.0
# Places nearer in time than this tell little more than one, and logs are off alike for about this.
_INDEPENDENT_S = 2.0
_BLOCK_S = 30.0
_LEAST_SIGMA_M = 0.5
# Exposure, a receiver's own delay: times are seldom better than this.
_FINEST_S = 0.1
# The receiver stands so far from the middle of the hull, ahead or astern.
_MIDDLE_SIGMA_M = 1.0
_UNDER_WAY_MPS = 0.5
_FEWEST = 3
_ROUNDS = 6
_LOOKS = 9
_LEAST_LEAD = 3.0


def match_clock(
    time_utc_s: FloatArray,
    positions: Positions,
    fixes: Fixes,
    *,
    prior: ClockPrior | None = None,
    reference_sigma_m: float = 0.0,
    largest_offset_s: float = LARGEST_OFFSET_S,
) -> ClockOffset | None:
    """How far the camera's clock is ahead of the log's, by places of the logged target.

    Args:
        time_utc_s: (N,) POSIX seconds of the places, by the camera's clock.
        positions: The N places, about a camera that stands still.
        fixes: The log.
        prior: Of the offset. Absent: that of a clock of which nothing is known.
        reference_sigma_m: Standard deviation of the log's correlated error, metres.
        largest_offset_s: Largest offset, but for time zones.

    Returns:
        None where too few places meet the log at any offset.
    """
    match = _Match(time_utc_s, positions, fixes, prior or ClockPrior(), reference_sigma_m)
    if match.time_s.size < _FEWEST:
        return None
    start_s = match.best(largest_offset_s)
    return None if start_s is None else match.refined(start_s)


class _Match:
    """Places beside a log, at any clock offset."""

    def __init__(
        self,
        time_utc_s: FloatArray,
        positions: Positions,
        fixes: Fixes,
        prior: ClockPrior,
        reference_sigma_m: float,
    ) -> None:
        rows = np.flatnonzero(positions.known & np.isfinite(time_utc_s))
        self.time_s = time_utc_s[rows]
        self._positions = positions[rows]
        self._log = ReferenceTrajectory.of(fixes, positions.plane)
        self._prior = prior
        self._reference_m = reference_sigma_m
        span_s = float(np.ptp(self.time_s)) if self.time_s.size else 0.0
        self._weight = min(1.0, (span_s / _INDEPENDENT_S + 1.0) / max(self.time_s.size, 1))

    def _apart(self, offset_s: float) -> tuple[FloatArray, BoolArray]:
        """(N, 2) places less the log's, and (N,) whether the log has one."""
        log = self._log.at(self.time_s - offset_s)
        # What a motion model bridges a long gap with is no place that a clock may be read off.
        near = np.diff(log.fix_time_utc_s, axis=1) <= LARGEST_GAP_S
        place_m = np.where(near, log.east_north_m, np.nan)
        seen_m = np.stack([self._positions.east_m, self._positions.north_m], axis=1)
        apart = np.asarray(seen_m - place_m)
        return apart, np.asarray(np.isfinite(apart).all(axis=1))

    def _squares(self, offset_s: float) -> FloatArray:
        """(N,) squared standardised distances from the log; infinite where it has gaps."""
        apart, matched = self._apart(offset_s)
        floor = (_LEAST_SIGMA_M**2 + self._reference_m**2) * np.eye(2)
        covariance = self._positions.covariance_m2[matched] + floor
        solved = np.linalg.solve(covariance, apart[matched][:, :, None])[:, :, 0]
        square = np.full(apart.shape[0], np.inf)
        square[matched] = np.minimum(np.sum(apart[matched] * solved, axis=1), _LARGEST)
        return square

    def _score(self, offset_s: float) -> float:
        """Log density of the places at a clock offset, with how much is believed of that."""
        square = self._squares(offset_s)
        square = np.where(np.isinf(square), _UNMATCHED, square)
        loss = 0.5 * (_DEGREES + 2.0) * np.log1p(square / _DEGREES)
        return self._prior.log_density(offset_s) - self._weight * float(loss.sum())

    def best(self, largest_offset_s: float) -> float | None:
        """The likeliest offset of a grid; None where the log has a place for too few."""
        count = int(np.ceil(largest_offset_s / _STEP_S))
        around = self._prior.mean_s + _STEP_S * np.arange(-count, count + 1)
        if self._prior.stated:
            around = around[np.abs(around - self._prior.mean_s) <= 4.0 * self._prior.sigma_s]
        looks = around[np.linspace(0, around.size - 1, min(_LOOKS, around.size)).astype(int)]
        centres = [0.0, *(() if self._prior.stated else ZONES_S)]
        for centre_s in centres:
            if max(int(self._apart(float(centre_s + look))[1].sum()) for look in looks) >= _FEWEST:
                scores = [self._score(float(centre_s + offset)) for offset in around]
                best_s = float(centre_s + around[int(np.argmax(scores))])
                believed = self._score(self._prior.mean_s)
                # A clock is one at which most places lie on the log; some may at any.
                good = float(np.median(self._squares(best_s))) < _GOOD
                lead = max(scores) > believed + _LEAST_LEAD
                return best_s if good and lead else self._prior.mean_s
        return None

    def refined(self, start_s: float) -> ClockOffset | None:
        """The offset nearest to a start, with its standard deviation."""
        offset_s = start_s
        covariance = np.zeros((1, 1))
        for _ in range(_ROUNDS):
            apart, matched = self._apart(offset_s)
            rows = np.flatnonzero(matched)
            if rows.size < _FEWEST:
                return None
            step, covariance = self._step(offset_s, apart[rows], rows)
            offset_s += float(np.clip(step, -2.0, 2.0))
            if abs(step) < 0.01:
                break
        sigma_s = float(np.hypot(np.sqrt(covariance[0, 0]), _FINEST_S))
        return ClockOffset(offset_s, sigma_s, self._prior.stated)

    def _step(self, offset_s: float, apart: FloatArray, rows: IntArray) -> tuple[float, FloatArray]:
        """A Gauss-Newton step of the offset, and the covariance of all that is estimated."""
        times, positions = self.time_s[rows] - offset_s, self._positions[rows]
        velocity = self._log.smooth_velocity(times)
        shared = positions.shared_covariance_m2
        assert shared is not None, "positions fill it in"
        own = positions.covariance_m2 - shared + _LEAST_SIGMA_M**2 * np.eye(2)
        # A clock that is ahead has the log's target further on than where the boxes show it.
        speed = np.maximum(np.hypot(*velocity.T), _UNDER_WAY_MPS)
        bow = velocity / speed[:, None]
        columns, precision = [-velocity[:, :, None], bow[:, :, None]], [0.0, _MIDDLE_SIGMA_M**-2.0]
        block = ((times - times.min()) // _BLOCK_S).astype(np.int64)
        # What a camera does not know of itself shifts all places alike, or those of one part of the
        # picture: half and half.
        half = np.sqrt(0.5) * _common(positions, shared)
        parts = [np.ones(block.size, dtype=bool), *(block == n for n in np.unique(block))]
        for part in parts:
            columns.append(part[:, None, None] * half)
            precision += [1.0, 1.0]
        if self._reference_m > 0.0:
            for part in parts[1:]:
                columns.append(part[:, None, None] * np.eye(2))
                precision += [self._reference_m**-2.0] * 2
        jacobian = np.concatenate(columns, axis=2)
        whole = positions.covariance_m2 + (_LEAST_SIGMA_M**2 + self._reference_m**2) * np.eye(2)
        square = np.sum(apart * np.linalg.solve(whole, apart[:, :, None])[:, :, 0], axis=1)
        robust = (_DEGREES + 2.0) / (_DEGREES + square)
        weight = self._weight * np.minimum(robust, 1.0)
        solved = np.linalg.solve(own, np.concatenate([jacobian, apart[:, :, None]], axis=2))
        solved *= weight[:, None, None]
        normal = np.einsum("nij,nik->jk", jacobian, solved[:, :, :-1]) + np.diag(precision)
        right = np.einsum("nij,ni->j", jacobian, solved[:, :, -1])
        mean_s, sigma_s = self._prior.near(offset_s)
        normal[0, 0] += sigma_s**-2.0
        right[0] += (mean_s - offset_s) / sigma_s**2
        covariance = np.linalg.inv(normal)
        return float(covariance[0] @ right), covariance


def _common(positions: Positions, shared_m2: FloatArray) -> FloatArray:
    """(N, 2, 2) what one standard deviation along and across the line of sight does to places."""
    place = np.stack([positions.east_m, positions.north_m], axis=1)
    along = place / np.maximum(np.hypot(*place.T), 1e-6)[:, None]
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    out = np.empty((len(place), 2, 2))
    for index, direction in enumerate((along, across)):
        variance = np.einsum("ni,nij,nj->n", direction, shared_m2, direction)
        out[:, :, index] = np.sqrt(np.maximum(variance, 0.0))[:, None] * direction
    return out
