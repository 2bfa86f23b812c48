"""A camera as somebody means to mount it, and boats as boxes in its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sightline.camera.pinhole import EARTH_RADIUS_M, Camera
from sightline.camera.target_sizes import BEAM_SHARE
from sightline.errors import InputError
from sightline.types import BoolArray, FloatArray

USUAL_CURVATURE = 6.0 / 7.0
"""Curvature of the water along sight lines over the earth's: refraction takes a seventh."""

_HORIZON_SHARE = 1.0 / 3.0
# How high a hull and what stands on it look, of its length.
_TOP_SHARE = 0.3
_COLUMNS, _ROWS = 65, 33
_NEAREST_M = 1.0


@dataclass(frozen=True)
class Hull:
    """The hull of a boat.

    Attributes:
        length_m: Of the hull.
        beam_m: Of the hull.

    Raises:
        InputError: A length is not positive, or the hull is broader than it is long.
    """

    length_m: float
    beam_m: float

    def __post_init__(self) -> None:
        if not 0.0 < self.beam_m <= self.length_m < math.inf:
            raise InputError(
                f"a boat of {self.length_m:g} by {self.beam_m:g} m is none; give its length and "
                "its beam in metres"
            )

    @classmethod
    def of_length(cls, length_m: float) -> Hull:
        """A hull as broad as boats of a length usually are."""
        return cls(length_m, BEAM_SHARE * length_m)

    @property
    def mean_width_m(self) -> float:
        """Its mean width as seen from anywhere."""
        return (self.length_m + self.beam_m) * 2.0 / math.pi

    def boxes(self, camera: Camera, east_north_m: FloatArray, ahead: FloatArray) -> FloatArray:
        """Boxes of the hull in a picture, (N, 4) pixels; NaN where a corner is not projected.

        Args:
            camera: That sees it.
            east_north_m: (N, 2) where its middle is, metres.
            ahead: (N, 2) unit vectors to its bow.
        """
        n = len(east_north_m)
        along, across = 0.5 * self.length_m * ahead, 0.5 * self.beam_m * ahead[:, ::-1] * (1, -1)
        corners = np.stack(
            [east_north_m + i * along + j * across for i in (-1, 1) for j in (-1, 1)]
        )
        flat = corners.reshape(-1, 2)
        low = camera.project(flat[:, 0], flat[:, 1]).reshape(-1, n, 2)
        high = camera.project(flat[:, 0], flat[:, 1], _TOP_SHARE * self.length_m).reshape(-1, n, 2)
        points = np.concatenate([low, high])
        return np.concatenate([points.min(axis=0), points.max(axis=0)], axis=1)


@dataclass(frozen=True)
class Mounting:
    """How a camera is to be mounted.

    Attributes:
        height_m: Of the lens above the water.
        field_of_view_deg: Angle between the left and the right edge of the picture.
        image_size_px: Width and height of the picture.
        heading_deg: Bearing of the optical axis, degrees clockwise from north.
        pitch_deg: Of the optical axis below the horizontal. None: so that the horizon lies a third
            of the picture below its upper edge.
        roll_deg: Positive where the right end of the horizon lies lower.
        distortion: First and second radial term of the lens; a negative first is a barrel.

    Raises:
        InputError: A value is none that a camera can have.
    """

    height_m: float
    field_of_view_deg: float
    image_size_px: tuple[int, int]
    heading_deg: float
    pitch_deg: float | None = None
    roll_deg: float = 0.0
    distortion: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.height_m < math.inf:
            raise InputError(f"a height of {self.height_m:g} m is none; give one above the water")
        if not 0.0 < self.field_of_view_deg < 180.0:
            raise InputError(
                f"a field of view of {self.field_of_view_deg:g}° is none of a picture on a plane; "
                "give one between 0 and 180°"
            )
        k1, k2 = self.distortion
        square = self._edge_radius**2
        # Up to the edge the distorted radius has to grow.
        grows = 1.0 + 3.0 * k1 * square + 5.0 * k2 * square**2
        if not (math.isfinite(k1 + k2) and grows > 0.0):
            raise InputError(
                f"a distortion of k1 = {k1:g}, k2 = {k2:g} folds the picture over itself before "
                "its edges; give one that is nearer to 0"
            )

    @property
    def focal_px(self) -> float:
        """Focal length of the lens that has the field of view."""
        half_px, radius = 0.5 * self.image_size_px[0], self._edge_radius
        square = radius**2
        return half_px / (
            radius * (1.0 + square * self.distortion[0] + square**2 * self.distortion[1])
        )

    @property
    def _edge_radius(self) -> float:
        """Normalised undistorted radius of the left and the right edge."""
        return math.tan(0.5 * math.radians(self.field_of_view_deg))

    @property
    def camera(self) -> Camera:
        """The camera, at the origin of the plane."""
        pitch_deg = self.pitch_deg
        if pitch_deg is None:
            below_px = (0.5 - _HORIZON_SHARE) * self.image_size_px[1]
            dip = math.sqrt(2.0 * USUAL_CURVATURE * self.height_m / EARTH_RADIUS_M)
            pitch_deg = math.degrees(math.atan(below_px / self.focal_px) + dip)
        return Camera(
            height_m=self.height_m,
            pitch_deg=pitch_deg,
            roll_deg=self.roll_deg,
            heading_deg=self.heading_deg,
            focal_px=self.focal_px,
            k1=self.distortion[0],
            k2=self.distortion[1],
            east_m=0.0,
            north_m=0.0,
            image_size_px=self.image_size_px,
            curvature=USUAL_CURVATURE,
        )


