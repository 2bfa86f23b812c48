"""A moving platform that carries the camera: its positions, headings and their errors.

Three frames meet here:

* the **earth's** plane, east and north of a fixed origin. Targets are told apart and forecast
  there, because they go straight there;
* **north up**: east and north of the platform as it moves. Targets are smoothed there, because the
  camera looks from its origin;
* the **body** frame: to starboard and ahead of the platform. A camera bolted to the platform
  always sees the same of it, so this is the plane that a model learns.

Each has a type of its own (`Positions`, `PlatformPositions`, `BodyPositions`), and only the earth's
has a latitude.

A receiver's error lasts for tens of seconds, and what it changes by from one fix to the next is no
motion: two fixes a second apart tell a velocity to half a metre a second, which is thirty metres
after a minute. So the platform's way is estimated from its log (`_Way`), and how unsure its place
and its velocity are belongs to whatever is seen from it. Its headings are rid of the noise of its
compass (`_Turning`): a quarter of a degree is two metres at half a kilometre.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.synchronisation import LARGEST_GAP_S, distinct
from sightline.types import (
    BodyPositions,
    BoolArray,
    Fixes,
    FloatArray,
    Headings,
    IntArray,
    PlatformPositions,
    Positions,
    Track,
)

POSITION_SIGMA_M = 1.5
"""How far off the platform's own log is taken to be, of each of east and north."""
HEADING_SIGMA_DEG = 1.0
"""How far off a logged heading is taken to be; a constant part is the camera's and is learned."""

_RECEIVER_CORRELATION_TIME_S = 20.0
_FIX_SIGMA_M = 0.3
_SPEED_SIGMA_MPS = 30.0
# The spectral density of the platform's acceleration, m²/s³, is the likeliest of these.
_ACCELERATIONS_M2PS3 = np.geomspace(1e-5, 1.0, 11)
# The spectral density of its angular acceleration in the variance of a heading, 1/s³, as well.
_TURNS_PS3 = np.geomspace(1e-4, 1e6, 21)
# Variance of its rate of turn before anything tells it, in that of a heading, 1/s².
_RATE_PS2 = 1e9
_APART_S = 0.9
_HEADINGS_APART_S = 0.2
# Fewer do not tell what is noise, nor do those that come so seldom that a hull yaws between them.
_ENOUGH_HEADINGS = 16
_SELDOM_S = 0.5
_LEARNED_FROM = 3600
_COURSE_SPAN_S = 8.0
_LEAST_COURSE_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Pose:
    """Position and heading of a platform at N times.

    Attributes:
        en_m: (N, 2) float64, east and north of a plane's origin; NaN where the log does not tell.
        velocity_mps: (N, 2) float64, east and north.
        heading_rad: (N,) float64, clockwise from north; NaN where nothing tells it.
        heading_sigma_rad: (N,) float64.
        covariance: (N, 2, 2) float64, of place and velocity along either axis. Absent: of a place
            that is off by `POSITION_SIGMA_M`.
    """

    en_m: FloatArray
    velocity_mps: FloatArray
    heading_rad: FloatArray
    heading_sigma_rad: FloatArray
    covariance: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        if self.covariance.size == 0:
            stated = np.tile(np.diag([POSITION_SIGMA_M**2, 0.0]), (len(self.en_m), 1, 1))
            object.__setattr__(self, "covariance", stated)

    @property
    def known(self) -> BoolArray:
        """(N,) whether position and heading are known."""
        return np.isfinite(self.en_m[:, 0]) & np.isfinite(self.heading_rad)


