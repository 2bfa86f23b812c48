"""Boxes stabilised by the horizon, of a camera that rolls and pitches.

The horizon shows the pitch and roll of the camera in each frame. The two points where it leaves the
image span, with the lens, a plane whose normal points up; the least rotation that brings this
direction to where it is in the reference also brings every ray to where it would have been. So a
box is moved as its foot is. Rotations about the vertical do not show in the horizon: those are the
heading's.
"""

from __future__ import annotations

import numpy as np

from sightline.camera.pinhole import Camera
from sightline.camera.priors import CameraPrior
from sightline.types import BoolArray, FloatArray, Horizons

LONGEST_S = 0.5
"""Between horizons further apart than this nothing is assumed: swell has periods of seconds."""
_ON_CURVE = 0.5 + np.array([-0.5, 0.5]) / np.sqrt(3.0)
"""Where along the image the straight line through a bent horizon meets it.

A lens bends the horizon nearly to a parabola, and the best line crosses one at the two points of
Gauss's quadrature.
"""


def stabilise(
    xyxy_px: FloatArray,
    horizon_px: FloatArray,
    reference_px: tuple[float, float],
    camera: Camera,
) -> tuple[FloatArray, BoolArray]:
    """Stabilise boxes by rotating their horizon to the reference horizon.

    Args:
        xyxy_px: (N, 4) boxes.
        horizon_px: (N, 2) rows of the horizon at the left and the right edge in the frame of each
            box; NaN where it was not seen.
        reference_px: The same rows in the reference.
        camera: Its lens; `nominal_camera` where it is not known yet.

    Returns:
        (N, 4) the boxes moved, NaN where the attitude is not known; and (N,) whether it is.
    """
    foot = np.stack([xyxy_px[:, [0, 2]].mean(axis=1), xyxy_px[:, 3]], axis=1)
    known = np.isfinite(horizon_px).all(axis=1)
    moved = np.full_like(foot, np.nan)
    if known.any():
        up = _up(camera, horizon_px[known])
        there = np.broadcast_to(_up(camera, np.array([reference_px])), up.shape)
        moved[known] = camera.pixels(_rotated(camera.rays(foot[known]), up, there))
    return xyxy_px + np.tile(moved - foot, 2), np.isfinite(moved).all(axis=1)


def nominal_camera(image_size_px: tuple[int, int]) -> Camera:
    """A nominal camera without distortion, before anything is known of the lens."""
    prior = CameraPrior()
    return Camera(
        height_m=prior.height_m,
        pitch_deg=0.0,
        roll_deg=0.0,
        heading_deg=0.0,
        focal_px=prior.focal_widths * image_size_px[0],
        k1=0.0,
        k2=0.0,
        east_m=0.0,
        north_m=0.0,
        image_size_px=image_size_px,
    )


def horizons_at(horizons: Horizons, time_utc_s: FloatArray) -> FloatArray:
    """(N, 2) rows of the horizon, interpolated in time; NaN between horizons too far apart.

    Args:
        horizons: Of a recording.
        time_utc_s: (N,) POSIX seconds.
    """
    n = len(horizons)
    if n == 0:
        return np.full((time_utc_s.size, 2), np.nan)
    log_s = horizons.time_utc_s
    rows = np.stack(
        [
            np.interp(time_utc_s, log_s, column, left=np.nan, right=np.nan)
            for column in (horizons.left_y_px, horizons.right_y_px)
        ],
        axis=1,
    )
    after = np.clip(np.searchsorted(log_s, time_utc_s), 0, n - 1)
    before = np.maximum(after - 1, 0)
    near = (log_s[after] - log_s[before] <= LONGEST_S) | (log_s[after] == time_utc_s)
    return np.where(near[:, None], rows, np.nan)


def _up(camera: Camera, lines_px: FloatArray) -> FloatArray:
    """(N, 3) vertical unit vectors in the camera's axes, from rows (N, 2) of the horizon."""
    rows = lines_px[:, :1] + (lines_px[:, 1:] - lines_px[:, :1]) * _ON_CURVE
    left, right = (
        camera.rays(np.stack([np.full(len(rows), share * camera.image_size_px[0]), row], axis=1))
        for share, row in zip(_ON_CURVE, rows.T, strict=True)
    )
    up = np.cross(right, left)
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _rotated(rays: FloatArray, start: FloatArray, end: FloatArray) -> FloatArray:
    """Rays (N, 3) under the least rotation that takes unit vectors to others (Rodrigues)."""
    axis = np.cross(start, end)
    cosine = np.einsum("ni,ni->n", start, end)[:, None]
    once = np.cross(axis, rays)
    return np.asarray(rays + once + np.cross(axis, once) / (1.0 + cosine))
