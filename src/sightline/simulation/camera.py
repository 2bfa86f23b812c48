"""The camera of the synthetic harbour: how a point above the water becomes a pixel.

The camera stands ``height_m`` above the water, at east 0 and north 0; the water is the plane z = 0.
Curvature of the earth is left out: over two kilometres it lowers a point by 0.3 m.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sightline.errors import InputError
from sightline.types import FloatArray


@dataclass(frozen=True)
class SimulatedCamera:
    """A pinhole camera with square pixels and a Brown-Conrady radial distortion.

    With normalised coordinates ``x_u = X_c / Z_c`` and ``y_u = Y_c / Z_c`` (camera axes: x to the
    right, y down, z forward) and ``r² = x_u² + y_u²``, a pixel is the image centre plus
    ``f (x_u, y_u) (1 + k1 r² + k2 r⁴)``: the forward model of OpenCV's ``projectPoints``.

    Attributes:
        height_m: Height of the lens above the water.
        pitch_deg: How far the optical axis looks below the horizon; negative looks up.
        roll_deg: Rotation about the optical axis; positive lowers the right end of the horizon in
            the image.
        heading_deg: Bearing of the optical axis, clockwise from north.
        focal_length_px: Focal length.
        k1: First radial distortion coefficient; negative is a barrel.
        k2: Second radial distortion coefficient.
        image_size_px: Width and height. The principal point is the centre, ``(w / 2, h / 2)``.

    Raises:
        InputError: Height or focal length is not positive, or the distortion folds the image over
            itself before its corners.
    """

    height_m: float
    pitch_deg: float
    roll_deg: float
    heading_deg: float
    focal_length_px: float
    k1: float = 0.0
    k2: float = 0.0
    image_size_px: tuple[int, int] = (1280, 720)

    def __post_init__(self) -> None:
        if not (self.height_m > 0.0 and self.focal_length_px > 0.0):
            raise InputError(
                f"camera: height {self.height_m:g} m and focal length {self.focal_length_px:g} px "
                "must both be positive"
            )
        corner = 0.5 * float(np.hypot(*self.image_size_px)) / self.focal_length_px
        if self._distorted_radius(self._fold_radius) < corner:
            raise InputError(
                f"camera: a distortion of k1 = {self.k1:g}, k2 = {self.k2:g} folds the image over "
                "itself before its corners; weaken k1 or raise k2"
            )

    @classmethod
    def random(
        cls, rng: np.random.Generator, image_size_px: tuple[int, int] = (1280, 720)
    ) -> SimulatedCamera:
        """A camera such as people mount on docks: low, nearly level, wide, with a barrel.

        Args:
            rng: Where the randomness comes from.
            image_size_px: Width and height.
        """
        k1 = rng.uniform(-0.30, -0.08)
        return cls(
            height_m=rng.uniform(3.0, 8.0),
            pitch_deg=rng.uniform(-3.0, 4.0),
            roll_deg=rng.uniform(-1.5, 1.5),
            heading_deg=rng.uniform(0.0, 360.0),
            focal_length_px=rng.uniform(0.62, 0.90) * image_size_px[0],
            k1=k1,
            # 20 k2 > 9 k1² keeps the distorted radius growing everywhere.
            k2=rng.uniform(0.5, 0.8) * k1**2,
            image_size_px=image_size_px,
        )

    @cached_property
    def rotation(self) -> FloatArray:
        """(3, 3) float64, world (east, north, up) to camera (right, down, forward)."""
        heading, pitch, roll = np.radians([self.heading_deg, self.pitch_deg, self.roll_deg])
        forward = np.array(
            [np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), -np.sin(pitch)]
        )
        right = np.array([np.cos(heading), -np.sin(heading), 0.0])
        down = np.cross(forward, right)
        return np.stack(
            [
                np.cos(roll) * right - np.sin(roll) * down,
                np.sin(roll) * right + np.cos(roll) * down,
                forward,
            ]
        )

    @cached_property
    def _fold_radius(self) -> float:
        """The undistorted radius where the distorted one stops growing."""
        roots = np.roots([5.0 * self.k2, 3.0 * self.k1, 1.0])
        real = roots[np.abs(roots.imag) < 1e-12].real if roots.size else np.empty(0)
        positive = real[real > 0.0]
        return float(np.sqrt(positive.min())) if positive.size else float("inf")

    def _distorted_radius(self, radius: float) -> float:
        if not np.isfinite(radius):
            return float("inf")
        return radius * (1.0 + self.k1 * radius**2 + self.k2 * radius**4)

    def project(self, points_enu_m: ArrayLike, turn: FloatArray | None = None) -> FloatArray:
        """Pixels of points in the world.

        Args:
            points_enu_m: (..., 3) metres east, north and above the water.
            turn: (N, 3, 3), of the hull that the camera stands on, for points (N, ..., 3).

        Returns:
            (..., 2) float64 px; NaN behind the camera and beyond the fold of the lens.
        """
        points = np.asarray(points_enu_m, dtype=float) - [0.0, 0.0, self.height_m]
        if turn is not None:
            points = np.einsum("nij,n...j->n...i", turn, points)
        seen_from_lens = points @ self.rotation.T
        ahead = seen_from_lens[..., 2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            undistorted = seen_from_lens[..., :2] / ahead[..., None]
            r2 = undistorted[..., 0] ** 2 + undistorted[..., 1] ** 2
            factor = self.focal_length_px * (1.0 + r2 * (self.k1 + self.k2 * r2))
            pixels = 0.5 * np.asarray(self.image_size_px) + factor[..., None] * undistorted
            unseen = ~((ahead > 1e-6) & (r2 < self._fold_radius**2))
        pixels[unseen] = np.nan
        return np.asarray(pixels)

    def directions(self, pixels: ArrayLike) -> FloatArray:
        """Unit vectors into the world, along which pixels look.

        Args:
            pixels: (..., 2) px.

        Returns:
            (..., 3) float64, east, north, up; NaN beyond the fold of the lens.
        """
        centred = np.asarray(pixels, dtype=float) - 0.5 * np.asarray(self.image_size_px)
        distorted = np.hypot(centred[..., 0], centred[..., 1]) / self.focal_length_px
        radius = self._undistorted_radius(distorted)
        with np.errstate(invalid="ignore", divide="ignore"):
            scale = np.where(distorted > 0.0, radius / distorted, 1.0) / self.focal_length_px
        rays = np.concatenate(
            [centred * scale[..., None], np.ones((*centred.shape[:-1], 1))], axis=-1
        )
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.asarray(rays @ self.rotation)

    def _undistorted_radius(self, distorted: FloatArray) -> FloatArray:
        """Invert the distortion through a fine table: it only grows up to the fold."""
        largest = float(np.max(distorted, initial=0.0))
        end = min(self._fold_radius, 0.1 + largest)
        while self._distorted_radius(end) < largest and end < self._fold_radius:
            end = min(1.3 * end, self._fold_radius)
        table = np.linspace(0.0, end, 4096)
        forward = table * (1.0 + self.k1 * table**2 + self.k2 * table**4)
        radius = np.interp(distorted, forward, table, right=np.nan)
        # One Newton step brings the table's 1e-7 down to rounding.
        with np.errstate(divide="ignore", invalid="ignore"):
            r2 = radius**2
            step = (radius * (1.0 + self.k1 * r2 + self.k2 * r2**2) - distorted) / (
                1.0 + 3.0 * self.k1 * r2 + 5.0 * self.k2 * r2**2
            )
        return radius - np.where(np.isfinite(step), step, 0.0)

    def on_water(self, pixels: ArrayLike) -> FloatArray:
        """Where pixels look at the water: (..., 2) metres east and north; NaN at the sky."""
        rays = self.directions(pixels)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = np.where(rays[..., 2] < 0.0, -self.height_m / rays[..., 2], np.nan)
            return np.asarray(rays[..., :2] * distance[..., None])

    def horizon_px(self, x_px: ArrayLike, turn: FloatArray | None = None) -> FloatArray:
        """The row of the horizon at columns of the image.

        Args:
            x_px: (N,) columns.
            turn: (3, 3), of the hull that the camera stands on.

        Returns:
            (N,) float64 px, which may lie outside the image; NaN where the horizon is not seen.
        """
        heading = np.radians(self.heading_deg + np.linspace(-85.0, 85.0, 1701))
        far = np.stack([np.sin(heading), np.cos(heading), np.zeros_like(heading)], axis=-1)
        far = (far if turn is None else far @ turn.T) @ self.rotation.T
        x_u, y_u = far[:, 0] / far[:, 2], far[:, 1] / far[:, 2]
        r2 = x_u**2 + y_u**2
        seen = (far[:, 2] > 1e-6) & (np.sqrt(r2) < self._fold_radius)
        factor = self.focal_length_px * (1.0 + self.k1 * r2 + self.k2 * r2**2)
        columns = 0.5 * self.image_size_px[0] + (factor * x_u)[seen]
        rows = 0.5 * self.image_size_px[1] + (factor * y_u)[seen]
        return np.asarray(
            np.interp(np.asarray(x_px, dtype=float), columns, rows, left=np.nan, right=np.nan)
        )

    def horizon_line_px(self, turn: FloatArray | None = None) -> FloatArray:
        """(2,) rows at the left and right edge of the line that fits the horizon best.

        Args:
            turn: (3, 3), of the hull that the camera stands on.
        """
        width = self.image_size_px[0]
        x = (np.arange(64) + 0.5) * width / 64
        y = self.horizon_px(x, turn)
        seen = np.isfinite(y)
        if seen.sum() < 2:
            return np.full(2, np.nan)
        slope, start = np.polyfit(x[seen], y[seen], 1)
        return np.array([start, start + slope * width])

    @property
    def field_of_view_deg(self) -> float:
        """Horizontal angle that the image spans through its centre."""
        width, height = self.image_size_px
        left, right = self.directions([[0.0, 0.5 * height], [float(width), 0.5 * height]])
        return float(np.degrees(np.arccos(np.clip(left @ right, -1.0, 1.0))))

    @property
    def nearest_water_m(self) -> float:
        """Range of the water at the middle of the lower edge of the image."""
        width, height = self.image_size_px
        return float(np.hypot(*self.on_water([0.5 * width, float(height)])))
