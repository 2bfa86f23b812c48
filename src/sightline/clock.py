"""Clocks from frame numbers to UTC: presentation times, stamps, or a clock read rarely.

Nothing here divides a frame number by a frame rate: cameras drop frames and change their rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import norm

from sightline.errors import InputError
from sightline.types import FloatArray, IntArray

_RESOLUTIONS_S = (60.0, 1.0, 0.1, 0.01, 0.001)
"""Units to which clocks cut a time off."""

_CELLS = 50
"""Into how many cells the unit of a clock's resolution is divided to infer what was cut off."""

_LAPSE = 0.001
"""How often a timer may lose its rhythm, so that what was cut off before tells nothing after."""


class Clock(Protocol):
    """Protocol of a clock that tells the time of a frame."""

    def time_utc_s(self, frame: ArrayLike) -> FloatArray:
        """POSIX seconds of frames.

        Args:
            frame: (N,) frame numbers.

        Raises:
            InputError: A frame lies outside those that the clock knows.
        """
        ...

    def sigma_s(self, frame: ArrayLike) -> FloatArray:
        """Standard deviations of those times, (N,) seconds; their errors are not independent."""
        ...


@dataclass(frozen=True, eq=False)
class FrameClock:
    """Piecewise linear clock through times known at some frames.

    Attributes:
        frame: (K,) int64, strictly increasing.
        knot_utc_s: (K,) float64, POSIX seconds, never decreasing.
        knot_sigma_s: (K,) float64, standard deviations of the knots' times.
        wander: How much the frame rate changes within a stretch between knots, relative to
            itself; what is not at a knot is as much less certain (a Brownian bridge).
    """

    frame: IntArray
    knot_utc_s: FloatArray
    knot_sigma_s: FloatArray
    wander: float = 0.0

    def time_utc_s(self, frame: ArrayLike) -> FloatArray:
        """POSIX seconds of frames, (N,); see `Clock`."""
        return np.interp(self._checked(frame), self.frame, self.knot_utc_s)

    def sigma_s(self, frame: ArrayLike) -> FloatArray:
        """Standard deviations of those times, (N,) seconds; see `Clock`."""
        asked = self._checked(frame)
        at_knots = np.interp(asked, self.frame, self.knot_sigma_s)
        if len(self.frame) < 2:
            return at_knots
        right = np.clip(np.searchsorted(self.frame, asked), 1, len(self.frame) - 1)
        span = self.frame[right] - self.frame[right - 1]
        share = (asked - self.frame[right - 1]) / span
        duration_s = self.knot_utc_s[right] - self.knot_utc_s[right - 1]
        bridge = self.wander * duration_s * np.sqrt(share * (1.0 - share))
        return np.hypot(at_knots, bridge)

    def _checked(self, frame: ArrayLike) -> IntArray:
        asked = np.asarray(frame, dtype=np.int64)
        outside = (asked < self.frame[0]) | (asked > self.frame[-1])
        if outside.any():
            raise InputError(
                f"frame {asked[outside][0]} has no time: the clock runs from frame "
                f"{self.frame[0]} to frame {self.frame[-1]}"
            )
        return asked


@dataclass(frozen=True, eq=False)
class OffsetClock:
    """A clock with a constant offset taken off.

    Attributes:
        clock: Of the camera.
        offset_s: How far it is ahead.
    """

    clock: Clock
    offset_s: float

    def time_utc_s(self, frame: ArrayLike) -> FloatArray:
        """POSIX seconds of frames, (N,); see `Clock`."""
        return self.clock.time_utc_s(frame) - self.offset_s

    def sigma_s(self, frame: ArrayLike) -> FloatArray:
        """Standard deviations of those times, (N,) seconds; see `Clock`."""
        return self.clock.sigma_s(frame)


def presentation_clock(start_utc_s: float, presentation_s: ArrayLike) -> FrameClock:
    """Clock of a video whose first frame was taken at a known time.

    Args:
        start_utc_s: POSIX seconds of the first frame.
        presentation_s: (N,) seconds after the first frame, in the order of showing.
    """
    times = start_utc_s + np.asarray(presentation_s, dtype=float)
    return FrameClock(np.arange(times.size), times, np.zeros(times.size))


