"""Observations of a camera model: correspondences and landmarks in one object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from sightline.camera.observations import NO_SOURCE, Landmarks, PointCorrespondences
from sightline.errors import FitError, InputError
from sightline.georeferencing.correspondences import Correspondences
from sightline.types import BoolArray, FloatArray, IntArray, StrArray, check_boxes

CONTROL_POINT_SIGMA_M = 0.1
"""How far off a control point may lie: read off an aerial picture, or surveyed."""


def _absent() -> NDArray[Any]:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class CameraObservations:
    """Boxes with the known place of their target, one row a box, and landmarks.

    Attributes:
        boxes_xyxy_px: (N, 4) float64.
        east_north_m: (N, 2) float64, where the target of each box was, metres.
        source: (N,) str, who made each box. Absent: one unnamed source.
        recording: (N,) the recording of each box, names or numbers. Absent: one.
        vessel: (N,) whose box it is, where there are several: each has a log. Absent: one.
        velocity_mps: (N, 2) float64 of the target, east and north; tells the clock offset.
            Absent: it stands still.
        time_s: (N,) float64 of each box, seconds; tells which errors of the log are alike. Absent
            or NaN: those of a recording are not.
        above_m: (N,) float64, how high the water stood at each box above the plane that the
            camera's height is over. Absent: at it.
        bias_only: (N,) bool, boxes of which the residual process learns nothing: what a detector
            makes of a boat differs from what people do, in size as in place, and its boxes are
            there to learn its lower edge by. Absent: it learns of all.
        fix_sigma_m: (N,) float64, standard deviation of each place that a gap of its log makes.
            Absent: none.
        gap_s: (N, 2) float64, times of the fixes on either side; what a gap makes of the places in
            it is alike. Absent or NaN: every place is in a gap of its own.
        hull_m: (N, 2) float64, length and beam of each target where they are stated, else NaN.
            Absent: nowhere.
        at_middle: (N,) bool, whether each place is that of the middle of the hull. Absent: of a
            receiver somewhere on it.
        landmarks: Control points and landmarks.
        clocks: By recording, mean and standard deviation of the seconds to be added to its clock;
            where they are others than the camera's prior says.

    Raises:
        FitError: A box, a place or a pixel is not a number.
        InputError: A box is none, or a column is not as long as there are boxes.
    """

    boxes_xyxy_px: FloatArray
    east_north_m: FloatArray
    source: StrArray = field(default_factory=_absent)
    recording: NDArray[Any] = field(default_factory=_absent)
    vessel: NDArray[Any] = field(default_factory=_absent)
    velocity_mps: FloatArray = field(default_factory=_absent)
    time_s: FloatArray = field(default_factory=_absent)
    above_m: FloatArray = field(default_factory=_absent)
    bias_only: BoolArray = field(default_factory=_absent)
    fix_sigma_m: FloatArray = field(default_factory=_absent)
    gap_s: FloatArray = field(default_factory=_absent)
    hull_m: FloatArray = field(default_factory=_absent)
    at_middle: BoolArray = field(default_factory=_absent)
    landmarks: Landmarks = field(default_factory=Landmarks.none)
    clocks: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        boxes = _table(self.boxes_xyxy_px, 4)
        check_boxes(boxes)
        n = len(boxes)
        columns = {
            "boxes_xyxy_px": boxes,
            "east_north_m": _table(self.east_north_m, 2),
            "source": _column(self.source, np.full(n, ""), np.str_),
            "recording": _column(self.recording, np.zeros(n), None),
            "vessel": _column(self.vessel, np.full(n, ""), np.str_),
            "velocity_mps": _table(self.velocity_mps, 2)
            if np.size(self.velocity_mps)
            else np.zeros((n, 2)),
            "time_s": _column(self.time_s, np.full(n, np.nan), np.float64),
            "above_m": _column(self.above_m, np.zeros(n), np.float64),
            "bias_only": _column(self.bias_only, np.zeros(n), np.bool_),
            "fix_sigma_m": _column(self.fix_sigma_m, np.zeros(n), np.float64),
            "gap_s": _column(self.gap_s, np.full((n, 2), np.nan), np.float64),
            "hull_m": _column(self.hull_m, np.full((n, 2), np.nan), np.float64),
            "at_middle": _column(self.at_middle, np.zeros(n), np.bool_),
        }
        for name, values in columns.items():
            if len(values) != n:
                raise InputError(
                    f"{n} boxes, but {name} has {len(values)} rows; each box needs one"
                )
            object.__setattr__(self, name, values)
        pixels, places = (
            _table(values, 2) for values in (self.landmarks.pixel_px, self.landmarks.east_north_m)
        )
        if not len(pixels) == len(places) == len(self.landmarks):
            raise InputError(
                f"{len(pixels)} pixels, {len(places)} places and {len(self.landmarks)} standard "
                "deviations of landmarks; each landmark needs one of each"
            )

    def __len__(self) -> int:
        return len(self.boxes_xyxy_px)

    @classmethod
    def of(
        cls,
        pairs: Correspondences,
        *,
        above_m: FloatArray | None = None,
        landmarks: Landmarks | None = None,
        clocks: Mapping[str, tuple[float, float]] | None = None,
    ) -> Self:
        """The observations from correspondences and landmarks.

        Args:
            pairs: Boxes and the places of their targets.
            above_m: (N,) how high the water stood above the plane of the camera's height; absent:
                at it.
            landmarks: Control points and landmarks; absent: none.
            clocks: See `CameraObservations`; absent: of none.
        """
        return cls(
            pairs.boxes.xyxy_px,
            pairs.east_north_m,
            source=pairs.boxes.source,
            recording=pairs.recording,
            vessel=pairs.vessel,
            velocity_mps=pairs.velocity_mps,
            time_s=pairs.boxes.time_utc_s,
            above_m=np.zeros(len(pairs)) if above_m is None else above_m,
            bias_only=pairs.bias_only,
            fix_sigma_m=pairs.fix_sigma_m,
            gap_s=pairs.fix_time_utc_s,
            hull_m=pairs.hull_m,
            at_middle=pairs.at_middle,
            landmarks=landmarks or Landmarks.none(),
            clocks=clocks or {},
        )

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources, sorted: the order of the fitted biases."""
        return tuple(str(name) for name in np.unique(self.source))

    @cached_property
    def group(self) -> IntArray:
        """(N,) index of each box's recording."""
        return _numbered(self.recording)

    @property
    def clocks_by_group(self) -> dict[int, tuple[float, float]]:
        """What is believed of clocks, by the index of the recording."""
        names = np.unique(self.recording).tolist()
        return {names.index(name): own for name, own in self.clocks.items() if name in names}

    @cached_property
    def log(self) -> IntArray:
        """(N,) index of the log of each box's place: one a vessel and recording."""
        vessel = _numbered(self.vessel)
        return _numbered(self.group * (int(vessel.max(initial=0)) + 1) + vessel)

    def sightings(self) -> PointCorrespondences:
        """Foot points of the boxes, then the landmarks, for the fit of a camera."""
        boxes, known, n, m = self.boxes_xyxy_px, self.landmarks, len(self), len(self.landmarks)
        foot = np.stack([0.5 * (boxes[:, 0] + boxes[:, 2]), boxes[:, 3]], axis=1)
        source = np.searchsorted(self.sources, self.source) if n else np.empty(0)
        # Points of a map are independent of one another: each is a group of its own.
        alone = np.arange(m)
        place = np.concatenate([self.east_north_m, known.east_north_m])
        return PointCorrespondences(
            pixel_px=np.concatenate([foot, known.pixel_px]),
            east_m=place[:, 0],
            north_m=place[:, 1],
            source=np.concatenate([source, np.full(m, NO_SOURCE)]).astype(np.int64),
            group=np.concatenate([self.group, int(self.group.max(initial=-1)) + 1 + alone]),
            velocity_mps=np.concatenate([self.velocity_mps, np.zeros((m, 2))]),
            sigma_m=np.concatenate([self.fix_sigma_m, known.sigma_m]),
            time_s=np.concatenate([self.time_s, np.full(m, np.nan)]),
            width_px=np.concatenate([boxes[:, 2] - boxes[:, 0], np.full(m, np.nan)]),
            above_m=np.concatenate([self.above_m, np.zeros(m)]),
            log=np.concatenate([self.log, int(self.log.max(initial=-1)) + 1 + alone]),
            gap_s=np.concatenate([self.gap_s, np.full((m, 2), np.nan)]),
            hull_m=np.concatenate([self.hull_m, np.full((m, 2), np.nan)]),
            at_middle=np.concatenate([self.at_middle, np.zeros(m, dtype=np.bool_)]),
        )


def _numbered(names: NDArray[Any]) -> IntArray:
    return np.unique(names, return_inverse=True)[1].astype(np.int64)


def _column(values: NDArray[Any], absent: NDArray[Any], dtype: DTypeLike | None) -> NDArray[Any]:
    return np.asarray(values if np.size(values) else absent, dtype=dtype)


def _table(values: ArrayLike, width: int) -> FloatArray:
    table = np.asarray(values, dtype=np.float64)
    if table.size == 0:
        return np.empty((0, width))
    if table.ndim != 2 or table.shape[1] != width:
        raise InputError(f"expected a table of the shape (N, {width}), got {table.shape}")
    if not np.isfinite(table).all():
        raise FitError("a box, a place or a pixel among the pairs is not a number")
    return table
