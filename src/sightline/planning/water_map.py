"""The water before a camera: how well places on it are known, and how large boats look."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from contourpy import contour_generator

from sightline.camera.pinhole import Camera
from sightline.errors import InputError
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.planning.mounting import (
    Hull,
    around,
    horizon_distance_m,
    horizon_m,
    horizontal_view,
    in_picture,
    seen_ahead_m,
)
from sightline.types import BoolArray, FloatArray, ellipses

LEVELS_M = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0)
"""Semi-major axes of 95 % ellipses at which contours are drawn, metres."""

PROBABILITY = 0.95

_BEARINGS, _RANGES = 161, 401
_FARTHEST_M = 30_000.0
# A map reaches so far beyond what is to be seen on it.
_MARGIN = 1.05
_STEPS = (1.0, 2.0, 5.0)
_FEWEST_POINTS = 2
_LEAST_SPAN = 4.0
_BISECTIONS = 12
_MOST_ASIDE = math.radians(50.0)
_MATTERS_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Contour:
    """A line on the water.

    Attributes:
        kind: ``"axis"``: the 95 % ellipse is as long; ``"size"``: a boat is as wide in the
            picture; ``"limit"``: beyond it a place is less certain than half its range.
        value: Of an axis: the semi-major axis, metres; of a size: the length of the boat, metres;
            of a limit: 0.
        above_m: How high the water stands above the plane that the camera's height is over.
        east_north_m: (N, 2) metres in the plane.
    """

    kind: str
    value: float
    above_m: float
    east_north_m: FloatArray


@dataclass(frozen=True, eq=False)
class WaterMap:
    """How well places on the water are known.

    Attributes:
        east_m: (B, R) float64 by bearings and ranges, metres in the plane.
        north_m: (B, R) float64.
        axis_m: (B, R) float64, semi-major axes of the 95 % ellipses; NaN where it is out of the
            picture, or there is no position.
        contours: Of the axes, the sizes of boats, and the limit.
    """

    east_m: FloatArray
    north_m: FloatArray
    axis_m: FloatArray
    contours: tuple[Contour, ...]

    @property
    def reach_m(self) -> float:
        """How far the map reaches."""
        return float(np.hypot(self.east_m[0, -1], self.north_m[0, -1]))


@dataclass(frozen=True)
class Row:
    """A place along the heading.

    Attributes:
        range_m: From the camera.
        axis_m: Semi-major axis of its 95 % ellipse, metres; NaN where there is no position.
        minor_m: Semi-minor axis.
        known_m: Semi-major axis were the camera known exactly.
        metres_per_px: Along the line of sight, by a row of the picture.
        widths_px: Of the boats, broadside.
        flat_error_m: By how much too near it would lie were the water taken for flat.
    """

    range_m: float
    axis_m: float
    minor_m: float
    known_m: float
    metres_per_px: float
    widths_px: tuple[float, ...]
    flat_error_m: float


@dataclass(frozen=True)
class Curvature:
    """How much it matters that the water falls away.

    Attributes:
        horizon_m: Distance of the horizon, with refraction; infinite over flat water.
        geometric_horizon_m: Without refraction.
        pixel_from_m: From this range the water lies a pixel lower than flat water would; infinite
            where it does nowhere before the horizon.
        matters_from_m: From this range places would lie a twentieth of the range too near were the
            water taken for flat.
    """

    horizon_m: float
    geometric_horizon_m: float
    pixel_from_m: float
    matters_from_m: float


def boxes_at(
    camera: Camera, east_north_m: FloatArray, hull: Hull, above_m: float = 0.0
) -> FloatArray:
    """(N, 4) boxes of boats of any course whose near sides are at places; NaN out of the picture.

    Args:
        camera: That sees them.
        east_north_m: (N, 2) metres in the plane.
        hull: Of the boats.
        above_m: How high the water stands.
    """
    foot = camera.project(east_north_m[:, 0], east_north_m[:, 1], above_m)
    foot[~in_picture(camera, foot)] = np.nan
    apart = np.hypot(east_north_m[:, 0] - camera.east_m, east_north_m[:, 1] - camera.north_m)
    half = 0.5 * hull.mean_width_m * camera.focal_px / np.hypot(apart, camera.height_m - above_m)
    return np.stack([foot[:, 0] - half, foot[:, 1] - half, foot[:, 0] + half, foot[:, 1]], axis=1)


def axes_at(
    model: CameraRegressor,
    east_north_m: FloatArray,
    hull: Hull,
    *,
    camera: Camera | None = None,
    source: str = "",
    above_m: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """Semi-major and semi-minor axes of 95 % ellipses of boats at places, (N,) metres each.

    Args:
        model: That places them.
        east_north_m: (N, 2) metres in the plane.
        hull: Of the boats.
        camera: The true one, that sees them. Absent: the model's.
        source: Who makes their boxes.
        above_m: How high the water stands.

    Returns:
        NaN where they are out of the picture, or have no position.
    """
    boxes = boxes_at(camera or model.camera, east_north_m, hull, above_m)
    known = np.isfinite(boxes).all(axis=1)
    major, minor = np.full((2, len(boxes)), np.nan)
    if known.any():
        _, covariance = model.predict(boxes[known], source=source, above_m=above_m, return_cov=True)
        shape = ellipses(covariance, PROBABILITY)
        major[known], minor[known] = shape.semi_major_m, shape.semi_minor_m
    return major, minor


def width_px(camera: Camera, east_north_m: FloatArray, length_m: float) -> FloatArray:
    """(N,) widths of boats that lie broadside at places, pixels; NaN behind the camera."""
    off = east_north_m - [camera.east_m, camera.north_m]
    across = 0.5 * length_m * off[:, ::-1] * (1.0, -1.0)
    across /= np.maximum(np.hypot(*off.T), 1e-9)[:, None]
    left, right = (
        camera.project(end[:, 0], end[:, 1])
        for end in (east_north_m - across, east_north_m + across)
    )
    return np.asarray(np.hypot(*(right - left).T))


def width_reach_m(camera: Camera, length_m: float, least_px: float) -> float:
    """Range along the heading beyond which a boat broadside is narrower than so many pixels."""
    slant_m = camera.focal_px * length_m / least_px
    return math.sqrt(max(slant_m**2 - camera.height_m**2, 0.0))


def water_map(
    model: CameraRegressor,
    boats: Sequence[Hull],
    *,
    camera: Camera | None = None,
    source: str = "",
    least_px: float = 8.0,
    above_m: float = 0.0,
    reach_m: float | None = None,
) -> WaterMap:
    """Map the 95 % ellipses over the water in the picture.

    Args:
        model: That places boats.
        boats: Of interest; ellipses are those of the first.
        camera: The true one, that sees them. Absent: the model's.
        source: Who makes their boxes.
        least_px: Width at which boats are just found.
        above_m: How high the water stands above the plane that the camera's height is over.
        reach_m: How far the map reaches. Absent: to where the largest boat is just found.

    Raises:
        InputError: No water is in the picture, or none of it is known well enough for a position.
    """
    camera = camera or model.camera
    left, right = horizontal_view(camera)
    nearest, _ = seen_ahead_m(camera, above_m)
    most = min(horizon_m(camera, above_m), _FARTHEST_M)
    off = np.linspace(left, right, _BEARINGS)

    def axes(where: FloatArray) -> FloatArray:
        return axes_at(model, where, boats[0], camera=camera, source=source, above_m=above_m)[0]

    def mapped(reach: float) -> tuple[FloatArray, FloatArray]:
        ranges = np.geomspace(min(nearest, 0.5 * reach), reach, _RANGES)
        places = around(camera, off[:, None], ranges[None, :])
        return places, axes(places.reshape(-1, 2)).reshape(off.size, ranges.size)

    if reach_m is None:
        seen_m = max(width_reach_m(camera, boat.length_m, least_px) for boat in boats)
        # To the sides of a picture boats look larger.
        seen_m /= math.cos(min(max(abs(left), abs(right)), _MOST_ASIDE)) ** 2
        reach_m = min(max(_MARGIN * seen_m, _LEAST_SPAN * nearest), most)
    places, axis_m = mapped(reach_m)
    if not np.isfinite(axis_m).any():
        raise InputError(
            "no place on the water is certain to half of its range; a higher camera, a longer "
            "lens, or a drive that tells more would mend it"
        )
    flat = places.reshape(-1, 2)
    pixel = camera.project(flat[:, 0], flat[:, 1], above_m)
    seen = in_picture(camera, pixel).reshape(axis_m.shape)
    east, north = places[..., 0], places[..., 1]
    contours = [
        *_lines("axis", east, north, axis_m, LEVELS_M, above_m),
        *_limits(axes, places, axis_m, seen, above_m),
    ]
    for boat in boats:
        widths = np.where(seen.ravel(), width_px(camera, flat, boat.length_m), np.nan)
        found = _lines("size", east, north, widths.reshape(axis_m.shape), [least_px], above_m)
        contours += [replace(one, value=boat.length_m) for one in found]
    return WaterMap(east, north, axis_m, tuple(contours))


def _lines(
    kind: str,
    east_m: FloatArray,
    north_m: FloatArray,
    values: FloatArray,
    levels: Sequence[float],
    above_m: float,
) -> list[Contour]:
    """Contours of positive values over the water; between places their logarithm is linear."""
    masked = np.ma.masked_invalid(np.log(values))
    if masked.mask.all():
        return []
    lines = contour_generator(east_m, north_m, masked)
    return [
        Contour(kind, float(level), above_m, np.asarray(line, dtype=np.float64))
        for level in levels
        for line in lines.lines(float(np.log(level)))
        if len(line) >= _FEWEST_POINTS
    ]


def _limits(
    axes: Callable[[FloatArray], FloatArray],
    places: FloatArray,
    axis_m: FloatArray,
    seen: BoolArray,
    above_m: float,
) -> list[Contour]:
    """Where positions end though the water is still in the picture, stretch by stretch.

    Args:
        axes: Semi-major axes at places (N, 2), NaN where there is no position.
        places: (B, R, 2) by bearings and ranges, metres.
        axis_m: (B, R) the axes there.
        seen: (B, R) whether they are in the picture.
        above_m: How high the water stands.
    """
    known = np.isfinite(axis_m)
    last = known.shape[1] - 1 - np.argmax(known[:, ::-1], axis=1)
    beyond = np.minimum(last + 1, known.shape[1] - 1)
    rows = np.arange(len(last))
    ends = known.any(axis=1) & (last < beyond) & seen[rows, beyond]
    near, far = places[rows, last], places[rows, beyond]
    for _ in range(_BISECTIONS):
        middle = 0.5 * (near + far)
        inside = np.isfinite(axes(middle))[:, None]
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    chosen = rows[ends]
    parts = np.split(chosen, np.flatnonzero(np.diff(chosen) > 1) + 1)
    return [
        Contour("limit", 0.0, above_m, near[part]) for part in parts if part.size >= _FEWEST_POINTS
    ]


def rows_along(
    model: CameraRegressor,
    known: CameraRegressor,
    boats: Sequence[Hull],
    *,
    camera: Camera | None = None,
    source: str = "",
    above_m: float = 0.0,
    reach_m: float,
) -> tuple[Row, ...]:
    """Places along the heading, at rounded ranges.

    Args:
        model: That places boats.
        known: The same, were its camera known exactly.
        boats: Of interest; ellipses are those of the first.
        camera: The true one, that sees them. Absent: the model's.
        source: Who makes their boxes.
        above_m: How high the water stands.
        reach_m: Farthest range.
    """
    camera = camera or model.camera
    nearest, farthest = seen_ahead_m(camera, above_m)
    steps = np.array([step * 10.0**power for power in range(6) for step in _STEPS])
    ranges = steps[(steps >= nearest) & (steps <= min(farthest, reach_m))]
    if not ranges.size:
        ranges = np.array([np.sqrt(nearest * min(farthest, max(reach_m, nearest)))])
    places = around(camera, 0.0, ranges)
    major, minor = axes_at(model, places, boats[0], camera=camera, source=source, above_m=above_m)
    alone, _ = axes_at(known, places, boats[0], camera=camera, source=source, above_m=above_m)
    foot = camera.project(places[:, 0], places[:, 1], above_m)
    half_row = np.array([0.0, 0.5])
    nearer = camera.locate(foot + half_row, above_m)
    further = camera.locate(foot - half_row, above_m)
    widths = [width_px(camera, places, boat.length_m) for boat in boats]
    return tuple(
        Row(
            range_m=float(ranges[i]),
            axis_m=float(major[i]),
            minor_m=float(minor[i]),
            known_m=float(alone[i]),
            metres_per_px=float(
                np.hypot(further[0][i] - nearer[0][i], further[1][i] - nearer[1][i])
            ),
            widths_px=tuple(float(width[i]) for width in widths),
            flat_error_m=float(_flat_errors(camera, ranges[i : i + 1], above_m)[0]),
        )
        for i in range(ranges.size)
    )


def _flat_errors(camera: Camera, range_m: FloatArray, above_m: float) -> FloatArray:
    """(N,) how much too near places ahead would lie were the water taken for flat."""
    places = around(camera, 0.0, range_m)
    pixel = camera.project(places[:, 0], places[:, 1], above_m)
    east, north = replace(camera, curvature=0.0).locate(pixel, above_m)
    return np.asarray(range_m - np.hypot(east - camera.east_m, north - camera.north_m))


def curvature(camera: Camera, above_m: float = 0.0) -> Curvature:
    """How much it matters that the water falls away, ahead of a camera.

    Args:
        camera: It.
        above_m: How high the water stands above the plane that its height is over.
    """
    end = horizon_m(camera, above_m)
    height = camera.height_m - above_m
    if not np.isfinite(end):
        infinite = float("inf")
        return Curvature(infinite, horizon_distance_m(height, 1.0), infinite, infinite)
    ranges = np.geomspace(1.0, end, 4000)[:-1]
    places = around(camera, 0.0, ranges)
    flat = replace(camera, curvature=0.0)
    lower = (
        camera.project(places[:, 0], places[:, 1], above_m)
        - flat.project(places[:, 0], places[:, 1], above_m)
    )[:, 1]
    with np.errstate(invalid="ignore"):
        matters = _flat_errors(camera, ranges, above_m) > _MATTERS_SHARE * ranges
        pixel = lower > 1.0

    def first(mask: BoolArray) -> float:
        return float(ranges[int(np.argmax(mask))]) if mask.any() else float("inf")

    return Curvature(end, horizon_distance_m(height, 1.0), first(pixel), first(matters))