def stamped_clock(frame: ArrayLike, stamp_utc_s: ArrayLike) -> FrameClock:
    """Clock of a video whose frames carry time stamps.

    Stamps that differ from frame to frame are taken as they are. Stamps that stay the same over
    several frames and then step come from a clock that was read seldom or that shows few digits;
    the times between the steps are recovered by `stepped_clock`.

    Args:
        frame: (N,) frame numbers, strictly increasing.
        stamp_utc_s: (N,) POSIX seconds.

    Raises:
        InputError: There is none, frames do not increase, stamps decrease or are not known, or
            they step too seldom to tell how fast the frames went.
    """
    frames = np.asarray(frame, dtype=np.int64)
    stamps = np.asarray(stamp_utc_s, dtype=float)
    if frames.size == 0 or frames.shape != stamps.shape:
        raise InputError(f"a clock needs one time a frame; got {stamps.size} for {frames.size}")
    _refuse(~np.isfinite(stamps), frames, "has no time")
    _refuse(np.diff(frames, prepend=frames[0] - 1) <= 0, frames, "does not follow the row before")
    _refuse(
        np.diff(stamps, prepend=stamps[0]) < 0.0,
        frames,
        "is earlier than the frame before it; the times of a clock must not decrease",
    )
    if np.unique(stamps).size * 1.5 < stamps.size:
        return stepped_clock(frames, stamps)
    return FrameClock(frames, stamps, np.full(stamps.shape, _resolution_s(stamps) / np.sqrt(12.0)))


def _refuse(bad: np.ndarray, frames: IntArray, why: str) -> None:
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(f"row {row + 1} (frame {frames[row]}) {why}")


def stepped_clock(frame: IntArray, stamp_utc_s: FloatArray) -> FrameClock:
    """Clock reconstructed from one that advances in steps.

    A stamp is the true time cut off to the clock's resolution (a second, say), and the first
    frame that carries it is the one at which the clock was read. Two kinds are told apart by
    the size of the steps:

    * Steps of one unit of resolution: the clock was read at every frame, and the step is where
      its last digit turned over, within one frame.
    * Longer steps: a timer read the clock. What the reading cut off is unknown but, the timer
      being regular, nearly the same at each; `_cut_off_s` infers it.

    Frames between two steps are spaced evenly, since the rate of a camera is steadier within a
    step than over many. The first and the last stretch, in which only one step is seen, take the
    rate of their neighbour, unless that would reach beyond the reading on their far side.

    Args:
        frame: (N,) frame numbers, strictly increasing.
        stamp_utc_s: (N,) POSIX seconds, never decreasing.

    Raises:
        InputError: There are fewer than two steps.
    """
    first = np.flatnonzero(np.diff(stamp_utc_s)) + 1
    if first.size < 2:
        raise InputError(
            f"the clock steps {first.size} times in {frame.size} frames, too seldom to tell their "
            "times; two steps are needed, or a video with a start time"
        )
    stamp_s, knot = stamp_utc_s[first], frame[first]
    resolution_s = _resolution_s(stamp_utc_s)
    interval_s = np.diff(stamp_s) / np.diff(knot)
    interval_s = np.append(interval_s, interval_s[-1])
    if np.mean(np.diff(stamp_s) < 1.5 * resolution_s) > 0.9:
        # The digit turned over between this frame and the one before it.
        cut_off_s, sigma_s = interval_s / 2.0, interval_s / np.sqrt(12.0)
    else:
        cut_off_s, sigma_s = _cut_off_s(stamp_s, resolution_s, float(np.median(interval_s)))
    time_s = np.maximum.accumulate(stamp_s + cut_off_s)

    step_s = np.diff(time_s)
    period_s = float(np.median(step_s))
    rate_s = step_s / np.diff(knot)
    wander = _wander(rate_s)
    before = min((knot[0] - frame[0]) * rate_s[0], period_s)
    after = min((frame[-1] - knot[-1]) * rate_s[-1], period_s)
    frames = np.concatenate([[frame[0]], knot, [frame[-1]]])
    times = np.concatenate([[time_s[0] - before], time_s, [time_s[-1] + after]])
    sigmas = np.concatenate(
        [
            [np.hypot(sigma_s[0], wander * before)],
            sigma_s,
            [np.hypot(sigma_s[-1], wander * after)],
        ]
    )
    distinct = np.append(np.diff(frames) > 0, True)
    return FrameClock(frames[distinct], times[distinct], sigmas[distinct], wander)