@dataclass(frozen=True, eq=False)
class Platform:
    """Position log and headings of a platform.

    Attributes:
        fixes: Where it was.
        headings: Where its bow pointed; None where only its course tells, and that only while it is
            under way.
    """

    fixes: Fixes
    headings: Headings | None = None

    def pose(self, time_utc_s: ArrayLike, plane: LocalPlane, *, until_then: bool = False) -> Pose:
        """Pose of the platform at given times.

        Args:
            time_utc_s: (N,) POSIX seconds.
            plane: Of the places.
            until_then: Whether place, velocity and heading are by what is logged until each time
                alone. How hard the platform accelerates and turns is told by its whole log all the
                same.
        """
        times = np.asarray(time_utc_s, dtype=np.float64)
        way = _way(self, plane)
        told = way.told(times)
        state = np.full((times.size, 2, 2), np.nan)
        covariance = np.full((times.size, 2, 2), np.nan)
        if told.any():
            at = way.until if until_then else way.at
            state[told], covariance[told] = at(times[told])
        if self.headings is not None:
            heading, sigma = self._logged(times, until_then)
        elif until_then:
            heading, sigma = _course_of(state[:, 1], np.sqrt(covariance[:, 1, 1]))
        else:
            heading, sigma = self._course(times, plane)
        return Pose(
            en_m=state[:, 0],
            velocity_mps=state[:, 1],
            heading_rad=heading,
            heading_sigma_rad=sigma,
            covariance=covariance,
        )

    def _logged(self, times: FloatArray, until_then: bool) -> tuple[FloatArray, FloatArray]:
        assert self.headings is not None, "the caller has looked"
        log_s = self.headings.time_utc_s
        if len(log_s) < _ENOUGH_HEADINGS or np.median(np.diff(log_s)) > _SELDOM_S:
            heading = np.interp(times, log_s, np.unwrap(np.radians(self.headings.heading_deg)))
        else:
            turning = _turning(self.headings)
            heading = turning.until(times) if until_then else turning.at(times)
        after = np.clip(np.searchsorted(log_s, times), 1, len(log_s) - 1)
        told = (times >= log_s[0]) & (times <= log_s[-1])
        told &= log_s[after] - log_s[after - 1] <= LARGEST_GAP_S
        return (
            np.where(told, heading, np.nan),
            np.full(times.shape, np.radians(HEADING_SIGMA_DEG)),
        )

    def _course(self, times: FloatArray, plane: LocalPlane) -> tuple[FloatArray, FloatArray]:
        """Course over ground over some seconds, as the heading but for drift."""
        log = distinct(self.fixes)
        east, north = plane.to_plane(log.latitude_deg, log.longitude_deg)
        half = 0.5 * _COURSE_SPAN_S
        inside = (times >= log.time_utc_s[0]) & (times <= log.time_utc_s[-1])
        early = np.clip(times - half, log.time_utc_s[0], log.time_utc_s[-1])
        late = np.clip(times + half, log.time_utc_s[0], log.time_utc_s[-1])
        moved_east = np.interp(late, log.time_utc_s, east) - np.interp(early, log.time_utc_s, east)
        moved_north = np.interp(late, log.time_utc_s, north) - np.interp(
            early, log.time_utc_s, north
        )
        moved = np.hypot(moved_east, moved_north)
        told = inside & (moved > _LEAST_COURSE_SIGMAS * POSITION_SIGMA_M)
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = np.sqrt(2.0) * POSITION_SIGMA_M / moved
        course = np.arctan2(moved_east, moved_north)
        return np.where(told, course, np.nan), np.where(told, sigma, np.nan)


