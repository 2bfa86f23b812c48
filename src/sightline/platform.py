"""A camera that stands on something that moves: where it was, where it pointed, how it lay.

Three frames meet here:

* the **earth's** plane, east and north of a fixed origin;
* **north up**: east and north of the platform as it moves. Targets are smoothed there, because the
  camera looks from its origin;
* the **bow's**: to starboard and ahead of the platform. A camera bolted to the platform always
  sees the same of it, so this is the plane that a model learns: its east is starboard, its north
  ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sightline.geodesy import LocalPlane
from sightline.synchronisation import LARGEST_GAP_S, distinct, synchronise
from sightline.types import BoolArray, Fixes, FloatArray, Headings, Positions, Track

POSITION_SIGMA_M = 1.5
"""How far off the platform's own log is taken to be, of each of east and north."""
HEADING_SIGMA_DEG = 1.0
"""How far off a logged heading is taken to be; a constant part is the camera's and is learned."""

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
    """

    en_m: FloatArray
    velocity_mps: FloatArray
    heading_rad: FloatArray
    heading_sigma_rad: FloatArray

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

    def pose(self, time_utc_s: ArrayLike, plane: LocalPlane) -> Pose:
        """Where the platform was.

        Args:
            time_utc_s: (N,) POSIX seconds.
            plane: Of the places.
        """
        times = np.asarray(time_utc_s, dtype=np.float64)
        place = synchronise(self.fixes, times, plane)
        heading, sigma = (
            self._course(times, plane) if self.headings is None else self._logged(times)
        )
        return Pose(
            en_m=np.stack([place.east_m, place.north_m], axis=1),
            velocity_mps=np.stack([place.velocity_east_mps, place.velocity_north_mps], axis=1),
            heading_rad=heading,
            heading_sigma_rad=sigma,
        )

    def _logged(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        assert self.headings is not None, "the caller has looked"
        log_s = self.headings.time_utc_s
        turned = np.unwrap(np.radians(self.headings.heading_deg))
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


def north_up(positions: Positions, pose: Pose) -> Positions:
    """Positions in the bow's frame, turned so that north is up.

    What the heading is off swings a place about the platform; a target has that in common with
    itself a moment later, as it has what the platform's log is off.

    Args:
        positions: N rows, starboard and ahead.
        pose: Of their times.

    Returns:
        N rows, east and north of the platform; NaN where the heading is not known.
    """
    starboard_ahead = np.stack([positions.east_m, positions.north_m], axis=1)
    en_m = turned(starboard_ahead, -pose.heading_rad)
    sine, cosine = np.sin(pose.heading_rad), np.cos(pose.heading_rad)
    turn = np.stack([cosine, sine, -sine, cosine], axis=1).reshape(-1, 2, 2)
    # d (east, north) / d heading.
    swing = np.stack([en_m[:, 1], -en_m[:, 0]], axis=1)
    own = swing[:, :, None] * swing[:, None, :] * pose.heading_sigma_rad[:, None, None] ** 2
    own = own + POSITION_SIGMA_M**2 * np.eye(2)
    assert positions.shared_covariance_m2 is not None, "positions fill it in"

    def turned_covariance(covariance_m2: FloatArray) -> FloatArray:
        return np.asarray(turn @ covariance_m2 @ np.swapaxes(turn, 1, 2) + own)

    known = pose.known
    return replace(
        positions,
        east_m=np.where(known, en_m[:, 0], np.nan),
        north_m=np.where(known, en_m[:, 1], np.nan),
        covariance_m2=np.where(
            known[:, None, None], turned_covariance(positions.covariance_m2), np.nan
        ),
        shared_covariance_m2=turned_covariance(positions.shared_covariance_m2),
        extrapolated=positions.extrapolated | ~known,
    )


def moved_positions(positions: Positions, pose: Pose) -> Positions:
    """Positions about the platform (`north_up`) in the earth's plane."""
    return replace(
        positions,
        east_m=positions.east_m + pose.en_m[:, 0],
        north_m=positions.north_m + pose.en_m[:, 1],
    )


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
    )
