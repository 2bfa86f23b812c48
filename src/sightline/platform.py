"""A camera that stands on something that moves: where it was, where it pointed, how it lay.

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
and its velocity are belongs to whatever is seen from it.
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
_APART_S = 0.9
_LEARNED_FROM = 3600
_COURSE_SPAN_S = 8.0
_LEAST_COURSE_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a platform was at N times, and where its bow pointed.

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
        """(N,) whether place and heading are known."""
        return np.isfinite(self.en_m[:, 0]) & np.isfinite(self.heading_rad)


@dataclass(frozen=True, eq=False)
class Platform:
    """What a platform logged of itself.

    Attributes:
        fixes: Where it was.
        headings: Where its bow pointed; None where only its course tells, and that only while it is
            under way.
    """

    fixes: Fixes
    headings: Headings | None = None

    def pose(self, time_utc_s: ArrayLike, plane: LocalPlane, *, until_then: bool = False) -> Pose:
        """Where the platform was.

        Args:
            time_utc_s: (N,) POSIX seconds.
            plane: Of the places.
            until_then: Whether place and velocity, and a course that stands in for the heading, are
                by the fixes until each time alone. How hard the platform accelerates is told by
                its whole log all the same.
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
            heading, sigma = self._logged(times)
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

    def _logged(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        assert self.headings is not None, "the caller has looked"
        log_s = self.headings.time_utc_s
        turned = _unwrapped(self.headings)
        heading = np.interp(times, log_s, turned, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(log_s, times), 1, len(log_s) - 1)
        far = log_s[after] - log_s[after - 1] > LARGEST_GAP_S
        return (
            np.where(far, np.nan, heading),
            np.full(times.shape, np.radians(HEADING_SIGMA_DEG)),
        )

    def _course(self, times: FloatArray, plane: LocalPlane) -> tuple[FloatArray, FloatArray]:
        """The course made good over some seconds, which is the heading but for drift."""
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
    """The course of velocities (N, 2) that are so unsure (N,), NaN where it says too little."""
    speed = np.hypot(*velocity_mps.T)
    told = speed > _LEAST_COURSE_SIGMAS * sigma_mps
    sigma = np.divide(sigma_mps, speed, out=np.full(speed.shape, np.nan), where=told)
    return np.where(told, np.arctan2(*velocity_mps.T), np.nan), sigma


@dataclass(frozen=True, eq=False)
class _Way:
    """The way of a platform by its log: place and velocity at each fix, smoothed and until then.

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
        """(M,) whether there are fixes on both sides that are near enough to each other."""
        log_s = self.log_s
        if log_s.size == 0:
            return np.zeros(times.size, dtype=bool)
        after = np.clip(np.searchsorted(log_s, times), 0, log_s.size - 1)
        before = np.where(log_s[after] == times, after, np.maximum(after - 1, 0))
        inside = (times >= log_s[0]) & (times <= log_s[-1])
        return np.asarray(inside & (log_s[after] - log_s[before] <= LARGEST_GAP_S))

    def at(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Place and velocity (M, 2, 2) by all fixes, and covariances (M, 2, 2).

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
        """The same by the fixes until each time; before the first, by that."""
        last = np.maximum(np.searchsorted(self.time_s, times, side="right") - 1, 0)
        lag = np.maximum(times - self.time_s[last], 0.0)
        step = np.tile(np.eye(2), (times.size, 1, 1))
        step[:, 0, 1] = lag
        noise = np.stack([lag**3 / 3.0, lag**2 / 2.0, lag**2 / 2.0, lag], axis=1)
        spread = step @ self.filtered_covariance[last, :2, :2] @ np.swapaxes(step, 1, 2)
        spread += self.acceleration_m2ps3 * noise.reshape(-1, 2, 2)
        return step @ self.filtered[last, :2], spread


# The way is asked for with each track and each moment, and takes a while for a long log.
@lru_cache(maxsize=8)
def _unwrapped(headings: Headings) -> FloatArray:
    """(N,) radians, without steps of a whole turn."""
    return np.unwrap(np.radians(headings.heading_deg))


@lru_cache(maxsize=8)
def _way(platform: Platform, plane: LocalPlane) -> _Way:
    return _Way.of(platform.fixes, plane)


def _apart(time_s: FloatArray) -> IntArray:
    """Rows of times of which none follows the one before too closely."""
    kept: list[int] = []
    last_s = -np.inf
    for i, now_s in enumerate(time_s.tolist()):
        if now_s - last_s >= _APART_S:
            kept.append(i)
            last_s = now_s
    return np.array(kept, dtype=np.int64)


def _busiest(en_m: FloatArray) -> slice:
    """The stretch of so many fixes in which the platform went furthest."""
    gone = np.append(0.0, np.cumsum(np.hypot(*np.diff(en_m, axis=0).T)))
    starts = np.arange(0, max(1, len(en_m) - _LEARNED_FROM + 1), _LEARNED_FROM // 4)
    ends = np.minimum(starts + _LEARNED_FROM, len(en_m)) - 1
    start = int(starts[np.argmax(gone[ends] - gone[starts])])
    return slice(start, start + _LEARNED_FROM)


def _moves(lag_s: float, acceleration_m2ps3: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(3, 3) how place, velocity and error move on, and (K, 3, 3) the noise that they pick up."""
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
    """Filter a log under K accelerations.

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
    """Places of the earth's plane as the platform saw them.

    Args:
        en_m: (N, 2) metres east and north.
        pose: Of the N times.

    Returns:
        (N, 2) metres to starboard and ahead; NaN where the pose is not known.
    """
    return turned(en_m - pose.en_m, pose.heading_rad)


def turned(en_m: FloatArray, heading_rad: FloatArray) -> FloatArray:
    """East and north (N, 2) as to the right and ahead of a heading (N,)."""
    sine, cosine = np.sin(heading_rad), np.cos(heading_rad)
    east, north = en_m.T
    return np.stack([cosine * east - sine * north, sine * east + cosine * north], axis=1)


def north_up(positions: BodyPositions, pose: Pose) -> PlatformPositions:
    """Positions in the body frame, turned so that north is up.

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
    """Positions about the platform (`north_up`) in the earth's plane."""
    return Positions(
        east_m=positions.east_m + pose.en_m[:, 0],
        north_m=positions.north_m + pose.en_m[:, 1],
        covariance_m2=positions.covariance_m2,
        extrapolated=positions.extrapolated,
        plane=positions.plane,
        shared_covariance_m2=positions.shared_covariance_m2,
    )


def on_earth(positions: BodyPositions, pose: Pose) -> Positions:
    """Positions in the body frame, starboard and ahead, in the earth's plane."""
    return moved_positions(north_up(positions, pose), pose)


def moved_track(track: Track, pose: Pose) -> Track:
    """A track about the platform (`north_up`) in the earth's plane.

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