def in_picture(camera: Camera, pixel_px: FloatArray) -> BoolArray:
    """(N,) bool, whether pixels (N, 2) lie in the picture; those that are not numbers do not."""
    with np.errstate(invalid="ignore"):
        inside = (pixel_px >= 0.0) & (pixel_px <= np.asarray(camera.image_size_px, dtype=float))
    return np.asarray(inside.all(axis=1))


def horizontal_view(camera: Camera) -> tuple[float, float]:
    """Least and largest bearing off the heading at which water is in the picture, radians.

    Raises:
        InputError: There is no water in it.
    """
    width, height = camera.image_size_px
    x, y = np.meshgrid(np.linspace(0.0, width, _COLUMNS), np.linspace(0.0, height, _ROWS))
    east, north = camera.locate(np.stack([x.ravel(), y.ravel()], axis=1))
    known = np.isfinite(east)
    if not known.any():
        raise InputError(
            f"a camera that looks {camera.pitch_deg:.1f}° below the horizontal sees no water; give "
            "it a larger pitch"
        )
    bearing = np.arctan2(east[known] - camera.east_m, north[known] - camera.north_m)
    off = bearing - np.radians(camera.heading_deg)
    off = np.arctan2(np.sin(off), np.cos(off))
    return float(off.min()), float(off.max())


def horizon_m(camera: Camera, above_m: float = 0.0) -> float:
    """Distance of the horizon; infinite where the water does not fall away."""
    return horizon_distance_m(camera.height_m - above_m, camera.curvature)


def horizon_distance_m(height_m: float, share: float) -> float:
    """Distance of the horizon from a height over water of a share of the earth's curvature."""
    return math.sqrt(2.0 * EARTH_RADIUS_M * height_m / share) if share > 0.0 else math.inf


def around(camera: Camera, off_rad: FloatArray | float, range_m: FloatArray | float) -> FloatArray:
    """(N, 2) places at bearings off the heading and ranges, metres in the plane."""
    angle = np.radians(camera.heading_deg) + np.asarray(off_rad)
    east = camera.east_m + np.asarray(range_m) * np.sin(angle)
    return np.stack([east, camera.north_m + np.asarray(range_m) * np.cos(angle)], axis=-1)


def seen_ahead_m(camera: Camera, above_m: float = 0.0) -> tuple[float, float]:
    """Nearest and farthest water in the picture along the heading, metres.

    Raises:
        InputError: There is none.
    """
    farthest = min(horizon_m(camera, above_m), 100_000.0)
    ranges = np.geomspace(min(_NEAREST_M, 0.5 * farthest), farthest, 2000)
    place = around(camera, 0.0, ranges)
    seen = ranges[in_picture(camera, camera.project(place[:, 0], place[:, 1], above_m))]
    if not seen.size:
        raise InputError(
            "there is no water along the heading in the picture; give the camera another pitch"
        )
    return float(seen[0]), float(seen[-1])
