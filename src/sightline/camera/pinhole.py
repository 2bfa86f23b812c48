"""A pinhole camera above a plane: projection of places to pixels, and back.

The camera stands ``height_m`` above the water or the road, at ``(east_m, north_m)`` in the local
plane. ``heading_deg`` is the bearing of its optical axis, clockwise from north; ``pitch_deg`` is
how far the axis looks below the horizontal; ``roll_deg`` is positive where the right end of the
horizon lies lower in the image. Pixels are square, the principal point lies near the middle of the
image, and the lens has the radial distortion of Brown and Conrady, forward as in OpenCV:
``x_d = x (1 + k1 r² + k2 r⁴)`` with ``r² = x² + y²`` on the normalised image plane.

The earth falls away from the plane by ``d² c / 2 R`` at a distance d: by 0.3 m over 2 km, and by
15 m over 15. R is the mean radius of the earth; refraction bends sight lines along with the earth,
so that the curvature c which is left is a share of the earth's own, usually 6/7 of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sightline.camera.parameters import (
    CURVATURE,
    EAST,
    HEADING,
    K1,
    K2,
    LOG_FOCAL,
    LOG_HEIGHT,
    NORTH,
    PARAMETERS,
    PITCH,
    PRINCIPAL,
    PRINCIPAL_DX,
    PRINCIPAL_DY,
    ROLL,
    camera_vector,
)
from sightline.errors import InputError
from sightline.types import FloatArray

BY_BEYOND, BY_ROW, BY_ABOVE, BY_COLUMN = range(len(PARAMETERS), len(PARAMETERS) + 4)
"""Where `Located.derivatives` holds those that are not by a parameter of the camera."""

EARTH_RADIUS_M = 6_371_000.0
"""Mean radius of the earth, metres."""

Numbers = Any
"""(N,) float64, or one number."""

Beyond = Callable[[Numbers], Numbers] | float
"""How much further from the camera a place lies than where its ray meets the plane, metres; or a
function that tells it from the distance at which the ray does."""

_NEAREST = 1e-6
_NEWTON_STEPS = 8
_NEWTON_ENOUGH = 1e-14


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with radial distortion above a plane.

    Attributes:
        height_m: Above the plane, metres.
        pitch_deg: Of the optical axis below the horizontal, degrees.
        roll_deg: Positive where the right end of the horizon lies lower, degrees.
        heading_deg: Bearing of the optical axis, degrees clockwise from north.
        focal_px: Focal length, pixels.
        k1: First radial distortion term.
        k2: Second radial distortion term.
        east_m: Of the camera in the local plane, metres.
        north_m: Of the camera in the local plane, metres.
        image_size_px: Width and height of the image.
        principal_dx_px: Of the principal point, to the right of the middle of the image, pixels.
        principal_dy_px: Of the principal point, below the middle of the image, pixels.
        curvature: Of the water or the ground along sight lines, as a share of the earth's; 0 is
            a plane.

    Raises:
        InputError: Height, focal length or image size is not positive, or a value is not finite.
    """

    height_m: float
    pitch_deg: float
    roll_deg: float
    heading_deg: float
    focal_px: float
    k1: float
    k2: float
    east_m: float
    north_m: float
    image_size_px: tuple[int, int]
    principal_dx_px: float = 0.0
    principal_dy_px: float = 0.0
    curvature: float = 0.0

    def __post_init__(self) -> None:
        for column in fields(self):
            if column.name == "image_size_px":
                continue
            if not np.isfinite(getattr(self, column.name)):
                raise InputError(f"camera: {column.name} is not a number")
        if not (self.height_m > 0.0 and self.focal_px > 0.0 and min(self.image_size_px) > 0):
            raise InputError("camera: height, focal length and image size must be positive")

    @classmethod
    def from_vector(cls, vector: FloatArray, image_size_px: tuple[int, int]) -> Camera:
        """The camera of a parameter vector, (12,) float64 in the order of `PARAMETERS`."""
        return cls(
            height_m=float(np.exp(vector[LOG_HEIGHT])),
            pitch_deg=float(np.degrees(vector[PITCH])),
            roll_deg=float(np.degrees(vector[ROLL])),
            heading_deg=float(np.degrees(vector[HEADING]) % 360.0),
            focal_px=float(np.exp(vector[LOG_FOCAL])),
            k1=float(vector[K1]),
            k2=float(vector[K2]),
            east_m=float(vector[EAST]),
            north_m=float(vector[NORTH]),
            image_size_px=image_size_px,
            principal_dx_px=float(vector[PRINCIPAL_DX]),
            principal_dy_px=float(vector[PRINCIPAL_DY]),
            curvature=float(vector[CURVATURE]),
        )

    def to_vector(self) -> FloatArray:
        """The parameter vector, (12,) float64 in the order of `PARAMETERS`."""
        return camera_vector(
            {
                LOG_HEIGHT: np.log(self.height_m),
                PITCH: np.radians(self.pitch_deg),
                ROLL: np.radians(self.roll_deg),
                HEADING: np.radians(self.heading_deg),
                LOG_FOCAL: np.log(self.focal_px),
                K1: self.k1,
                K2: self.k2,
                EAST: self.east_m,
                NORTH: self.north_m,
                PRINCIPAL_DX: self.principal_dx_px,
                PRINCIPAL_DY: self.principal_dy_px,
                CURVATURE: self.curvature,
            }
        )

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) rotation matrix from east, north, up to the camera's right, down and forward."""
        return rotation_matrix(self.to_vector())

    @cached_property
    def largest_radius(self) -> float:
        """Largest normalised undistorted radius at which the distortion is still monotonic.

        Infinite where it never does. There ``d r_d / d r = 1 + 3 k1 r² + 5 k2 r⁴`` has its first
        positive root.
        """
        roots = np.roots([5.0 * self.k2, 3.0 * self.k1, 1.0])
        squares = [r.real for r in roots if abs(r.imag) < 1e-12 and r.real > 0.0]
        return float(np.sqrt(min(squares))) if squares else float("inf")

    def project(
        self, east_m: ArrayLike, north_m: ArrayLike, above_m: ArrayLike = 0.0
    ) -> FloatArray:
        """Project points of the world to pixels.

        Args:
            east_m: (N,) metres in the local plane.
            north_m: (N,) metres.
            above_m: (N,) metres above the plane, or one value for all.

        Returns:
            (N, 2) float64 pixels, x and y; NaN for points behind the camera or beyond the radius
            at which the lens model folds.
        """
        vector = self.to_vector()
        pixel, depth, square = _project(
            vector, self.image_size_px, np.atleast_1d(east_m), np.atleast_1d(north_m), above_m
        )
        seen = (depth > _NEAREST) & (square < self.largest_radius**2)
        return np.where(seen[:, None], pixel, np.nan)

    def locate(
        self, pixel_px: ArrayLike, above_m: ArrayLike = 0.0
    ) -> tuple[FloatArray, FloatArray]:
        """Intersect the rays of pixels with the plane that lies ``above_m`` over the ground.

        Args:
            pixel_px: (N, 2) x and y.
            above_m: (N,) or one value, metres; below the camera.

        Returns:
            East and north, two (N,) float64 arrays, metres; NaN at or above the horizon, and where
            the lens model has folded.
        """
        pixel = np.atleast_2d(np.asarray(pixel_px, dtype=float))
        x, y = self._undistorted(pixel[:, 0], pixel[:, 1])
        down = self._down(x, y)
        east, north = self._level(x, y)
        height = self.height_m - np.asarray(above_m)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # A ray meets a ground that falls away where it sinks by its height and by that.
            slope = np.sqrt(
                down * down - 2.0 * self._bend_per_m * height * (east * east + north * north)
            )
            reach = np.where(down > 0.0, 2.0 * height / (down + slope), np.nan)
        east, north = reach * east, reach * north
        return self.east_m + east, self.north_m + north

    def rays(self, pixel_px: ArrayLike) -> FloatArray:
        """Unit vectors of the rays through pixels: right, down and forward of the camera.

        Args:
            pixel_px: (N, 2) x and y.

        Returns:
            (N, 3) float64; NaN where the lens model has folded.
        """
        pixel = np.atleast_2d(np.asarray(pixel_px, dtype=float))
        x, y = self._undistorted(pixel[:, 0], pixel[:, 1])
        rays = np.stack([x, y, np.ones_like(x)], axis=1)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def pixels(self, rays: ArrayLike) -> FloatArray:
        """Pixels (N, 2) of rays, the inverse of `rays`; NaN behind the camera, beyond the fold."""
        x, y, z = np.atleast_2d(np.asarray(rays, dtype=float)).T
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = x / z, y / z
            square = x * x + y * y
        seen = (z > _NEAREST) & (square < self.largest_radius**2)
        stretch = self.focal_px * (1.0 + square * (self.k1 + square * self.k2))
        middle = np.asarray(self._principal_px)
        return np.where(seen[:, None], middle + stretch[:, None] * np.stack([x, y], axis=1), np.nan)

    def _undistorted(self, x_px: FloatArray, y_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Undistorted normalised coordinates of pixels, (N,); NaN beyond the fold."""
        middle_x, middle_y = self._principal_px
        x = (x_px - middle_x) / self.focal_px
        y = (y_px - middle_y) / self.focal_px
        distorted = np.sqrt(x * x + y * y)
        limit, top = self.largest_radius, self._largest_distorted
        radius = np.minimum(distorted, limit)
        for _ in range(_NEWTON_STEPS):
            square = radius * radius
            bent = self.k2 * square
            value = radius * (1.0 + square * (self.k1 + bent)) - distorted
            slope = 1.0 + square * (3.0 * self.k1 + 5.0 * bent)
            step = value / np.maximum(slope, 0.05)
            radius = np.minimum(np.maximum(radius - step, 0.0), limit)
            if np.abs(step).max(initial=0.0) < _NEWTON_ENOUGH:
                break
        else:
            slow = (np.abs(step) >= _NEWTON_ENOUGH) & (distorted < top)
            radius[slow] = [self._bisected(one) for one in distorted[slow].tolist()]
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(distorted > 0.0, radius / distorted, 1.0)
        scale[~(distorted < top)] = np.nan
        return x * scale, y * scale

    def _undistorted_one(self, x_px: float, y_px: float) -> tuple[float, float]:
        """As `_undistorted`, for one pixel."""
        middle_x, middle_y = self._principal_px
        x = (x_px - middle_x) / self.focal_px
        y = (y_px - middle_y) / self.focal_px
        distorted = math.sqrt(x * x + y * y)
        limit, top = self.largest_radius, self._largest_distorted
        radius = min(distorted, limit)
        for _ in range(_NEWTON_STEPS):
            square = radius * radius
            bent = self.k2 * square
            value = radius * (1.0 + square * (self.k1 + bent)) - distorted
            slope = 1.0 + square * (3.0 * self.k1 + 5.0 * bent)
            step = value / max(slope, 0.05)
            radius = min(max(radius - step, 0.0), limit)
            if abs(step) < _NEWTON_ENOUGH:
                break
        else:
            if distorted < top:
                radius = self._bisected(distorted)
        scale = radius / distorted if distorted > 0.0 else 1.0
        if not distorted < top:
            scale = math.nan
        return x * scale, y * scale

    def _bisected(self, distorted: float) -> float:
        """The undistorted radius of a distorted one that lies before the fold.

        Where the lens model is nearly flat, next to its fold or an inflection, Newton's steps
        overshoot.
        """

        def falls_short(radius: float) -> bool:
            square = radius * radius
            return radius * (1.0 + square * (self.k1 + square * self.k2)) < distorted

        low, high = 0.0, min(max(distorted, _NEAREST), self.largest_radius)
        while high < self.largest_radius and falls_short(high):
            high = min(2.0 * high, self.largest_radius)
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (middle, high) if falls_short(middle) else (low, middle)
        return high

    @cached_property
    def _principal_px(self) -> tuple[float, float]:
        """Column and row of the principal point."""
        width, height = self.image_size_px
        return 0.5 * width + self.principal_dx_px, 0.5 * height + self.principal_dy_px

    @cached_property
    def _bend_per_m(self) -> float:
        """Curvature of the ground, the inverse of its effective radius in metres."""
        return self.curvature / EARTH_RADIUS_M

    @cached_property
    def _largest_distorted(self) -> float:
        """The distorted radius of `largest_radius`."""
        limit = self.largest_radius
        if not math.isfinite(limit):
            return math.inf
        return limit * (1.0 + self.k1 * limit**2 + self.k2 * limit**4)

    @cached_property
    def _rotation_rows(self) -> list[list[float]]:
        rows: list[list[float]] = self.rotation.tolist()
        return rows

    @cached_property
    def _turns(self) -> tuple[tuple[float, float], ...]:
        """Sine and cosine of heading, pitch and roll."""
        angles = map(math.radians, (self.heading_deg, self.pitch_deg, self.roll_deg))
        return tuple((math.sin(angle), math.cos(angle)) for angle in angles)

    def _down(self, x: Numbers, y: Numbers) -> Numbers:
        """Downward component of rays, per unit along the optical axis."""
        (_, _, r02), (_, _, r12), (_, _, r22) = self._rotation_rows
        return -(r02 * x + r12 * y + r22)

    def _level(self, x: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
        """East and north components of such rays."""
        (r00, r01, _), (r10, r11, _), (r20, r21, _) = self._rotation_rows
        return r00 * x + r10 * y + r20, r01 * x + r11 * y + r21

    def horizon_y_px(self, x_px: ArrayLike) -> FloatArray:
        """Rows of the horizon at given columns, (N,) float64; NaN where it cannot be seen."""
        columns = np.atleast_1d(np.asarray(x_px, dtype=float))
        bearings = np.radians(self.heading_deg) + np.linspace(-1.4, 1.4, 721)
        # The sea falls away: its horizon dips below the level of the camera.
        dip = np.full_like(bearings, -np.sqrt(2.0 * self._bend_per_m * self.height_m))
        directions = self.rotation @ np.stack([np.sin(bearings), np.cos(bearings), dip])
        ahead = directions[2] > 0.05
        x, y = (
            directions[0, ahead] / directions[2, ahead],
            directions[1, ahead] / directions[2, ahead],
        )
        square = x * x + y * y
        valid = square < self.largest_radius**2
        stretch = self.focal_px * (1.0 + square * (self.k1 + square * self.k2))[valid]
        middle_x, middle_y = self._principal_px
        at, row = middle_x + stretch * x[valid], middle_y + stretch * y[valid]
        return np.asarray(np.interp(columns, at, row, left=np.nan, right=np.nan))


def rotation_matrix(vector: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix from east, north, up to the camera's right, down and forward."""
    pitch, roll, heading = vector[PITCH], vector[ROLL], vector[HEADING]
    sin_h, cos_h = np.sin(heading), np.cos(heading)
    sin_p, cos_p = np.sin(pitch), np.cos(pitch)
    sin_r, cos_r = np.sin(roll), np.cos(roll)
    right = np.array([cos_h, -sin_h, 0.0])
    down = np.array([-sin_h * sin_p, -cos_h * sin_p, -cos_p])
    forward = np.array([sin_h * cos_p, cos_h * cos_p, -sin_p])
    return np.stack([cos_r * right - sin_r * down, sin_r * right + cos_r * down, forward])


def _project(
    vector: FloatArray,
    image_size_px: tuple[int, int],
    east_m: ArrayLike,
    north_m: ArrayLike,
    above_m: ArrayLike,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (N, 2), depth (N,) and squared normalised radius (N,), wherever the points lie."""
    rotation = rotation_matrix(vector)
    offset_east = np.asarray(east_m, dtype=float) - vector[EAST]
    offset_north = np.asarray(north_m, dtype=float) - vector[NORTH]
    height = np.exp(vector[LOG_HEIGHT])
    fallen = vector[CURVATURE] * (0.5 / EARTH_RADIUS_M) * (offset_east**2 + offset_north**2)
    offset_up = np.broadcast_to(np.asarray(above_m) - height, offset_east.shape) - fallen
    camera = rotation @ np.stack([offset_east, offset_north, offset_up])
    depth = np.maximum(camera[2], _NEAREST)
    x, y = camera[0] / depth, camera[1] / depth
    square = x * x + y * y
    stretch = np.exp(vector[LOG_FOCAL]) * (1.0 + square * (vector[K1] + square * vector[K2]))
    middle = 0.5 * np.asarray(image_size_px) + vector[PRINCIPAL]
    pixel = np.stack([middle[0] + stretch * x, middle[1] + stretch * y], axis=-1)
    return pixel, camera[2], square


def project_with_jacobian(
    vector: FloatArray,
    image_size_px: tuple[int, int],
    east_m: FloatArray,
    north_m: FloatArray,
    above_m: ArrayLike,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels and their Jacobian, for the fit and for the propagation of uncertainty.

    Args:
        vector: (12,) parameter vector.
        image_size_px: Width and height.
        east_m: (N,) metres.
        north_m: (N,) metres.
        above_m: (N,) or one value, metres.

    Returns:
        Pixels (N, 2); their derivatives by the parameters (N, 2, 12); and by the point's east,
        north and up (N, 2, 3), pixels a metre.
    """
    rotation = rotation_matrix(vector)
    height, focal = np.exp(vector[LOG_HEIGHT]), np.exp(vector[LOG_FOCAL])
    k1, k2 = vector[K1], vector[K2]
    n = np.size(east_m)
    offsets = np.empty((3, n))
    offsets[0] = east_m - vector[EAST]
    offsets[1] = north_m - vector[NORTH]
    per_metre = vector[CURVATURE] / EARTH_RADIUS_M
    away = offsets[0] ** 2 + offsets[1] ** 2
    offsets[2] = np.asarray(above_m) - height - 0.5 * per_metre * away
    camera = rotation @ offsets
    depth = np.maximum(camera[2], _NEAREST)
    inverse = 1.0 / depth
    x, y = camera[0] * inverse, camera[1] * inverse
    square = x * x + y * y
    stretch = 1.0 + square * (k1 + square * k2)
    slope = 2.0 * (k1 + 2.0 * k2 * square)
    pixel = np.empty((n, 2))
    middle = 0.5 * np.asarray(image_size_px) + vector[PRINCIPAL]
    pixel[:, 0] = middle[0] + focal * stretch * x
    pixel[:, 1] = middle[1] + focal * stretch * y

    # d pixel / d (x, y), then d (x, y) / d camera coordinates.
    xx = focal * (stretch + slope * x * x)
    xy = focal * slope * x * y
    yy = focal * (stretch + slope * y * y)
    by_camera = np.empty((2, 3, n))
    by_camera[0, 0], by_camera[0, 1] = xx * inverse, xy * inverse
    by_camera[1, 0], by_camera[1, 1] = xy * inverse, yy * inverse
    by_camera[:, 2] = -(x * by_camera[:, 0] + y * by_camera[:, 1])

    by_point = np.einsum("ijn,jk->nik", by_camera, rotation)

    by_parameter = np.empty((n, 2, len(PARAMETERS)))
    by_parameter[:, :, LOG_HEIGHT] = -height * by_point[:, :, 2]
    by_parameter[:, :, CURVATURE] = by_point[:, :, 2] * (-0.5 / EARTH_RADIUS_M * away)[:, None]
    by_parameter[:, :, PRINCIPAL] = np.eye(2)
    # With the distance from the camera the ground falls away.
    by_point[:, :, :2] -= by_point[:, :, 2:] * (per_metre * offsets[:2].T)[:, None, :]
    # Turning the camera turns the point about it: d right = 0, d down = -forward and so on.
    sin_r, cos_r = np.sin(vector[ROLL]), np.cos(vector[ROLL])
    down = sin_r * camera[0] * -1.0 + cos_r * camera[1]
    pitch_turn = np.stack([sin_r * camera[2], -cos_r * camera[2], down])
    roll_turn = np.stack([-camera[1], camera[0], np.zeros(n)])
    sin_h, cos_h = np.sin(vector[HEADING]), np.cos(vector[HEADING])
    sin_p, cos_p = np.sin(vector[PITCH]), np.cos(vector[PITCH])
    right_h = -sin_h * offsets[0] - cos_h * offsets[1]
    ahead_h = cos_h * offsets[0] - sin_h * offsets[1]
    down_h, forward_h = -sin_p * ahead_h, cos_p * ahead_h
    heading_turn = np.stack(
        [cos_r * right_h - sin_r * down_h, sin_r * right_h + cos_r * down_h, forward_h]
    )
    for slot, turn in ((PITCH, pitch_turn), (ROLL, roll_turn), (HEADING, heading_turn)):
        by_parameter[:, :, slot] = np.einsum("ijn,jn->ni", by_camera, turn)
    by_parameter[:, 0, LOG_FOCAL] = focal * stretch * x
    by_parameter[:, 1, LOG_FOCAL] = focal * stretch * y
    by_parameter[:, 0, K1] = focal * x * square
    by_parameter[:, 1, K1] = focal * y * square
    by_parameter[:, :, K2] = by_parameter[:, :, K1] * square[:, None]
    by_parameter[:, :, EAST] = -by_point[:, :, 0]
    by_parameter[:, :, NORTH] = -by_point[:, :, 1]
    return pixel, by_parameter, by_point


@dataclass(frozen=True, eq=False)
class Located:
    """Places as seen from the camera, with their derivatives by all that is uncertain.

    Attributes:
        distance_m: (N,) from the camera along the plane; NaN where there is no place.
        sine: (N,) of the bearing from the camera, clockwise from north.
        cosine: (N,) of the bearing.
        derivatives: (16, 2, N) metres along and across the line of sight (across is positive
            clockwise) by each of `PARAMETERS`, by the pixel's row (`BY_ROW`), by the height of the
            plane (`BY_ABOVE`), by the pixel's column (`BY_COLUMN`) and by ``beyond_m``
            (`BY_BEYOND`).
    """

    distance_m: FloatArray
    sine: FloatArray
    cosine: FloatArray
    derivatives: FloatArray


def locate_with_jacobian(
    camera: Camera, x_px: FloatArray, y_px: FloatArray, above_m: Numbers, beyond_m: Beyond
) -> Located:
    """Places of pixels and their Jacobian: `Camera.locate`, for the propagation of uncertainty.

    The derivatives are closed forms of the inverse projection, so that no system of equations is
    solved for a pixel.

    Args:
        camera: The camera.
        x_px: (N,) columns.
        y_px: (N,) rows.
        above_m: Metres of the plane over the ground, (N,) or one number.
        beyond_m: See `Beyond`.
    """
    x, y = camera._undistorted(x_px, y_px)
    down = camera._down(x, y)
    down[~(down > 0.0)] = np.nan
    out = np.empty((len(PARAMETERS) + 4, 2, x.size))
    return Located(*_derive(camera, x, y, down, above_m, beyond_m, np.sqrt, out), out)


def locate_one(
    camera: Camera, x_px: float, y_px: float, above_m: float, beyond_m: Beyond
) -> tuple[float, float, float, FloatArray] | None:
    """As `locate_with_jacobian`, for one pixel: the fields of `Located`; None without a place."""
    try:
        x, y = camera._undistorted_one(x_px, y_px)
        down = camera._down(x, y)
        if not down > 0.0:
            return None
        out = np.empty((len(PARAMETERS) + 4, 2))
        return *_derive(camera, x, y, down, above_m, beyond_m, math.sqrt, out), out
    except (ValueError, ZeroDivisionError):
        return None


def _derive(
    camera: Camera,
    x: Numbers,
    y: Numbers,
    down: Numbers,
    above_m: Numbers,
    beyond_m: Beyond,
    sqrt: Callable[[Any], Any],
    out: FloatArray,
) -> tuple[Numbers, Numbers, Numbers]:
    """Distance, sine and cosine of `Located`, with their derivatives written to ``out``.

    Args:
        camera: The camera.
        x: Normalised and undistorted, (N,) or one number.
        y: The same.
        down: By how much the ray sinks; positive.
        above_m: As `locate_with_jacobian` has it.
        beyond_m: As `locate_with_jacobian` has it.
        sqrt: Square root of the kind of number.
        out: (16, 2, N) or (16, 2).
    """
    (r00, r01, r02), (r10, r11, r12), _ = camera._rotation_rows
    east, north = camera._level(x, y)
    k1, k2 = camera.k1, camera.k2
    height = camera.height_m - above_m
    square = east * east + north * north
    level = sqrt(square)
    sine, cosine = east / level, north / level
    # How fast the ray sinks towards the ground where it meets it; on a plane that is `down`.
    slope = sqrt(down * down - 2.0 * camera._bend_per_m * height * square)
    reach = 2.0 * height / (down + slope)
    distance = reach * level

    further = distance / slope
    per_height = level / slope
    out[LOG_HEIGHT, 0], out[LOG_HEIGHT, 1] = per_height * camera.height_m, 0.0
    out[BY_ABOVE, 0], out[BY_ABOVE, 1] = -per_height, 0.0
    out[BY_BEYOND, 0], out[BY_BEYOND, 1] = 1.0, 0.0
    out[CURVATURE, 0] = distance * distance * per_height * (0.5 / EARTH_RADIUS_M)
    out[CURVATURE, 1] = 0.0
    # Along and across by the normalised coordinates: the ray turns, and it reaches further.
    turned = reach * (down / slope)
    x_along = turned * (r00 * sine + r01 * cosine) + r02 * further
    y_along = turned * (r10 * sine + r11 * cosine) + r12 * further
    total = distance + (beyond_m(distance) if callable(beyond_m) else beyond_m)
    aside = total / level
    x_across = aside * (r00 * cosine - r01 * sine)
    y_across = aside * (r10 * cosine - r11 * sine)

    # Pitch turns every ray about the level line to the right of the camera.
    (sin_h, cos_h), (sin_p, cos_p), (sin_r, cos_r) = camera._turns
    raised = sin_r * x - cos_r * y
    ahead = cos_p * raised - sin_p
    toward = sin_h * sine + cos_h * cosine
    out[PITCH, 0] = turned * ahead * toward - further * (sin_p * raised + cos_p)
    out[PITCH, 1] = aside * ahead * (sin_h * cosine - cos_h * sine)
    # Roll moves (x, y) by (y, -x).
    out[ROLL, 0] = y * x_along - x * y_along
    out[ROLL, 1] = y * x_across - x * y_across
    out[HEADING, 0], out[HEADING, 1] = 0.0, total
    # Focal length and distortion move a ray radially in the image.
    square = x * x + y * y
    stretch = 1.0 + square * (k1 + square * k2)
    lens_slope = 2.0 * (k1 + 2.0 * k2 * square)
    radial = -1.0 / (stretch + lens_slope * square)
    out[K1, 0] = (x * x_along + y * y_along) * radial
    out[K1, 1] = (x * x_across + y * y_across) * radial
    np.multiply(out[K1], stretch, out=out[LOG_FOCAL])
    # By the pixel: the inverse of the lens's own derivative.
    per_pixel = 1.0 / (camera.focal_px * stretch)
    bent = lens_slope * per_pixel
    bent_x, bent_y = bent * x, bent * y
    for i, (by_x, by_y) in enumerate(((x_along, y_along), (x_across, y_across))):
        out[BY_COLUMN, i] = per_pixel * by_x + bent_x * out[K1, i]
        out[BY_ROW, i] = per_pixel * by_y + bent_y * out[K1, i]
        np.negative(out[BY_COLUMN, i], out=out[PRINCIPAL_DX, i, ...])
        np.negative(out[BY_ROW, i], out=out[PRINCIPAL_DY, i, ...])
    out[K1] *= square
    np.multiply(out[K1], square, out=out[K2])
    out[EAST, 0], out[EAST, 1] = sine, cosine
    out[NORTH, 0], out[NORTH, 1] = cosine, -sine
    return total, sine, cosine
