"""Which frames teach most, so that they are drawn first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import Expected
from sightline.labelling.expected_gain import Design
from sightline.labelling.logged_frames import LoggedFrames
from sightline.types import BoolArray, FloatArray, IntArray

# Boxes nearer to each other than this share of the picture, or of the range, or of the time, say
# much the same, whatever a fit believes of its own form.
_APART_PICTURE, _APART_RANGE, _APART_TIME = 0.08, 0.25, 0.05
_TINY = 1e-9
_SHOWN_PX = 3.0
"""Lower boxes cannot be drawn."""


@dataclass(frozen=True, eq=False)
class Views:
    """Frames in which the log and a fitted camera show where the target is, one row a frame.

    Attributes:
        logged: Where it was.
        box_xyxy_px: (N, 4) float64, where it is expected.
        above_m: (N,) float64, the water above the plane that the camera's height is over.
    """

    logged: LoggedFrames
    box_xyxy_px: FloatArray
    above_m: FloatArray

    def __len__(self) -> int:
        return len(self.logged)

    def __getitem__(self, rows: IntArray | BoolArray) -> Views:
        return Views(self.logged[rows], self.box_xyxy_px[rows], self.above_m[rows])

    @property
    def foot_px(self) -> FloatArray:
        """(N, 2) middle of the lower edge of each box."""
        box = self.box_xyxy_px
        return np.stack([0.5 * (box[:, 0] + box[:, 2]), box[:, 3]], axis=1)


def in_picture(expected: Expected, image_size_px: tuple[int, int]) -> BoolArray:
    """(N,) bool, whether the target can be drawn: wholly in the picture, as far as one knows."""
    box, (width, height) = expected.xyxy_px, image_size_px
    # Of how far it may be off a part is kept, so that a camera that is not yet known shows at all.
    off = np.minimum(expected.sigma_px, 0.1 * np.array([width, height]))
    with np.errstate(invalid="ignore"):
        inside = (box[:, 0] >= 0.0) & (box[:, 2] <= width)
        inside &= (box[:, 3] > 0.0) & (box[:, 3] <= height) & (box[:, 1] >= -off[:, 1])
        return np.asarray(inside & (box[:, 3] - box[:, 1] >= _SHOWN_PX))


def by_information(
    design: Design,
    georeferencer: Georeferencer,
    views: Views,
    free: BoolArray,
    drawn: Views,
    count: int,
) -> IntArray:
    """Rows of the views that make the ellipses smallest where the log passes, best first.

    Greedy: each next one lowers the mean of the relative variances of the parameters' part most,
    given those before it. What lies near a box that is drawn or chosen counts less.

    Args:
        design: Of the fit.
        georeferencer: The fit.
        views: N frames.
        free: (N,) which may be chosen.
        drawn: Frames with boxes.
        count: At most so many.
    """
    if not len(views):
        return np.empty(0, dtype=np.int64)
    found = design.derivatives(views.logged, views.above_m)
    jacobian, noise = found.jacobian, design.noise_px2(views.logged, found)
    # A place moves against the pixel, as far as the parameters are off.
    moved = np.linalg.solve(found.by_place + _TINY * np.eye(2), jacobian)
    distance = np.hypot(*(views.logged.east_north_m - design.place_m).T)
    weight = 1.0 / np.square(np.maximum(distance, 1.0))
    aim = np.einsum("n,nij,nik->jk", weight, moved, moved)
    covariance = design.covariance.copy()
    near = _Nearness(views, distance, georeferencer.image_size_px)
    for row in range(len(drawn)):
        near.add(drawn.foot_px[row], drawn.logged.time_utc_s[row], np.nan)
    chosen: list[int] = []
    open_rows = free.copy()
    while open_rows.any() and len(chosen) < count:
        spread = jacobian @ covariance
        inner = np.einsum("nij,nkj->nik", spread, jacobian) + noise
        told = np.einsum("nij,jk,nlk->nil", spread, aim, spread)
        gain = np.trace(np.linalg.solve(inner, told), axis1=1, axis2=2)
        gain = np.where(open_rows, gain * near.novelty, -np.inf)
        best = int(np.argmax(gain))
        if not np.isfinite(gain[best]):
            break
        chosen.append(best)
        open_rows[best] = False
        covariance = covariance - spread[best].T @ np.linalg.solve(inner[best], spread[best])
        near.add(views.foot_px[best], views.logged.time_utc_s[best], distance[best])
    return np.array(chosen, dtype=np.int64)


class _Nearness:
    """How new each of N frames is beside those that are drawn or chosen."""

    def __init__(
        self, views: Views, distance_m: FloatArray, image_size_px: tuple[int, int]
    ) -> None:
        self.novelty = np.ones(len(views))
        self._foot, self._time = views.foot_px, views.logged.time_utc_s
        self._log_range = np.log(np.maximum(distance_m, 1.0))
        self._size = np.array(image_size_px, dtype=float)
        self._span_s = max(float(np.ptp(self._time)) if len(views) else 0.0, 1.0)

    def add(self, foot_px: FloatArray, time_utc_s: float, distance_m: float) -> None:
        """Count a box; its range is not a number where it is not known."""
        off = (self._foot - foot_px) / (self._size * _APART_PICTURE)
        square = np.sum(off**2, axis=1)
        if np.isfinite(distance_m):
            square += ((self._log_range - np.log(max(distance_m, 1.0))) / _APART_RANGE) ** 2
        square += ((self._time - time_utc_s) / (self._span_s * _APART_TIME)) ** 2
        self.novelty = np.minimum(self.novelty, 1.0 - 0.8 * np.exp(-0.5 * square))


def by_spread(
    logged: LoggedFrames, free: BoolArray, drawn_frames: IntArray, origin_known: bool, count: int
) -> IntArray:
    """Rows of frames as far apart as can be, in bearing and range where known, and in time.

    Nothing is known of the camera yet. Frames of which the log tells the place come first, those
    that lie nearer to a fix before others.

    Args:
        logged: N frames.
        free: (N,) which may be chosen.
        drawn_frames: (M,) frames with boxes, those of them that are among the N count.
        origin_known: Whether the camera stands at the origin of the plane.
        count: At most so many.
    """
    feature = _features(logged, origin_known)
    rows = np.isin(logged.frame, drawn_frames)
    apart = np.full(len(logged), np.inf)
    for row in np.flatnonzero(rows):
        apart = np.minimum(apart, np.linalg.norm(feature - feature[row], axis=1))
    candidates = free & logged.known
    if not candidates.any():
        candidates = free.copy()
    chosen: list[int] = []
    if not rows.any() and candidates.any():
        # The middle of all is a fair beginning.
        middle = np.median(feature[candidates], axis=0)
        first = np.linalg.norm(feature - middle, axis=1)
        chosen.append(int(np.argmin(np.where(candidates, first, np.inf))))
    while len(chosen) < count:
        if chosen:
            apart = np.minimum(apart, np.linalg.norm(feature - feature[chosen[-1]], axis=1))
            candidates[chosen[-1]] = False
        if not candidates.any():
            break
        chosen.append(int(np.argmax(np.where(candidates, apart, -np.inf))))
    return np.array(chosen[:count], dtype=np.int64)


def _features(logged: LoggedFrames, origin_known: bool) -> FloatArray:
    """(N, K) what frames differ in, each about one wide."""
    known = logged.known
    time = logged.time_utc_s
    order = np.arange(len(logged), dtype=float)
    time = np.where(np.isfinite(time), time, order)
    columns = [0.5 * _unit(time, np.isfinite(time))]
    if known.any():
        place = np.where(known[:, None], logged.east_north_m, 0.0)
        if origin_known:
            range_m = np.maximum(np.hypot(*place.T), 1.0)
            bearing = np.arctan2(place[:, 0], place[:, 1])
            # Unwrapped about the mean bearing, as north is no border.
            mean = np.arctan2(np.sin(bearing[known]).mean(), np.cos(bearing[known]).mean())
            turned = np.angle(np.exp(1j * (bearing - mean)))
            columns += [_unit(turned, known), _unit(np.log(range_m), known)]
        else:
            columns += [_unit(place[:, 0], known), _unit(place[:, 1], known)]
    return np.stack(columns, axis=1)


def _unit(values: FloatArray, known: BoolArray) -> FloatArray:
    low, high = np.min(values[known]), np.max(values[known])
    scaled = (values - low) / max(high - low, 1e-9)
    return np.where(known, scaled, 0.5)


def median_axis_m(axes_m: FloatArray) -> float:
    """The median of semi-axes; infinite where most places are not known at all."""
    return float(np.median(axes_m)) if axes_m.size else float("nan")
