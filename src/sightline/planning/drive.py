"""A boat's drive through the picture of a camera, by which that is to be learned."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sightline.camera.pinhole import Camera
from sightline.errors import InputError, unknown_name
from sightline.geodesy import LocalPlane
from sightline.georeferencing.correspondences import Correspondences
from sightline.planning.mounting import (
    Hull,
    around,
    horizontal_view,
    in_picture,
    seen_ahead_m,
)
from sightline.reference_trajectory import ReferenceTrajectory
from sightline.types import Boxes, Fixes, FloatArray

PATTERNS = ("out-and-back", "across", "zigzag")
"""Drives that need no log: along the line of sight, across it, and both in turn."""

SOURCE = "plan"
"""Of the boxes of a drive."""

# Of half the view, to either side: so that the boat stays in the picture.
_SIDE_SHARE = 0.8
# From the edge of the water that is seen, and from where the boat is too small.
_NEAR_MARGIN, _FAR_MARGIN = 1.25, 0.9
_LEGS = 6
# A drive near and far: over less than this there is no out and back.
_LEAST_SPAN = 1.2


@dataclass(frozen=True)
class DriveNoise:
    """How far boxes and the log of a drive are off.

    Attributes:
        box_px: Standard deviation of every edge of a box.
        log_m: Standard deviation of the log's position, east and north.
        log_time_s: Errors of the log decay as ``exp(-Δt / log_time_s)``.
    """

    box_px: float = 1.0
    log_m: float = 1.5
    log_time_s: float = 20.0


@dataclass(frozen=True, eq=False)
class Drive:
    """The way of a boat that keeps a log.

    Attributes:
        name: Of the pattern, or of the log.
        path: Where its log says that it was.
    """

    name: str
    path: ReferenceTrajectory

    @property
    def duration_s(self) -> float:
        """From its first fix to its last."""
        return float(self.path.time_utc_s[-1] - self.path.time_utc_s[0])

    def correspondences(
        self,
        camera: Camera,
        plane: LocalPlane,
        hull: Hull,
        *,
        interval_s: float,
        least_px: float,
        noise: DriveNoise | None = None,
        rng: np.random.Generator | None = None,
    ) -> Correspondences:
        """Boxes of the boat beside its logged places, as the fit takes them.

        Args:
            camera: That sees it.
            plane: Of the path.
            hull: Of the boat; the receiver is amidships.
            interval_s: Between two boxes.
            least_px: Boxes that are narrower are not found.
            noise: Of boxes and log; needs ``rng``. Absent: none.
            rng: Draws the noise.

        Raises:
            InputError: The boat is never wholly in the picture, and large enough.
        """
        begin, end = self.path.time_utc_s[[0, -1]]
        times = begin + np.arange(0.0, end - begin + 1e-6, interval_s)
        true = self.path.at(times)
        course = self.path.smooth_velocity(times)
        ahead = course / np.maximum(np.hypot(*course.T), 1e-9)[:, None]
        boxes = hull.boxes(camera, true.east_north_m, ahead)
        seen = in_picture(camera, boxes[:, :2]) & in_picture(camera, boxes[:, 2:])
        with np.errstate(invalid="ignore"):
            seen &= boxes[:, 2] - boxes[:, 0] >= least_px
        if not seen.any():
            raise InputError(
                f"drive {self.name}: the boat is never in the picture and {least_px:g} px wide; "
                "check place and heading of the camera, or drive elsewhere"
            )
        path = self.path
        if noise is not None and rng is not None:
            boxes[seen] += noise.box_px * rng.standard_normal((int(seen.sum()), 4))
            path = _with_error(path, noise, rng)
        logged = path.at(times)
        drawn = boxes[seen]
        return Correspondences(
            boxes=Boxes.of(_upright(drawn), time_utc_s=times[seen], source=SOURCE),
            recording=np.full(len(drawn), self.name or SOURCE),
            east_north_m=logged.east_north_m[seen],
            velocity_mps=np.nan_to_num(path.smooth_velocity(times)[seen]),
            asked=len(times),
            plane=plane,
            fix_sigma_m=logged.sigma_m[seen],
            fix_time_utc_s=logged.fix_time_utc_s[seen],
        ).certain()


def _upright(boxes: FloatArray) -> FloatArray:
    """Boxes that noise has not turned inside out."""
    middle, half = 0.5 * (boxes[:, :2] + boxes[:, 2:]), 0.5 * (boxes[:, 2:] - boxes[:, :2])
    half = np.maximum(half, 0.5)
    return np.concatenate([middle - half, middle + half], axis=1)


def _with_error(
    path: ReferenceTrajectory, noise: DriveNoise, rng: np.random.Generator
) -> ReferenceTrajectory:
    """The path as a receiver would have logged it: a Gauss-Markov error, east and north."""
    error = rng.standard_normal(path.east_north_m.shape)
    memory = np.exp(-np.diff(path.time_utc_s) / noise.log_time_s)
    for i, kept in enumerate(memory, 1):
        error[i] = kept * error[i - 1] + math.sqrt(1.0 - kept**2) * error[i]
    return replace(path, east_north_m=path.east_north_m + noise.log_m * error)


def logged_drive(fixes: Fixes, plane: LocalPlane, name: str) -> Drive:
    """The drive of a log.

    Args:
        fixes: The log.
        plane: Of the camera.
        name: What messages call it.

    Raises:
        InputError: There are fewer than two fixes.
    """
    path = ReferenceTrajectory.of(fixes, plane)
    if path.time_utc_s.size < 2:
        raise InputError(f"drive {name}: a log of fewer than two fixes is no drive")
    return Drive(name, path)


def pattern_drive(
    pattern: str, camera: Camera, hull: Hull, *, speed_mps: float, least_px: float
) -> Drive:
    """A drive in the picture of a camera, with a fix a second.

    It reaches from the nearest water in the picture to where the boat looks too small.

    Args:
        pattern: One of `PATTERNS`.
        camera: That sees it.
        hull: Of the boat.
        speed_mps: Of the boat.
        least_px: Width at which a boat is just found.

    Raises:
        InputError: The pattern is not known, or nowhere in the picture the boat is large enough.
    """
    if pattern not in PATTERNS:
        raise unknown_name("drive", pattern, PATTERNS)
    nearest, farthest = seen_ahead_m(camera)
    near = max(_NEAR_MARGIN * nearest, nearest + hull.length_m)
    narrowest_m = min(hull.beam_m, hull.length_m) if pattern == "out-and-back" else hull.length_m
    small = camera.focal_px * narrowest_m / least_px
    far = _FAR_MARGIN * min(farthest, small)
    if far < _LEAST_SPAN * near:
        raise InputError(
            f"drive {pattern}: a boat of {hull.length_m:g} by {hull.beam_m:g} m is {least_px:g} px "
            f"wide only nearer than {small:.0f} m, and the picture begins at {near:.0f} m; give "
            "--drive a log, another pitch, or a larger --boat"
        )
    left, right = horizontal_view(camera)
    # Behind the camera nothing is driven.
    sides = np.clip(_SIDE_SHARE * np.array([left, right]), -0.45 * np.pi, 0.45 * np.pi)
    middle = math.sqrt(near * far)
    if pattern == "out-and-back":
        off, ranges = np.zeros(3), np.array([near, far, near])
    elif pattern == "across":
        off, ranges = sides[[0, 1, 0]], np.full(3, middle)
    else:
        out = np.geomspace(near, far, _LEGS)
        ranges = np.concatenate([out, out[-2::-1]])
        off = sides[np.arange(ranges.size) % 2]
    corners = around(camera, off, ranges)
    lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    times = np.arange(0.0, lengths[-1] / speed_mps)
    gone = speed_mps * times
    place = np.stack([np.interp(gone, lengths, axis) for axis in corners.T], axis=1)
    if times.size < 2:
        raise InputError(f"drive {pattern}: is over in a second; drive more slowly (--speed)")
    return Drive(pattern, ReferenceTrajectory(pattern, times, place, np.full_like(place, np.nan)))
