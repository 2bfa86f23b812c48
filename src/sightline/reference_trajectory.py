"""Reference trajectories of logged vessels, for many vessels and many times at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sightline.geodesy import LocalPlane
from sightline.logged_motion import LONGEST_GAP_S, LoggedMotion, spikes, usable
from sightline.synchronisation import LARGEST_GAP_S, distinct
from sightline.types import Fixes, FloatArray

SMOOTHED_S = 3.0
"""Half the time over which a velocity is taken that is to be free of the noise of single fixes."""

LARGEST_REPORT_GAP_S = 150.0
"""Reports that tell course and speed bridge a gap as long as this."""

# What a vessel under way may do between two reports that it does not tell.
_UNTOLD_MPS2 = 0.02


def without_leaps(fixes: Fixes, plane: LocalPlane) -> tuple[Fixes, Fixes]:
    """A log with distinct times without the fixes that leap off the path and back, and these.

    Args:
        fixes: The log.
        plane: Near it.
    """
    log = distinct(fixes)
    place = np.stack(plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
    leaps = spikes(log.time_utc_s, place)
    return (log[~leaps], log[leaps]) if leaps.any() else (log, log[leaps])


@dataclass(frozen=True, eq=False)
class ReferenceStates:
    """Positions and velocities of one vessel at given times.

    Attributes:
        east_north_m: (N, 2) float64, metres; NaN where the log does not tell.
        velocity_mps: (N, 2) float64, east and north; NaN likewise.
        sigma_m: (N,) float64, standard deviation of the interpolation, metres; 0 on a fix that does
            not tell its own.
        fix_time_utc_s: (N, 2) float64, times of the fixes on either side; NaN likewise.
    """

    east_north_m: FloatArray
    velocity_mps: FloatArray
    sigma_m: FloatArray
    fix_time_utc_s: FloatArray


@dataclass(frozen=True, eq=False)
class ReferenceTrajectory:
    """Trajectory of one logged vessel in the plane.

    Between two fixes that tell course and speed the path is the cubic that has those velocities at
    its ends (Hermite). Otherwise it is a straight line in a short gap, and in a long one what a
    motion model expects: see `sightline.logged_motion`.

    Attributes:
        name: Of the vessel.
        time_utc_s: (K,) float64, strictly increasing.
        east_north_m: (K, 2) float64, metres.
        velocity_mps: (K, 2) float64, as reported; NaN where a fix tells none.
        fix_sigma_m: (K,) float64, standard deviation of each fix along either axis, as of tracks
            of other cameras; None where nobody tells it.
    """

    name: str
    time_utc_s: FloatArray
    east_north_m: FloatArray
    velocity_mps: FloatArray
    fix_sigma_m: FloatArray | None = None

    @classmethod
    def of(
        cls,
        fixes: Fixes,
        plane: LocalPlane,
        velocity_mps: FloatArray | None = None,
        fix_sigma_m: FloatArray | None = None,
    ) -> ReferenceTrajectory:
        """The trajectory of a log.

        Args:
            fixes: The log.
            plane: Of the path.
            velocity_mps: (N, 2) over ground as the fixes reported it, NaN where they did not.
            fix_sigma_m: (N,) standard deviation of each fix, where velocities are told; None:
                nobody tells it.
        """
        if velocity_mps is None or not np.isfinite(velocity_mps).any():
            log, _ = without_leaps(fixes, plane)
            place = np.stack(plane.to_plane(log.latitude_deg, log.longitude_deg), axis=1)
            return cls(fixes.name, log.time_utc_s, place, np.full((len(log), 2), np.nan))
        place = np.stack(plane.to_plane(fixes.latitude_deg, fixes.longitude_deg), axis=1)
        times, first = np.unique(fixes.time_utc_s, return_index=True)
        sigma_m = None if fix_sigma_m is None else fix_sigma_m[first]
        velocity = np.asarray(velocity_mps, dtype=float)[first]
        return cls(fixes.name, times, place[first], velocity, sigma_m)

    def smooth_velocity(self, time_utc_s: ArrayLike) -> FloatArray:
        """(N, 2) velocity over some seconds, free of the noise of single fixes.

        From one fix to the next a receiver's noise is as large as what a slow target moves. Taken
        for movement it would seem to tell the clock. Where the log does not tell as far to both
        sides, the velocity is that of `at`.

        Args:
            time_utc_s: (N,) POSIX seconds.
        """
        times = np.asarray(time_utc_s, dtype=float)
        before, after = self.at(times - SMOOTHED_S), self.at(times + SMOOTHED_S)
        smooth = (after.east_north_m - before.east_north_m) / (2.0 * SMOOTHED_S)
        return np.where(np.isfinite(smooth), smooth, self.at(times).velocity_mps)

    def at(self, time_utc_s: ArrayLike) -> ReferenceStates:
        """Interpolate the trajectory at given times.

        Args:
            time_utc_s: (N,) POSIX seconds.
        """
        times = np.asarray(time_utc_s, dtype=float)
        n, k = times.size, len(self.time_utc_s)
        place, velocity = np.full((n, 2), np.nan), np.full((n, 2), np.nan)
        sigma = np.full(n, np.nan)
        if k < 2:
            return ReferenceStates(place, velocity, sigma, np.full((n, 2), np.nan))
        right = np.clip(np.searchsorted(self.time_utc_s, times, side="left"), 1, k - 1)
        left = right - 1
        span = self.time_utc_s[right] - self.time_utc_s[left]
        both = self.velocity_mps[left] + self.velocity_mps[right]
        told = np.isfinite(both[:, 0]) & np.isfinite(both[:, 1])
        inside = (times >= self.time_utc_s[0]) & (times <= self.time_utc_s[-1])
        around = np.stack([self.time_utc_s[left], self.time_utc_s[right]], axis=1)
        around[~inside] = np.nan
        long = np.flatnonzero(inside & ~told & (span > LARGEST_GAP_S) & (span <= LONGEST_GAP_S))
        if long.size:
            bridged = self.motion.at(times[long], left[long])
            known = usable(bridged)
            rows = long[known]
            place[rows], velocity[rows] = bridged.east_north_m[known], bridged.velocity_mps[known]
            sigma[rows] = bridged.sigma_m[known]
        rows = np.flatnonzero(
            inside & (span <= np.where(told, LARGEST_REPORT_GAP_S, LARGEST_GAP_S))
        )
        left, right, span = left[rows], right[rows], span[rows][:, None]
        start, end = self.east_north_m[left], self.east_north_m[right]
        chord = (end - start) / span
        known = told[rows][:, None]
        first = np.where(known, self.velocity_mps[left], chord) * span
        last = np.where(known, self.velocity_mps[right], chord) * span
        u = (times[rows][:, None] - self.time_utc_s[left][:, None]) / span
        # The cubic of Hermite, and its derivative.
        bend, twist = first - (end - start), (end - start) - last
        place[rows] = start + u * (end - start) + u * (1.0 - u) * ((1.0 - u) * bend + u * twist)
        slope = (1.0 - 2.0 * u) * ((1.0 - u) * bend + u * twist) + u * (1.0 - u) * (twist - bend)
        velocity[rows] = chord + slope / span
        sigma[rows] = (_UNTOLD_MPS2 * span**2 * u * (1.0 - u))[:, 0]
        if self.fix_sigma_m is not None:
            own = np.interp(times[rows], self.time_utc_s, self.fix_sigma_m)
            sigma[rows] = np.hypot(sigma[rows], own)
        return ReferenceStates(place, velocity, sigma, around)

    @cached_property
    def motion(self) -> LoggedMotion:
        """Its motion where the log has long gaps."""
        return LoggedMotion.of(self.time_utc_s, self.east_north_m)