def _wander(rate: FloatArray) -> float:
    """Relative change of the clock rate from one step to the next, root mean square."""
    if rate.size < 2:
        return 0.1
    return float(np.sqrt(np.mean((np.diff(rate) / rate[:-1]) ** 2)))


def _resolution_s(stamp_utc_s: FloatArray) -> float:
    """Resolution of time stamps: the coarsest unit of which all are multiples, seconds."""
    for unit in _RESOLUTIONS_S:
        multiples = stamp_utc_s / unit
        # Stamps near 1.6e9 s are known to a quarter of a microsecond.
        if np.all(np.abs(multiples - np.round(multiples)) * unit < 1e-6):
            return unit
    return 1e-6


def _cut_off_s(
    stamp_s: FloatArray, resolution_s: float, late_s: float
) -> tuple[FloatArray, FloatArray]:
    """Truncation error of regular readings of a clock, seconds.

    The readings follow a timer of unknown period, so what is cut off changes from one to the next
    by the period less the difference of the stamps, and by a little wander, since a reading waits
    for its frame. A hidden Markov model on a grid of cells over the unit of resolution carries
    its distribution forward and backward over all readings, for each of many periods, which are
    then weighed by how well they explain the stamps. Where a stamp steps by another count than
    its neighbours, what was cut off must have crossed the edge of the unit, which pins it down;
    where none does, it stays uniform.

    Args:
        stamp_s: (K,) stamps at the readings, POSIX seconds.
        resolution_s: The unit that they were cut off to.
        late_s: How late a reading may be for its timer: the time between frames.

    Returns:
        Mean and standard deviation of what was cut off, two (K,) arrays, seconds.
    """
    edge = np.linspace(0.0, 1.0, _CELLS + 1)
    cell = (edge[1:] + edge[:-1]) / 2.0
    shown = np.round(np.diff(stamp_s) / resolution_s)
    period = np.median(shown) + np.linspace(-0.98, 0.98, 2 * _CELLS - 1)
    period = period[period > 0.5]
    # The difference of two readings that are each up to one frame late.
    wander = max(late_s / resolution_s / np.sqrt(6.0), 0.5 / _CELLS)

    different, which = np.unique(shown, return_inverse=True)
    count = np.maximum(np.round(different[:, None] / period), 1.0)
    shift = count * period - different[:, None]
    mean = cell + shift[..., None]
    spread = wander * np.sqrt(count)[..., None, None]
    # (D, P, C, C): from a cell to a cell, for each difference of stamps and each period.
    kernel = np.diff(norm.cdf((edge - mean[..., None]) / spread), axis=-1) + _LAPSE / _CELLS

    n = stamp_s.size
    forward = np.full((n, period.size, _CELLS), 1.0 / _CELLS)
    log_likelihood = np.zeros(period.size)
    for k in range(1, n):
        ahead = np.matmul(forward[k - 1][:, None, :], kernel[which[k - 1]])[:, 0, :]
        total = ahead.sum(axis=1)
        log_likelihood += np.log(total)
        forward[k] = ahead / total[:, None]
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()

    cut_off, variance = np.empty(n), np.empty(n)
    backward = np.ones((period.size, _CELLS))
    for k in range(n - 1, -1, -1):
        posterior = forward[k] * backward
        posterior *= (weight / posterior.sum(axis=1))[:, None]
        mixed = posterior.sum(axis=0)
        cut_off[k] = mixed @ cell
        variance[k] = mixed @ (cell - cut_off[k]) ** 2 + 1.0 / (12.0 * _CELLS**2)
        if k > 0:
            behind = np.matmul(kernel[which[k - 1]], backward[..., None])[..., 0]
            backward = behind / behind.sum(axis=1)[:, None]
    return cut_off * resolution_s, np.sqrt(variance) * resolution_s
