"""Where places on the water lie in the picture: points, ellipses, rings, a grid, the horizon."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sightline.camera.pinhole import Camera
from sightline.types import FloatArray

PROBABILITY = 0.95
"""Of the ellipses: so often the true place lies inside."""

_ELLIPSE_POINTS = 73
_RING_POINTS = 721
_LINE_POINTS = 201
_RINGS_M = tuple(step * 10.0**power for power in range(1, 5) for step in (1.0, 2.0, 5.0))
# Rings that are closer in the picture cannot be told apart.
_LEAST_APART_PX = 18.0
_GRID_LINES = 8


@dataclass(frozen=True, eq=False)
class WaterView:
    """The water as a camera sees it at one time.

    Attributes:
        camera: With its height over the water as that stands.
        rotation_rad: (3,) rotation vector by which the scene has turned about the camera's axes.
    """

    camera: Camera
    rotation_rad: FloatArray

    @classmethod
    def of(
        cls, camera: Camera, above_m: float = 0.0, rotation_rad: ArrayLike = (0.0, 0.0, 0.0)
    ) -> WaterView:
        """The view of a camera as it was fitted.

        Args:
            camera: Over the plane of its fit.
            above_m: How much higher the water stands than that.
            rotation_rad: See above; what is not known is taken as none.
        """
        turned = np.asarray(rotation_rad, dtype=float).reshape(3)
        known = turned if np.isfinite(turned).all() else np.zeros(3)
        return cls(replace(camera, height_m=camera.height_m - above_m), known)

    def pixels(self, east_north_m: ArrayLike) -> FloatArray:
        """Pixels of places on the water, (N, 2); NaN where they are not seen.

        Args:
            east_north_m: (N, 2) in the plane of the model.
        """
        places = np.asarray(east_north_m, dtype=float).reshape(-1, 2)
        return self._turned(self.camera.project(places[:, 0], places[:, 1]))

    def _turned(self, pixels_px: FloatArray) -> FloatArray:
        if not self.rotation_rad.any():
            return pixels_px
        rays = self.camera.rays(pixels_px)
        known = np.isfinite(rays).all(axis=1)
        out = np.full_like(pixels_px, np.nan)
        if known.any():
            turned = Rotation.from_rotvec(self.rotation_rad).apply(rays[known])
            out[known] = self.camera.pixels(turned)
        return out

    def ellipse_px(self, east_north_m: ArrayLike, covariance_m2: ArrayLike) -> FloatArray:
        """Outline of a 95 % ellipse as it lies on the water, (N, 2) pixels."""
        return self.pixels(ellipse_outline(east_north_m, covariance_m2))

    def horizon_px(self) -> FloatArray:
        """(N, 2) pixels along the horizon."""
        width = self.camera.image_size_px[0]
        columns = np.linspace(-0.1 * width, 1.1 * width, _LINE_POINTS)
        return self._turned(np.stack([columns, self.camera.horizon_y_px(columns)], axis=1))

    def rings(self) -> list[tuple[float, FloatArray]]:
        """Circles about the camera that can be told apart: radius, and (N, 2) pixels."""
        bearings = np.radians(self.camera.heading_deg) + np.linspace(-np.pi, np.pi, _RING_POINTS)
        height = self.camera.image_size_px[1]
        found: list[tuple[float, FloatArray]] = []
        above = np.inf
        for radius_m in _RINGS_M:
            ahead = self.pixels(self._around(radius_m, bearings[[_RING_POINTS // 2]]))
            row = float(ahead[0, 1])
            if not (0.0 <= row < height and row <= above - _LEAST_APART_PX):
                continue
            found.append((radius_m, self.pixels(self._around(radius_m, bearings))))
            above = row
        return found

    def grid(self, reach_m: float, spacing_m: float) -> list[FloatArray]:
        """Lines of equal east and of equal north, (N, 2) pixels each.

        Args:
            reach_m: How far from the camera they go.
            spacing_m: Between them; multiples of it from the origin of the plane.
        """
        place = np.array([self.camera.east_m, self.camera.north_m])
        along = np.linspace(-reach_m, reach_m, _LINE_POINTS)
        lines = []
        for axis in (0, 1):
            first = np.ceil((place[axis] - reach_m) / spacing_m) * spacing_m
            for value in np.arange(first, place[axis] + reach_m, spacing_m):
                half = np.sqrt(max(reach_m**2 - (value - place[axis]) ** 2, 0.0))
                points = np.empty((_LINE_POINTS, 2))
                points[:, axis] = value
                points[:, 1 - axis] = place[1 - axis] + along * (half / reach_m)
                lines.append(self.pixels(points))
        return lines

    def edge_bearings_rad(self) -> tuple[float, float]:
        """Bearings of the left and the right edge of what is seen, clockwise from north."""
        width, height = self.camera.image_size_px
        columns = np.linspace(0.0, width, _LINE_POINTS)
        rays = self.camera.rays(np.stack([columns, np.full_like(columns, 0.5 * height)], axis=1))
        # Beyond the fold of a lens there is nothing.
        rays = rays[np.isfinite(rays).all(axis=1)][[0, -1]]
        if self.rotation_rad.any():
            rays = Rotation.from_rotvec(self.rotation_rad).inv().apply(rays)
        east_north = rays @ self.camera.rotation
        left, right = np.arctan2(east_north[:, 0], east_north[:, 1])
        return float(left), float(right)

    def _around(self, radius_m: float, bearings: FloatArray) -> FloatArray:
        offset = radius_m * np.stack([np.sin(bearings), np.cos(bearings)], axis=1)
        return np.asarray(offset + np.array([self.camera.east_m, self.camera.north_m]))


def ellipse_outline(east_north_m: ArrayLike, covariance_m2: ArrayLike) -> FloatArray:
    """Outline of a 95 % ellipse in the plane, (N, 2) metres, closed; NaN for what is not known."""
    covariance = np.asarray(covariance_m2, dtype=float)
    if not np.isfinite(covariance).all():
        return np.full((_ELLIPSE_POINTS, 2), np.nan)
    values, vectors = np.linalg.eigh(covariance)
    axes = np.sqrt(-2.0 * np.log1p(-PROBABILITY)) * np.sqrt(np.maximum(values, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.asarray(np.asarray(east_north_m, dtype=float) + (circle * axes) @ vectors.T)


def grid_spacing_m(reach_m: float) -> float:
    """Spacing of a grid of some lines that reaches so far."""
    steps = [one for one in _RINGS_M if one >= reach_m / _GRID_LINES]
    return steps[0] if steps else _RINGS_M[-1]
