"""What a camera has in view: where on the earth a vessel would be seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import Delaunay, QhullError

from sightline.area import Area
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.types import BoolArray, FloatArray
from sightline.video.mask import Mask

_BOAT_M, _LEAST_PX = 4.0, 8.0
_MARGIN = 0.02
_COLUMNS, _ROWS = 24, 24


class View:
    """Where a vessel would be seen by a camera that stands still.

    It is in the picture, not behind a mask, in the area, and so near that a boat 4 m high has
    8 px. Of a model without a camera it is where that places the pixels that it has learned from.
    """

    def __init__(
        self,
        model: Georeferencer,
        *,
        area: Area | None = None,
        mask: Mask | None = None,
        water_level_m: float | None = None,
    ) -> None:
        """Take what limits it.

        Args:
            model: Of the camera.
            area: Where targets can be; None: anywhere.
            mask: Where nothing is looked for.
            water_level_m: Where the model needs it.
        """
        self._model, self._area, self._mask = model, area, mask
        self._above_m = float(model.above_m(water_level_m))
        self._placed = None if model.camera is not None else self._learned(model)

    def holds(self, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> BoolArray:
        """(N,) bool, whether places are in view.

        Args:
            latitude_deg: (N,) degrees north.
            longitude_deg: (N,) degrees east.
        """
        latitude = np.atleast_1d(np.asarray(latitude_deg, dtype=np.float64))
        longitude = np.atleast_1d(np.asarray(longitude_deg, dtype=np.float64))
        place = np.column_stack(self._model.plane.to_plane(latitude, longitude))
        inside = self._in_picture(place)
        if self._area is not None:
            inside &= self._area.contains(latitude, longitude)
        return inside

    def _in_picture(self, place_m: FloatArray) -> BoolArray:
        camera = self._model.camera
        if camera is None:
            if self._placed is None:
                return np.zeros(len(place_m), dtype=bool)
            return np.asarray(self._placed.find_simplex(place_m) >= 0)
        pixel = camera.project(place_m[:, 0], place_m[:, 1], self._above_m)
        size = np.array(self._model.image_size_px, dtype=np.float64)
        low, high = _MARGIN * size, (1.0 - _MARGIN) * size
        with np.errstate(invalid="ignore"):
            inside = np.asarray(((pixel >= low) & (pixel <= high)).all(axis=1))
        off = place_m - [camera.east_m, camera.north_m]
        inside &= np.hypot(*off.T) <= camera.focal_px * _BOAT_M / _LEAST_PX
        if self._mask is not None:
            column, row = np.where(inside[:, None], pixel, 0.0).astype(np.int64).T
            inside &= ~self._mask.hidden[row, column]
        return inside

    @staticmethod
    def _learned(model: Georeferencer) -> Delaunay | None:
        width, height = model.image_size_px
        x, y = np.meshgrid(
            np.linspace(0.02, 0.98, _COLUMNS) * width, np.linspace(0.05, 1.0, _ROWS) * height
        )
        foot = np.column_stack([x.ravel(), y.ravel()])
        foot = foot[model.support.holds(foot)]
        if not len(foot):
            return None
        half = np.array([0.01 * width, 0.02 * height])
        boxes = np.column_stack([foot - half * [1.0, 2.0], foot + half * [1.0, 0.0]])
        found = model.locate(boxes)
        known = found.known & ~found.extrapolated
        try:
            return Delaunay(np.column_stack([found.east_m, found.north_m])[known])
        except (QhullError, ValueError):
            return None
