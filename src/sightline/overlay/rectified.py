"""A picture laid onto the map: each place on the water gets the colour of its pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.geodesy import LocalPlane
from sightline.overlay.water_view import WaterView
from sightline.types import BoolArray, FloatArray

LARGEST_ROW_SHARE = 0.1
"""A row of the picture may stand for so much of the range; beyond, all would be one smear."""

_WEBP_QUALITY = 82
_LONGEST_SIDE_PX = 800
_NEAREST_M, _FURTHEST_M = 0.5, 20_000.0
_RANGES, _BEARINGS = 120, 1441


@dataclass(frozen=True, eq=False)
class Rectifier:
    """Lays the pictures of a view onto the map, as far as their rows tell ranges apart.

    The map is that of Web Mercator, on which tiles are: a picture with these corners lies on it
    without being bent.

    Attributes:
        furthest_m: How far from the camera it reaches.
        corners_deg: (4, 2) float64, latitude and longitude of its upper left, upper right, lower
            right and lower left corner.
        columns_px: (H, W) float32, at each place the column of the picture; NaN where it shows
            none: outside of it, beyond `furthest_m`, above the horizon.
        rows_px: (H, W) float32, the row likewise.
    """

    furthest_m: float
    corners_deg: FloatArray
    columns_px: NDArray[np.float32]
    rows_px: NDArray[np.float32]
    shown: BoolArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "shown", np.isfinite(self.columns_px))

    @classmethod
    def of(
        cls,
        view: WaterView,
        plane: LocalPlane,
        *,
        largest_row_share: float = LARGEST_ROW_SHARE,
        reach_m: float = np.inf,
    ) -> Rectifier:
        """Prepare to lay the pictures of a view onto the map.

        Args:
            view: The water as the camera sees it.
            plane: Of the camera's place.
            largest_row_share: See `LARGEST_ROW_SHARE`.
            reach_m: It reaches no further than this, where houses stand behind.

        Raises:
            InputError: The camera sees no water near enough.
        """
        furthest_m = min(resolved_m(view, largest_row_share), reach_m)
        place = np.array([view.camera.east_m, view.camera.north_m])
        around = _polar(place, furthest_m)
        seen = _inside(view, view.pixels(around))
        if not seen.any():
            raise InputError("the camera sees no water that its rows could tell ranges on")
        x, y = _to_mercator(*plane.to_geographic(*around[seen].T))
        left, right, lower, upper = x.min(), x.max(), y.min(), y.max()
        step = max(right - left, upper - lower) / _LONGEST_SIDE_PX
        width = max(int(np.ceil((right - left) / step)), 1)
        height = max(int(np.ceil((upper - lower) / step)), 1)
        right, lower = left + width * step, upper - height * step
        grid_x, grid_y = np.meshgrid(
            left + step * (np.arange(width) + 0.5), upper - step * (np.arange(height) + 0.5)
        )
        places = np.stack(plane.to_plane(*_from_mercator(grid_x.ravel(), grid_y.ravel())), axis=1)
        pixels = view.pixels(places)
        shown = _inside(view, pixels) & (np.hypot(*(places - place).T) <= furthest_m)
        pixels[~shown] = np.nan
        corners = _from_mercator(
            np.array([left, right, right, left]), np.array([upper, upper, lower, lower])
        )
        return cls(
            furthest_m,
            np.stack(corners, axis=1),
            pixels[:, 0].reshape(height, width).astype(np.float32),
            pixels[:, 1].reshape(height, width).astype(np.float32),
        )

    def about(self) -> dict[str, object]:
        """Where its pictures lie, as pages ask for it."""
        return {"corners_deg": self.corners_deg.tolist(), "furthest_m": self.furthest_m}

    def rectified(self, image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture on the map, (H, W, 4) blue, green, red and opacity: 0 where nothing is shown.

        Args:
            image_bgr: (h, w, 3), of the camera.
        """
        # Pixels are counted from their edges, and by OpenCV from their middles.
        columns, rows = (
            np.nan_to_num(one - 0.5, nan=-1e4) for one in (self.columns_px, self.rows_px)
        )
        warped = cv2.remap(
            image_bgr, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        opacity = np.where(self.shown, 255, 0).astype(np.uint8)
        warped[~self.shown] = 0
        return np.asarray(np.dstack([warped, opacity]))


def webp(picture: NDArray[np.uint8]) -> bytes:
    """A picture of three or four channels as WebP, which keeps opacities and is small."""
    options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY]
    return cv2.imencode(".webp", picture, options)[1].tobytes()


def resolved_m(view: WaterView, largest_row_share: float = LARGEST_ROW_SHARE) -> float:
    """How far rows of the picture tell ranges apart, straight ahead of the camera.

    Of a camera at a height ``h`` with a focal length of ``f`` pixels one row stands for
    ``r² / (h f)`` at a range ``r``, so that it is a share ``s`` of that at ``r = s h f``.

    Args:
        view: The water as the camera sees it.
        largest_row_share: See `LARGEST_ROW_SHARE`.

    Raises:
        InputError: It sees no water.
    """
    ranges = np.geomspace(_NEAREST_M, _FURTHEST_M, 40 * _RANGES)
    heading = np.radians(view.camera.heading_deg)
    offset = ranges[:, None] * np.array([np.sin(heading), np.cos(heading)])
    rows = view.pixels(offset + np.array([view.camera.east_m, view.camera.north_m]))[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        row_m = np.diff(ranges) / -np.diff(rows)
    # Beyond the horizon of a bent earth rows would go down again.
    good = (row_m > 0.0) & (row_m <= largest_row_share * ranges[1:])
    if not good.any():
        raise InputError("the camera sees no water that its rows could tell ranges on")
    return float(ranges[1:][good].max())


def _polar(place: FloatArray, furthest_m: float) -> FloatArray:
    """(N, 2) places around a camera, dense enough that none of its corners is missed by much."""
    ranges = np.geomspace(_NEAREST_M, furthest_m, _RANGES)
    bearings = np.linspace(0.0, 2.0 * np.pi, _BEARINGS)
    range_m, bearing = (one.ravel() for one in np.meshgrid(ranges, bearings))
    away = np.stack([range_m * np.sin(bearing), range_m * np.cos(bearing)], axis=1)
    return np.asarray(place + away)


def _inside(view: WaterView, pixels_px: FloatArray) -> BoolArray:
    width, height = view.camera.image_size_px
    x, y = pixels_px.T
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0.0) & (x <= width) & (y >= 0.0) & (y <= height))


def _to_mercator(
    latitude_deg: FloatArray, longitude_deg: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Web Mercator on a sphere of radius 1."""
    return np.radians(longitude_deg), np.arctanh(np.sin(np.radians(latitude_deg)))


def _from_mercator(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Latitude and longitude, degrees."""
    return np.degrees(np.arcsin(np.tanh(y))), np.degrees(x)
