"""Correspondences: boxes with the known place of their target, to fit and evaluate models."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sightline.geodesy import LocalPlane
from sightline.types import BoolArray, Boxes, FloatArray, IntArray, Rows, StrArray

CERTAIN_M = 2.0
CERTAIN_SHARE = 0.02
"""A place in a gap of a log teaches where it is as certain as this, in metres or as a share of the
distance: no worse than the error of a log, which there is anyway. Further from a fix a place says
little, and what a vessel does between two fixes, few fixes do not tell."""

MOST = 0.5
"""With a larger share of the boxes between near fixes, these alone are certain."""

ALMOST_ALL = 0.9
"""With a larger share of certain boxes, the others, in gaps of the log, are not asked."""

FEWEST_CERTAIN = 30
"""Where there are fewer, the most certain of all teach."""


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Boxes with the place of their target at their time, one row a box.

    Attributes:
        boxes: (N,) the boxes.
        recording: (N,) str, the name of each box's recording.
        east_north_m: (N, 2) float64, metres in ``plane``.
        velocity_mps: (N, 2) float64, east and north.
        asked: How many boxes there were; those without a fix on either side do not count.
        plane: Where the origin lies.
        vessel: (N,) str, whose box it is, where a recording has several. Absent: one.
        water_level_m: (N,) float64, how high the water stood above the datum. Absent: at it.
        bias_only: (N,) bool, whether a box is of a source that is only to have its biases learned,
            beside those of whoever drew. Absent: none is.
        fix_sigma_m: (N,) float64, standard deviation of the place along either axis that a gap of
            the log makes; 0 where the fixes are near. Absent: everywhere.
        fix_time_utc_s: (N, 2) float64, times of the fixes on either side, by the log's clock; NaN
            where nobody says. Absent: nowhere.
        hull_m: (N, 2) float64, length and beam of each target where they are stated, else NaN.
            Absent: nowhere.
        at_middle: (N,) bool, whether each place is that of the middle of the hull. Absent: of a
            receiver somewhere on it.
        of_tracks: Whether the places are those of tracks of other cameras, which are unsure
            everywhere, rather than of a log.
    """

    boxes: Boxes
    recording: StrArray
    east_north_m: FloatArray
    velocity_mps: FloatArray
    asked: int
    plane: LocalPlane
    vessel: StrArray = field(default_factory=lambda: np.empty(0, dtype=np.str_))
    water_level_m: FloatArray = field(default_factory=lambda: np.empty(0))
    bias_only: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    fix_sigma_m: FloatArray = field(default_factory=lambda: np.empty(0))
    fix_time_utc_s: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    hull_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    at_middle: BoolArray = field(default_factory=lambda: np.empty(0, dtype=np.bool_))
    of_tracks: bool = False

    def __post_init__(self) -> None:
        if self.vessel.size == 0:
            object.__setattr__(self, "vessel", np.full(len(self.boxes), ""))
        if self.water_level_m.size == 0:
            object.__setattr__(self, "water_level_m", np.zeros(len(self.boxes)))
        if self.bias_only.size == 0:
            object.__setattr__(self, "bias_only", np.zeros(len(self.boxes), dtype=np.bool_))
        if self.fix_sigma_m.size == 0:
            object.__setattr__(self, "fix_sigma_m", np.zeros(len(self.boxes)))
        if self.fix_time_utc_s.size == 0:
            object.__setattr__(self, "fix_time_utc_s", np.full((len(self.boxes), 2), np.nan))
        if self.hull_m.size == 0:
            object.__setattr__(self, "hull_m", np.full((len(self.boxes), 2), np.nan))
        if self.at_middle.size == 0:
            object.__setattr__(self, "at_middle", np.zeros(len(self.boxes), dtype=np.bool_))

    def __len__(self) -> int:
        return len(self.boxes)

    def in_plane(self, plane: LocalPlane) -> Self:
        """The same places in the plane of another origin; velocities stay as they are.

        Args:
            plane: Not so far away that its north points elsewhere.
        """
        latitude, longitude = self.plane.to_geographic(*self.east_north_m.T)
        return replace(
            self,
            east_north_m=np.stack(plane.to_plane(latitude, longitude), axis=1),
            plane=plane,
        )

    def certain_rows(self) -> IntArray:
        """(K,) rows whose places are certain enough to learn from; see `CERTAIN_M`.

        Distances are from the origin, which is where a camera of known place stands. Where most
        boxes are between near fixes, these are all.
        """
        near = self.fix_sigma_m == 0.0
        if not near.size or near.mean() > MOST:
            return np.flatnonzero(near)
        limit_m = np.maximum(CERTAIN_M, CERTAIN_SHARE * np.hypot(*self.east_north_m.T))
        relative = self.fix_sigma_m / limit_m
        kept = relative <= 1.0
        if kept.sum() < FEWEST_CERTAIN:
            kept[np.argsort(relative, kind="stable")[:FEWEST_CERTAIN]] = True
        return np.flatnonzero(kept)

    def certain(self) -> Self:
        """Those whose places are certain enough to learn from; see `CERTAIN_M`."""
        rows = self.certain_rows()
        return self if rows.size == len(self) else self[rows]

    def __getitem__(self, rows: Rows) -> Self:
        return replace(
            self,
            boxes=self.boxes[rows],
            recording=self.recording[rows],
            east_north_m=self.east_north_m[rows],
            velocity_mps=self.velocity_mps[rows],
            vessel=self.vessel[rows],
            water_level_m=self.water_level_m[rows],
            bias_only=self.bias_only[rows],
            fix_sigma_m=self.fix_sigma_m[rows],
            fix_time_utc_s=self.fix_time_utc_s[rows],
            hull_m=self.hull_m[rows],
            at_middle=self.at_middle[rows],
        )
