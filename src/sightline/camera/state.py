"""Camera state of each box: rotation, horizon and water level.

The state travels with the boxes: what observes frames, what finds boxes in them and what places
these may each run ahead of the other by as many frames as it likes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.camera.rotation import CameraRotation
from sightline.camera.stabilisation import horizons_at
from sightline.types import Boxes, BoxesWith, Columns, FloatArray, Frame, Horizons
from sightline.water import WaterLevels


@dataclass(frozen=True, eq=False)
class CameraState(Columns):
    """Camera rotation, horizon and water level, one row a box.

    Attributes:
        horizon_px: (N, 2) float64, rows of the horizon at the left and the right edge of the image;
            NaN where it was not seen.
        rotation_rad: (N, 3) float64, rotation vector by which the static scene has turned about
            the camera's axes since the model's; zero where it lay as for the model, NaN where
            nobody knows how it lay.
        rotation_covariance_rad2: (N, 3, 3) float64.
        water_level_m: (N,) float64, above the datum; NaN where nobody says.
    """

    horizon_px: FloatArray
    rotation_rad: FloatArray
    rotation_covariance_rad2: FloatArray
    water_level_m: FloatArray

    _row_fields = ("horizon_px", "rotation_rad", "rotation_covariance_rad2", "water_level_m")
    _any_rows = True

    @classmethod
    def nominal(cls, n: int) -> CameraState:
        """State of N boxes without rotation, their horizon and water level unknown."""
        return cls(
            np.full((n, 2), np.nan), np.zeros((n, 3)), np.zeros((n, 3, 3)), np.full(n, np.nan)
        )

    def __len__(self) -> int:
        return int(self.water_level_m.size)


@dataclass(frozen=True, eq=False)
class ObservedBoxes(BoxesWith):
    """Boxes with the camera state at their times.

    Attributes:
        state: N rows.
    """

    state: CameraState

    _companion = "state"
    _stale_with = frozenset({"time_utc_s"})

    @classmethod
    def of_frame(cls, boxes: Boxes, frame: Frame) -> ObservedBoxes:
        """The boxes of a frame, with its horizon where it was detected."""
        state = CameraState.nominal(len(boxes))
        if frame.horizon_px is not None:
            state.horizon_px[:] = frame.horizon_px
        return cls.at(boxes, state)


@dataclass(frozen=True, eq=False)
class CameraHistory:
    """Camera rotation, horizon and water level over a recording.

    Attributes:
        rotation: Camera rotation against the model's camera; None: no rotation.
        horizons: Where the horizon lay, where a table tells.
        water: Water levels; None where the level is taken as constant.
    """

    rotation: CameraRotation | None = None
    horizons: Horizons | None = None
    water: WaterLevels | None = None

    def observed(self, boxes: Boxes) -> ObservedBoxes:
        """Boxes with the camera state at their times.

        Args:
            boxes: With their times; what they know of the horizon already is kept.

        Raises:
            InputError: The water levels say nothing of a time.
        """
        n = len(boxes)
        state = boxes.state if isinstance(boxes, ObservedBoxes) else CameraState.nominal(n)
        plain = boxes.boxes if isinstance(boxes, ObservedBoxes) else boxes
        horizon_px, rotation = state.horizon_px, state.rotation_rad
        covariance, level_m = state.rotation_covariance_rad2, state.water_level_m
        if self.horizons is not None:
            horizon_px = horizons_at(self.horizons, plain.time_utc_s)
        if self.rotation is not None:
            rotation, covariance = self.rotation.at(plain.time_utc_s)
        if self.water is not None:
            level_m = self.water.at(plain.time_utc_s)
        return ObservedBoxes.at(plain, CameraState(horizon_px, rotation, covariance, level_m))