def _course_of(velocity_mps: FloatArray, sigma_mps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Courses of velocities (N, 2) with errors (N,); NaN where too slow to tell."""
    speed = np.hypot(*velocity_mps.T)
    told = speed > _LEAST_COURSE_SIGMAS * sigma_mps
    sigma = np.divide(sigma_mps, speed, out=np.full(speed.shape, np.nan), where=told)
    return np.where(told, np.arctan2(*velocity_mps.T), np.nan), sigma


@dataclass(frozen=True, eq=False)
class _Way:
    """Filtered and smoothed position and velocity of a platform, at each fix of its log.

    Along either axis it goes with constant velocity under white acceleration, and its receiver is
    off by a Gauss-Markov process: a Kalman filter of place, velocity and that error, and the
    smoother of Rauch, Tung and Striebel. Both axes share the covariance. How hard the platform
    accelerates is told by its log.

    Attributes:
        log_s: (L,) of all fixes.
        time_s: (N,) of the fixes, those that follow each other closely left out.
        filtered: (N, 3, 2) float64, rows place, velocity, error; columns east and north.
        filtered_covariance: (N, 3, 3).
        smoothed: As ``filtered``, by all fixes.
        smoothed_covariance: As ``filtered_covariance``.
        acceleration_m2ps3: Spectral density.
    """

    log_s: FloatArray
    time_s: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    smoothed: FloatArray
    smoothed_covariance: FloatArray
    acceleration_m2ps3: float

    @classmethod
    def of(cls, fixes: Fixes, plane: LocalPlane) -> _Way:
        log = distinct(fixes)
        kept = _apart(log.time_utc_s)
        time_s = log.time_utc_s[kept]
        en_m = np.stack(plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)[kept]
        several = _ACCELERATIONS_M2PS3
        # A long log is judged by its busiest part: much of it may be at the berth.
        part = _busiest(en_m)
        likely, *_ = _followed(time_s[part], en_m[part], several)
        best = several[[int(np.argmax(likely))]]
        _, mean, covariance = _followed(time_s, en_m, best)
        mean, covariance = mean[:, 0], covariance[:, 0]
        smooth, spread = mean.copy(), covariance.copy()
        for i in range(len(time_s) - 2, -1, -1):
            lag_s = float(time_s[i + 1] - time_s[i])
            if lag_s > LARGEST_GAP_S:
                continue
            step, noise = _moves(lag_s, best)
            ahead = step @ covariance[i] @ step.T + noise[0]
            gain = np.linalg.solve(ahead, step @ covariance[i]).T
            smooth[i] = mean[i] + gain @ (smooth[i + 1] - step @ mean[i])
            spread[i] = covariance[i] + gain @ (spread[i + 1] - ahead) @ gain.T
        return cls(log.time_utc_s, time_s, mean, covariance, smooth, spread, float(best[0]))

    def told(self, times: FloatArray) -> BoolArray:
        """(M,) whether there are fixes near enough in time on both sides."""
        log_s = self.log_s
        if log_s.size == 0:
            return np.zeros(times.size, dtype=bool)
        after = np.clip(np.searchsorted(log_s, times), 0, log_s.size - 1)
        before = np.where(log_s[after] == times, after, np.maximum(after - 1, 0))
        inside = (times >= log_s[0]) & (times <= log_s[-1])
        return np.asarray(inside & (log_s[after] - log_s[before] <= LARGEST_GAP_S))

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Smoothed position and velocity (M, 2, 2), and covariances (M, 2, 2).

        Between two fixes the expected way is the cubic through both with their velocities.
        """
        if self.time_s.size < 2:
            return self.until(times)
        after = np.clip(np.searchsorted(self.time_s, times), 1, self.time_s.size - 1)
        span = (self.time_s[after] - self.time_s[after - 1])[:, None]
        share = (times - self.time_s[after - 1])[:, None] / span
        (p, v), (q, w) = (
            (self.smoothed[rows, 0], self.smoothed[rows, 1]) for rows in (after - 1, after)
        )
        rest = 1.0 - share
        place = rest**2 * ((1.0 + 2.0 * share) * p + share * span * v)
        place += share**2 * ((1.0 + 2.0 * rest) * q - rest * span * w)
        speed = 6.0 * share * rest * (q - p) / span
        speed += rest * (1.0 - 3.0 * share) * v + share * (1.0 - 3.0 * rest) * w
        weight = share[:, :, None]
        first, last = (self.smoothed_covariance[rows, :2, :2] for rows in (after - 1, after))
        return np.stack([place, speed], axis=1), first + weight * (last - first)

    def until(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Filtered position and velocity at given times; before the first fix, by that."""
        last = np.maximum(np.searchsorted(self.time_s, times, side="right") - 1, 0)
        lag = np.maximum(times - self.time_s[last], 0.0)
        step = np.tile(np.eye(2), (times.size, 1, 1))
        step[:, 0, 1] = lag
        noise = np.stack([lag**3 / 3.0, lag**2 / 2.0, lag**2 / 2.0, lag], axis=1)
        spread = step @ self.filtered_covariance[last, :2, :2] @ np.swapaxes(step, 1, 2)
        spread += self.acceleration_m2ps3 * noise.reshape(-1, 2, 2)
        return step @ self.filtered[last, :2], spread


@dataclass(frozen=True, eq=False)
class _Turning:
    """Filtered and smoothed heading and rate of turn of a platform.

    It turns at a constant rate under white angular acceleration, and its compass is off by white
    noise: a Kalman filter of heading and rate, and the smoother of Rauch, Tung and Striebel. How
    much noise there is beside the turning is told by the log, so that what is exact stays as it is.
    What a compass is off by for longer is no noise, and stays in.

    Attributes:
        time_s: (N,) of the headings, those that follow each other closely as one, their mean.
        last_s: (N,) of the last of each.
        filtered: (N, 2) float64, radians and radians a second, by the headings until then.
        smoothed: As ``filtered``, by all headings.
    """

    time_s: FloatArray
    last_s: FloatArray
    filtered: FloatArray
    smoothed: FloatArray

    @classmethod
    def of(cls, headings: Headings) -> _Turning:
        log_s = headings.time_utc_s
        _, first, group, count = np.unique(
            np.floor((log_s - log_s[0]) / _HEADINGS_APART_S),
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )
        angle = np.unwrap(np.radians(headings.heading_deg))
        time_s = log_s[0] + np.bincount(group, log_s - log_s[0]) / count
        angle = np.bincount(group, angle) / count
        noise = 1.0 / count
        # A long log is judged by the part in which the platform turned most.
        part = _busiest(np.stack([angle, np.zeros_like(angle)], axis=1))
        likely = _turned_like(time_s[part], angle[part], noise[part])
        jerk = float(_TURNS_PS3[int(np.argmax(likely))])
        filtered, smoothed = _smoothed_turns(time_s, angle, noise, jerk)
        return cls(time_s, log_s[first + count - 1], filtered, smoothed)

    def at(self, times: FloatArray) -> FloatArray:
        """(M,) smoothed headings, radians; the cubic through both neighbours with their rates."""
        if self.time_s.size < 2:
            return np.full(times.shape, self.smoothed[0, 0])
        after = np.clip(np.searchsorted(self.time_s, times), 1, self.time_s.size - 1)
        span = self.time_s[after] - self.time_s[after - 1]
        (p, v), (q, w) = self.smoothed[after - 1].T, self.smoothed[after].T
        # Beyond the first and the last mean it goes on as it went there.
        since = times - self.time_s[after - 1]
        share = np.clip(since / span, 0.0, 1.0)
        rest = 1.0 - share
        angle = rest**2 * ((1.0 + 2.0 * share) * p + share * span * v)
        angle += share**2 * ((1.0 + 2.0 * rest) * q - rest * span * w)
        return np.asarray(angle + np.minimum(since, 0.0) * v + np.maximum(since - span, 0.0) * w)

    def until(self, times: FloatArray) -> FloatArray:
        """(M,) filtered headings at given times; before the first heading, by that."""
        last = np.maximum(np.searchsorted(self.last_s, times, side="right") - 1, 0)
        angle, rate = self.filtered[last].T
        return np.asarray(angle + rate * np.maximum(times - self.time_s[last], 0.0))


def _turned_like(time_s: FloatArray, angle: FloatArray, noise: FloatArray) -> FloatArray:
    """(K,) log-likelihoods of headings under `_TURNS_PS3`, whatever the noise of the compass is."""
    k = _TURNS_PS3.size
    mean, rate = np.zeros(k), np.zeros(k)
    own, both, of_rate = np.zeros(k), np.zeros(k), np.zeros(k)
    squares, spreads, n = np.zeros(k), np.zeros(k), 0
    lags = np.diff(time_s, prepend=-np.inf).tolist()
    for lag, seen, off in zip(lags, angle.tolist(), noise.tolist(), strict=True):
        if lag > LARGEST_GAP_S:
            mean, rate = np.full(k, seen), np.zeros(k)
            own, both, of_rate = np.full(k, off), np.zeros(k), np.full(k, _RATE_PS2)
            continue
        mean = mean + lag * rate
        own = own + 2.0 * lag * both + lag**2 * of_rate + _TURNS_PS3 * lag**3 / 3.0
        both = both + lag * of_rate + _TURNS_PS3 * lag**2 / 2.0
        of_rate = of_rate + _TURNS_PS3 * lag
        spread, miss = own + off, seen - mean
        mean, rate = mean + own / spread * miss, rate + both / spread * miss
        of_rate = of_rate - both**2 / spread
        own, both = own * off / spread, both * off / spread
        squares += miss**2 / spread
        spreads += np.log(spread)
        n += 1
    return np.asarray(-0.5 * (n * np.log(np.maximum(squares, 1e-300)) + spreads))


def _smoothed_turns(
    time_s: FloatArray, angle: FloatArray, noise: FloatArray, jerk: float
) -> tuple[FloatArray, FloatArray]:
    """Filtered and smoothed headings and rates, (N, 2) each.

    Numbers rather than arrays: a day of headings has hundreds of thousands of steps.

    Args:
        time_s: (N,) POSIX seconds.
        angle: (N,) radians, unwrapped.
        noise: (N,) variances, in those of one heading.
        jerk: Spectral density of the angular acceleration, in the variance of one heading.
    """
    steps = []
    mean = rate = own = both = of_rate = 0.0
    lags = np.diff(time_s, prepend=-np.inf).tolist()
    for lag, seen, off in zip(lags, angle.tolist(), noise.tolist(), strict=True):
        if lag > LARGEST_GAP_S:
            mean, rate, own, both, of_rate = seen, 0.0, off, 0.0, _RATE_PS2
        else:
            mean += lag * rate
            own += 2.0 * lag * both + lag**2 * of_rate + jerk * lag**3 / 3.0
            both += lag * of_rate + jerk * lag**2 / 2.0
            of_rate += jerk * lag
            spread, miss = own + off, seen - mean
            mean, rate = mean + own / spread * miss, rate + both / spread * miss
            of_rate -= both**2 / spread
            own, both = own * off / spread, both * off / spread
        steps.append((mean, rate, own, both, of_rate))
    smooth = [(mean, rate)]
    for (mean, rate, own, both, of_rate), lag in zip(steps[-2::-1], lags[:0:-1], strict=True):
        if lag > LARGEST_GAP_S:
            smooth.append((mean, rate))
            continue
        ahead = own + 2.0 * lag * both + lag**2 * of_rate + jerk * lag**3 / 3.0
        ahead_both = both + lag * of_rate + jerk * lag**2 / 2.0
        ahead_rate = of_rate + jerk * lag
        whole = ahead * ahead_rate - ahead_both**2
        off, off_rate = smooth[-1][0] - mean - lag * rate, smooth[-1][1] - rate
        one = (ahead_rate * off - ahead_both * off_rate) / whole
        two = (ahead * off_rate - ahead_both * off) / whole
        smooth.append(
            (
                mean + (own + lag * both) * one + both * two,
                rate + (both + lag * of_rate) * one + of_rate * two,
            )
        )
    return np.array(steps)[:, :2], np.array(smooth[::-1])


# The way and the turning are asked for with each track and each moment, and take a while.
@lru_cache(maxsize=8)
def _turning(headings: Headings) -> _Turning:
    return _Turning.of(headings)


@lru_cache(maxsize=8)
def _way(platform: Platform, plane: LocalPlane) -> _Way:
    return _Way.of(platform.fixes, plane)


def _apart(time_s: FloatArray) -> IntArray:
    """Indices of times, thinned to a least interval."""
    kept: list[int] = []
    last_s = -np.inf
    for i, now_s in enumerate(time_s.tolist()):
        if now_s - last_s >= _APART_S:
            kept.append(i)
            last_s = now_s
    return np.array(kept, dtype=np.int64)


def _busiest(en_m: FloatArray) -> slice:
    """The window of so many fixes in which the platform went furthest."""
    gone = np.append(0.0, np.cumsum(np.hypot(*np.diff(en_m, axis=0).T)))
    starts = np.arange(0, max(1, len(en_m) - _LEARNED_FROM + 1), _LEARNED_FROM // 4)
    ends = np.minimum(starts + _LEARNED_FROM, len(en_m)) - 1
    start = int(starts[np.argmax(gone[ends] - gone[starts])])
    return slice(start, start + _LEARNED_FROM)


def _moves(lag_s: float, acceleration_m2ps3: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3, 3) transition of position, velocity and error, and (K, 3, 3) process noise."""
    kept = np.exp(-lag_s / _RECEIVER_CORRELATION_TIME_S)
    step = np.diag([1.0, 1.0, kept])
    step[0, 1] = lag_s
    noise = np.zeros((acceleration_m2ps3.size, 3, 3))
    motion = np.array([[lag_s**3 / 3.0, lag_s**2 / 2.0], [lag_s**2 / 2.0, lag_s]])
    noise[:, :2, :2] = acceleration_m2ps3[:, None, None] * motion
    noise[:, 2, 2] = POSITION_SIGMA_M**2 * (1.0 - kept**2)
    return step, noise


def _followed(
    time_s: FloatArray, en_m: FloatArray, acceleration_m2ps3: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Kalman filter of a log under K accelerations.

    Returns:
        (K,) the log-likelihoods, (N, K, 3, 2) the states, and (N, K, 3, 3) their covariances.
    """
    n, k = len(time_s), acceleration_m2ps3.size
    likely = np.zeros(k)
    means, covariances = np.empty((n, k, 3, 2)), np.empty((n, k, 3, 3))
    seen = np.array([1.0, 0.0, 1.0])
    off, own = POSITION_SIGMA_M**2, _FIX_SIGMA_M**2
    begun = np.array([[off + own, 0.0, -off], [0.0, _SPEED_SIGMA_MPS**2, 0.0], [-off, 0.0, off]])
    for i in range(n):
        lag_s = float(time_s[i] - time_s[i - 1]) if i else np.inf
        if lag_s > LARGEST_GAP_S:
            means[i] = 0.0
            means[i, :, 0] = en_m[i]
            covariances[i] = begun
            continue
        step, noise = _moves(lag_s, acceleration_m2ps3)
        mean = step @ means[i - 1]
        covariance = step @ covariances[i - 1] @ step.T + noise
        cross = covariance @ seen
        spread = cross @ seen + own
        rest = en_m[i] - mean[:, 0] - mean[:, 2]
        gain = cross / spread[:, None]
        means[i] = mean + gain[:, :, None] * rest[:, None, :]
        covariances[i] = covariance - gain[:, :, None] * cross[:, None, :]
        likely -= 0.5 * (rest**2).sum(axis=1) / spread + np.log(spread)
    return likely, means, covariances


def to_bow(en_m: FloatArray, pose: Pose) -> FloatArray:
    """Transform places from the local plane to the platform's body frame.

    Args:
        en_m: (N, 2) metres east and north.
        pose: Of the N times.

    Returns:
        (N, 2) metres to starboard and ahead; NaN where the pose is not known.
    """
    return turned(en_m - pose.en_m, pose.heading_rad)


def turned(en_m: FloatArray, heading_rad: FloatArray) -> FloatArray:
    """Rotate vectors east and north (N, 2) to starboard and ahead of a heading (N,)."""
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    east, north = en_m.T
    return np.stack([cosine * east - sine * north, sine * east + cosine * north], axis=1)


def north_up(positions: BodyPositions, pose: Pose) -> PlatformPositions:
    """Rotate positions from the body frame to north up.

    What the heading is off swings a place about the platform; a target has that in common with
    itself a moment later, as it has what the platform's log is off.

    Args:
        positions: N rows, starboard and ahead.
        pose: Of their times.

    Returns:
        N rows, east and north of the platform; NaN where the heading is not known.

    Raises:
        InputError: There are other than N poses.
    """
    if len(pose.en_m) != len(positions):
        raise InputError(
            f"{len(pose.en_m)} poses for {len(positions)} boxes; give the platform's pose at the "
            "time of each box"
        )
    starboard_ahead = np.stack([positions.starboard_m, positions.ahead_m], axis=1)
    en_m = turned(starboard_ahead, -pose.heading_rad)
    sine, cosine = np.sin(pose.heading_rad), np.cos(pose.heading_rad)
    turn = np.stack([cosine, sine, -sine, cosine], axis=1).reshape(-1, 2, 2)
    # d (east, north) / d heading.
    swing = np.stack([en_m[:, 1], -en_m[:, 0]], axis=1)
    own = swing[:, :, None] * swing[:, None, :] * pose.heading_sigma_rad[:, None, None] ** 2
    own = own + pose.covariance[:, :1, :1] * np.eye(2)
    assert positions.shared_covariance_m2 is not None, "positions fill it in"

    def turned_covariance(covariance_m2: FloatArray) -> FloatArray:
        return np.asarray(turn @ covariance_m2 @ np.swapaxes(turn, 1, 2) + own)

    known = pose.known
    return PlatformPositions(
        east_m=np.where(known, en_m[:, 0], np.nan),
        north_m=np.where(known, en_m[:, 1], np.nan),
        covariance_m2=np.where(
            known[:, None, None], turned_covariance(positions.covariance_m2), np.nan
        ),
        extrapolated=positions.extrapolated | ~known,
        plane=positions.plane,
        shared_covariance_m2=turned_covariance(positions.shared_covariance_m2),
    )


def moved_positions(positions: PlatformPositions, pose: Pose) -> Positions:
    """Translate positions about the platform (`north_up`) to the local plane."""
    return Positions(
        east_m=positions.east_m + pose.en_m[:, 0],
        north_m=positions.north_m + pose.en_m[:, 1],
        covariance_m2=positions.covariance_m2,
        extrapolated=positions.extrapolated,
        plane=positions.plane,
        shared_covariance_m2=positions.shared_covariance_m2,
    )


def on_earth(positions: BodyPositions, pose: Pose) -> Positions:
    """Transform positions from the body frame to the local plane."""
    return moved_positions(north_up(positions, pose), pose)


def moved_track(track: Track, pose: Pose) -> Track:
    """Translate a track about the platform (`north_up`) to the local plane.

    Args:
        track: N points, their velocities those at which the target moves away from the platform.
        pose: Of the points' times. Points at which it is not known are left out.
    """
    rows = np.flatnonzero(np.isfinite(pose.en_m).all(axis=1))
    east, north = pose.en_m[rows].T
    velocity = np.nan_to_num(pose.velocity_mps[rows])
    kept = track[rows]
    return replace(
        kept,
        east_m=kept.east_m + east,
        north_m=kept.north_m + north,
        velocity_east_mps=kept.velocity_east_mps + velocity[:, 0],
        velocity_north_mps=kept.velocity_north_mps + velocity[:, 1],
        velocity_covariance_m2ps2=kept.velocity_covariance_m2ps2
        + pose.covariance[rows, 1:, 1:] * np.eye(2),
    )
