"""Point correspondences: foot points, control points and landmarks with known places."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from sightline.errors import FitError
from sightline.types import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Pixels of known place: control points, and landmarks along the shore or at the horizon.

    What is far away may lie anywhere on hundreds of metres, and still tells the row of the horizon.

    Attributes:
        pixel_px: (M, 2) float64, x and y.
        east_north_m: (M, 2) float64, metres in the plane.
        sigma_m: (M,) float64, standard deviation of each, in every direction.
    """

    pixel_px: FloatArray
    east_north_m: FloatArray
    sigma_m: FloatArray

    @classmethod
    def none(cls) -> Landmarks:
        """No landmarks."""
        return cls(np.empty((0, 2)), np.empty((0, 2)), np.empty(0))

    def __len__(self) -> int:
        return int(self.sigma_m.size)


NO_SOURCE = -1
"""The source of a control point, whose pixel has no bias."""

UNDER_WAY_MPS = 0.5
"""Speed below which a target's course says little about where its bow points."""


@dataclass(frozen=True, eq=False)
class PointCorrespondences:
    """Pixels of known place on the earth: foot points of boxes, and control points.

    Attributes:
        pixel_px: (N, 2) float64, x and y.
        east_m: (N,) float64.
        north_m: (N,) float64.
        source: (N,) int64, index of the source, `NO_SOURCE` for a control point.
        group: (N,) int64, index of the recording; errors within one are alike.
        velocity_mps: (N, 2) float64, east and north, of the target; zero where it stands still or
            is not known.
        sigma_m: (N,) float64, standard deviation of the place: of a control point from a map, of a
            box by the gap of its log, which comes on top of the noise that is estimated.
        time_s: (N,) float64, seconds, from which it is told which errors of the log are alike; NaN
            where there is no log, or no time is known. Absent: nowhere.
        width_px: (N,) float64, of the boxes; NaN where there is none. Absent: nowhere.
        above_m: (N,) float64, how high the water stood there above the plane that the camera's
            height is over. Absent: at it.
        log: (N,) int64, index of the log that tells the place, one for each vessel of a recording:
            its correlated error is its own. Absent: one for each recording.
        gap_s: (N, 2) float64, times of the fixes on either side: what ``sigma_m`` says of boxes is
            alike within a gap. NaN where not known. Absent: nowhere.
        hull_m: (N, 2) float64, length and beam of the target where somebody states them, else NaN.
            Absent: nowhere.
        at_middle: (N,) bool, whether the place is that of the middle of the hull, not of a receiver
            somewhere on it. Absent: nowhere.
    """

    pixel_px: FloatArray
    east_m: FloatArray
    north_m: FloatArray
    source: IntArray
    group: IntArray
    velocity_mps: FloatArray
    sigma_m: FloatArray
    time_s: FloatArray = field(default_factory=lambda: np.empty(0))
    width_px: FloatArray = field(default_factory=lambda: np.empty(0))
    above_m: FloatArray = field(default_factory=lambda: np.empty(0))
    log: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    gap_s: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    hull_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    at_middle: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))

    def __post_init__(self) -> None:
        if self.above_m.size == 0:
            object.__setattr__(self, "above_m", np.zeros(self.east_m.size))
        if self.log.size == 0:
            object.__setattr__(self, "log", self.group)
        if self.gap_s.size == 0:
            object.__setattr__(self, "gap_s", np.full((self.east_m.size, 2), np.nan))
        if self.hull_m.size == 0:
            object.__setattr__(self, "hull_m", np.full((self.east_m.size, 2), np.nan))
        if self.at_middle.size == 0:
            object.__setattr__(self, "at_middle", np.zeros(self.east_m.size, dtype=np.bool_))
        for name in ("time_s", "width_px"):
            if getattr(self, name).size == 0:
                object.__setattr__(self, name, np.full(self.east_m.size, np.nan))

    def __len__(self) -> int:
        return int(self.east_m.size)

    def __getitem__(self, rows: IntArray) -> PointCorrespondences:
        return PointCorrespondences(*(getattr(self, column.name)[rows] for column in fields(self)))


def _check_enough(sightings: PointCorrespondences) -> None:
    if len(sightings) < 3:
        raise FitError(
            f"{len(sightings)} pairs of a box and a fix; a camera needs at least 3, better 30 "
            "spread over the image"
        )
    spread_px = np.ptp(sightings.pixel_px, axis=0).max()
    spread_m = max(np.ptp(sightings.east_m), np.ptp(sightings.north_m))
    if spread_px < 1.0 or spread_m < 0.1:
        raise FitError(
            "all boxes or all fixes lie in one place; a camera cannot be learned from a target "
            "that does not move: add a recording in which it crosses the image"
        )
