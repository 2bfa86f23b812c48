"""How boats go: from waypoint to waypoint, with a helm that turns only so fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from sightline.types import FloatArray

_STEP_S = 0.1
_KNOT_S = 0.5
_LEAVING_MPS2 = 0.3
_RUDDER_S = 1.0
"""From no turn to the sharpest: so that the turn rate has no jumps."""
_HELM_PER_S = 0.6
"""Turn rate that the helm asks for, per radian off course."""


@dataclass(frozen=True, eq=False)
class Path:
    """A smooth path: a cubic spline through places in time.

    Attributes:
        time_s: (K,) seconds since the start of the world, increasing, K >= 2.
        position_m: (K, 2) metres east and north.
        resting_course_deg: Where the bow points while the boat does not move.
    """

    time_s: FloatArray
    position_m: FloatArray
    resting_course_deg: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the boat leaves its place at all."""
        return bool(np.ptp(self.position_m, axis=0).max() > 0.0)

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.time_s, self.position_m)

    def at(self, time_s: ArrayLike) -> FloatArray:
        """(N, 2) metres east and north; before and after the path its ends hold."""
        times = np.clip(np.asarray(time_s, dtype=float), self.time_s[0], self.time_s[-1])
        return np.asarray(self._spline(times), dtype=float)

    def velocity(self, time_s: ArrayLike) -> FloatArray:
        """(N, 2) metres a second, east and north."""
        times = np.clip(np.asarray(time_s, dtype=float), self.time_s[0], self.time_s[-1])
        return np.asarray(self._spline(times, 1), dtype=float)

    def course_deg(self, time_s: ArrayLike) -> FloatArray:
        """(N,) degrees clockwise from north, in [0, 360)."""
        velocity = self.velocity(time_s)
        moving = np.hypot(velocity[..., 0], velocity[..., 1]) > 0.05
        course = np.degrees(np.arctan2(velocity[..., 0], velocity[..., 1]))
        return np.where(moving, course, self.resting_course_deg) % 360.0


def rest(place_m: ArrayLike, course_deg: float, end_s: float) -> Path:
    """A boat at anchor.

    Args:
        place_m: (2,) metres east and north.
        course_deg: Where the bow points.
        end_s: How long it stays.
    """
    place = np.asarray(place_m, dtype=float)
    return Path(np.array([0.0, max(end_s, 1.0)]), np.stack([place, place]), course_deg)


def cast_off(
    place_m: ArrayLike, course_deg: float, at_s: float, end_s: float, *, speed_mps: float = 2.5
) -> Path:
    """A boat that lies still, and leaves straight ahead.

    Args:
        place_m: (2,) metres east and north.
        course_deg: Where the bow points.
        at_s: When it leaves, seconds.
        end_s: Time of the last point.
        speed_mps: That it comes to, at 0.3 m/s².
    """
    times = np.arange(0.0, max(end_s, at_s + 1.0) + _KNOT_S, _KNOT_S)
    since = np.maximum(times - at_s, 0.0)
    until_s = speed_mps / _LEAVING_MPS2
    gone = 0.5 * _LEAVING_MPS2 * np.minimum(since, until_s) ** 2
    gone += speed_mps * np.maximum(since - until_s, 0.0)
    angle = np.radians(course_deg)
    place = np.asarray(place_m, dtype=float) + gone[:, None] * [np.sin(angle), np.cos(angle)]
    return Path(times, place, course_deg)


def steer(
    waypoints_m: ArrayLike,
    *,
    speed_mps: ArrayLike,
    turn_rate_dps: float,
    start_s: float,
    end_s: float,
    acceleration_mps2: float = 0.4,
) -> Path:
    """Go through waypoints in turn, and on to the first after the last, until time is up.

    The helm points to the next waypoint and turns at most ``turn_rate_dps``; a waypoint counts as
    reached within twice the turning radius. So paths are arcs and straights, as boats make them.

    Args:
        waypoints_m: (K, 2) metres east and north; the path starts at the first. K >= 2.
        speed_mps: Speed on the way to each waypoint, (K,) or one for all.
        turn_rate_dps: Largest turn, degrees a second.
        start_s: Time of the first point.
        end_s: Time of the last point.
        acceleration_mps2: How fast the speed changes from one leg to the next.
    """
    waypoints = [(float(e), float(n)) for e, n in np.asarray(waypoints_m, dtype=float)]
    speeds = np.broadcast_to(np.asarray(speed_mps, dtype=float), (len(waypoints),)).tolist()
    steps = int(np.ceil((end_s - start_s) / _STEP_S)) + 1
    turn_radius_per_speed = 1.0 / math.radians(turn_rate_dps)
    largest_turn = math.radians(turn_rate_dps) * _STEP_S
    largest_change = largest_turn * _STEP_S / _RUDDER_S
    (east, north), goal = waypoints[0], 1
    course = math.atan2(waypoints[1][0] - east, waypoints[1][1] - north)
    speed, turn = speeds[1], 0.0
    out = []
    # Plain floats: each step hangs on the one before, and arrays of one are slow.
    for _ in range(steps):
        out.append((east, north))
        to_east, to_north = waypoints[goal][0] - east, waypoints[goal][1] - north
        if math.hypot(to_east, to_north) < max(2.0 * speed * turn_radius_per_speed, 5.0):
            goal = (goal + 1) % len(waypoints)
        off = (math.atan2(to_east, to_north) - course + math.pi) % (2.0 * math.pi) - math.pi
        # Ease off before the course is reached, or the bow swings past it.
        wanted = _clip(_HELM_PER_S * _STEP_S * off, largest_turn)
        turn += _clip(wanted - turn, largest_change)
        course += turn
        speed += _clip(speeds[goal] - speed, acceleration_mps2 * _STEP_S)
        east += speed * math.sin(course) * _STEP_S
        north += speed * math.cos(course) * _STEP_S
    every = round(_KNOT_S / _STEP_S)
    times = start_s + _STEP_S * np.arange(steps)
    keep = np.unique(np.append(np.arange(0, steps, every), steps - 1))
    return Path(times[keep], np.array(out)[keep])


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)
