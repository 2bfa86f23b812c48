r"""Filtered states of many targets, whose boxes have errors that last.

A detector that is wrong in one frame is wrong in the next. A filter that takes these errors for
white believes itself far too sure within a second. Here, as in `sightline.trajectory.smoother`, two
numbers stand beside place and velocity of each target: the errors that last, along the line of
sight and across it, Ornstein-Uhlenbeck processes of unit variance (Bar-Shalom, Li and Kirubarajan,
*Estimation with Applications to Tracking and Navigation*, 2001, section 8.4: the augmented state).

The camera stands at the origin. A position is taken as bearing and inverse range, and its noise at
the range that is predicted.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sightline.trajectory.smoother import NoiseModel
from sightline.types import FloatArray, IntArray

USUAL_NOISE = NoiseModel(
    acceleration_m2ps3=0.3,
    correlation_time_s=0.8,
    white_along=0.5,
    white_across=0.5,
    correlated_along=0.85,
    correlated_across=0.85,
)
"""Of a target of which nothing has been learned."""

_STATE = 6
_NEAREST_M = 1.0
_SPEED_MPS = 5.0
_LEAST_M2PS3, _MOST_M2PS3 = 0.2, 1.0
_GATE = 12.0
"""Of the squared distance of a position from the one expected; beyond it is widened."""


class TargetFilter:
    """Kalman filter of any number of targets at one time; rows are targets.

    Attributes:
        ids: (T,) int64, numbers of the targets.
        time_utc_s: Of all states; NaN before the first.
    """

    def __init__(self) -> None:
        self.ids: IntArray = np.empty(0, dtype=np.int64)
        self.time_utc_s = np.nan
        self._mean: FloatArray = np.empty((0, _STATE))
        self._covariance: FloatArray = np.empty((0, _STATE, _STATE))
        self._shared: FloatArray = np.empty((0, 2, 2))
        # A row a target: density, time constant, shares that are white and correlated.
        self._noise: FloatArray = np.empty((0, 6))

    def __len__(self) -> int:
        return int(self.ids.size)

    def shift(self, step_s: float) -> None:
        """Set the clock by a step."""
        self.time_utc_s += step_s

    def keep(self, ids: IntArray) -> None:
        """Forget all other targets."""
        kept = np.isin(self.ids, ids)
        if not kept.all():
            self.ids, self._mean = self.ids[kept], self._mean[kept]
            self._covariance, self._shared = self._covariance[kept], self._shared[kept]
            self._noise = self._noise[kept]

    def learn(self, number: int, noise: NoiseModel) -> None:
        """Take the noise of a target that was learned from its track."""
        learned = list(vars(noise).values())
        # A track that went straight until now does not tell how it will turn.
        learned[0] = min(max(learned[0], _LEAST_M2PS3), _MOST_M2PS3)
        self._noise[self.ids == number] = learned

    def predict(self, time_utc_s: float) -> None:
        """Predict all targets to a time."""
        lag_s = time_utc_s - self.time_utc_s
        self.time_utc_s = time_utc_s
        if not len(self) or not lag_s > 0.0:
            return
        kept = np.exp(-lag_s / self._noise[:, 1])
        step = np.tile(np.eye(_STATE), (len(self), 1, 1))
        step[:, 0, 2] = step[:, 1, 3] = lag_s
        step[:, 4, 4] = step[:, 5, 5] = kept
        added = np.zeros_like(step)
        density = self._noise[:, 0]
        for place, speed in ((0, 2), (1, 3)):
            added[:, place, place] = density * lag_s**3 / 3.0
            added[:, place, speed] = added[:, speed, place] = density * lag_s**2 / 2.0
            added[:, speed, speed] = density * lag_s
        added[:, 4, 4] = added[:, 5, 5] = 1.0 - kept**2
        self._mean = np.einsum("tij,tj->ti", step, self._mean)
        self._covariance = step @ self._covariance @ step.transpose(0, 2, 1) + added

    def update(
        self,
        ids: Sequence[int] | IntArray,
        en_m: FloatArray,
        own_m2: FloatArray,
        shared_m2: FloatArray,
    ) -> None:
        """Take positions at the time predicted to; targets that are not known begin.

        Args:
            ids: (N,) numbers of the targets, each once.
            en_m: (N, 2) metres east and north.
            own_m2: (N, 2, 2) of what differs from one position of a target to the next.
            shared_m2: (N, 2, 2) of what they have in common.
        """
        numbers = np.asarray(ids, dtype=np.int64)
        new = ~np.isin(numbers, self.ids)
        if new.any():
            self._begin(numbers[new], en_m[new], own_m2[new])
        order = {int(number): row for row, number in enumerate(self.ids)}
        rows = np.array([order[int(number)] for number in numbers], dtype=np.int64)
        self._shared[rows] = shared_m2
        old = np.flatnonzero(~new)
        if old.size:
            self._correct(rows[old], en_m[old], own_m2[old])

    def _begin(self, ids: IntArray, en_m: FloatArray, own_m2: FloatArray) -> None:
        n = ids.size
        mean = np.zeros((n, _STATE))
        mean[:, :2] = en_m
        noise = np.tile(np.array(list(vars(USUAL_NOISE).values())), (n, 1))
        covariance = np.zeros((n, _STATE, _STATE))
        covariance[:, 2, 2] = covariance[:, 3, 3] = _SPEED_MPS**2
        covariance[:, 4, 4] = covariance[:, 5, 5] = 1.0
        _, axes = _polar(en_m)
        root = np.linalg.cholesky(axes @ own_m2 @ axes.transpose(0, 2, 1))
        lasting = axes.transpose(0, 2, 1) @ root * noise[:, None, 4:]
        white = axes.transpose(0, 2, 1) @ root * noise[:, None, 2:4]
        # The place is the position less its error: they hang together.
        covariance[:, :2, :2] = white @ white.transpose(0, 2, 1)
        covariance[:, :2, :2] += lasting @ lasting.transpose(0, 2, 1)
        covariance[:, :2, 4:] = -lasting
        covariance[:, 4:, :2] = -lasting.transpose(0, 2, 1)
        self.ids = np.concatenate([self.ids, ids])
        self._mean = np.concatenate([self._mean, mean])
        self._covariance = np.concatenate([self._covariance, covariance])
        self._shared = np.concatenate([self._shared, np.zeros((n, 2, 2))])
        self._noise = np.concatenate([self._noise, noise])

    def _correct(self, rows: IntArray, en_m: FloatArray, own_m2: FloatArray) -> None:
        mean, covariance, noise = self._mean[rows], self._covariance[rows], self._noise[rows]
        expected = mean[:, :2]
        range_m, axes = _polar(expected)
        measured_m, measured_axes = _polar(en_m)
        nearer = np.clip(range_m / measured_m, 0.2, 5.0)
        turned = np.einsum("ni,ni->n", measured_axes[:, 0], axes[:, 1])
        ahead = np.einsum("ni,ni->n", measured_axes[:, 0], axes[:, 0])
        off = np.stack([range_m * (1.0 - nearer), range_m * np.arctan2(turned, ahead)], axis=1)
        stated = measured_axes @ own_m2 @ measured_axes.transpose(0, 2, 1)
        # A pixel is worth the square of the range along the line of sight.
        scale = np.stack([nearer**2, nearer], axis=1)
        root = np.linalg.cholesky(stated * scale[:, :, None] * scale[:, None, :])
        design = np.zeros((rows.size, 2, _STATE))
        design[:, :, :2] = axes
        design[:, :, 4:] = root * noise[:, None, 4:]
        off = off - np.einsum("nij,nj->ni", design[:, :, 4:], mean[:, 4:])
        white = root * noise[:, None, 2:4]
        cross = covariance @ design.transpose(0, 2, 1)
        spread = design @ cross + white @ white.transpose(0, 2, 1)
        distance2 = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[:, :, None])[:, :, 0])
        # What lies far from where it was expected counts for less, and is not left out: it may be
        # the target that turned.
        spread = spread * np.maximum(1.0, distance2 / _GATE)[:, None, None]
        gain = cross @ np.linalg.inv(spread)
        left = covariance - gain @ cross.transpose(0, 2, 1)
        self._mean[rows] = mean + np.einsum("nij,nj->ni", gain, off)
        self._covariance[rows] = 0.5 * (left + left.transpose(0, 2, 1))

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Mean (T, 4) and covariance (T, 4, 4) of place and velocity, with what places share."""
        covariance = self._covariance[:, :4, :4].copy()
        covariance[:, :2, :2] += self._shared
        return self._mean[:, :4].copy(), covariance


def _polar(en_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ranges (N,), and axes (N, 2, 2) along the line of sight and to its left."""
    range_m = np.maximum(np.hypot(en_m[:, 0], en_m[:, 1]), _NEAREST_M)
    along = np.arctan2(en_m[:, 0], en_m[:, 1])
    sine, cosine = np.sin(along), np.cos(along)
    axes = np.stack([np.stack([sine, cosine], 1), np.stack([-cosine, sine], 1)], axis=1)
    return range_m, axes
