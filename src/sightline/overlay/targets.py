"""Where each target was at the time of a frame, and which box is whose."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from sightline.types import NO_FRAME, BoolArray, Boxes, FloatArray, PointKind, Track

# Files of tracks keep milliseconds.
_TOLERANCE_S = 0.002
_SLACK_PX = 6.0
_FAR = 1e6


@dataclass(frozen=True, eq=False)
class Target:
    """One target at one time.

    Attributes:
        track: Its track.
        index: Of that among all.
        east_north_m: (2,) place in the plane.
        covariance_m2: (2, 2); NaN where the track tells none.
        speed_mps: Over ground.
        measured: Whether something of it was seen then, or just before and after.
    """

    track: Track
    index: int
    east_north_m: FloatArray
    covariance_m2: FloatArray
    speed_mps: float
    measured: bool


class Targets:
    """The tracks of a video, asked for their places at the times of its frames."""

    def __init__(self, tracks: Iterable[Track]) -> None:
        """Take tracks in the plane of the model; those without a point are left out."""
        self.tracks = [track for track in tracks if len(track)]
        self._starts = np.array([track.time_utc_s[0] for track in self.tracks])
        self._ends = np.array([track.time_utc_s[-1] for track in self.tracks])

    def at(self, time_utc_s: float) -> list[Target]:
        """Those that have a place at a time, in the order of their tracks."""
        alive = (self._starts - _TOLERANCE_S <= time_utc_s) & (
            time_utc_s <= self._ends + _TOLERANCE_S
        )
        return [self._target(int(i), time_utc_s) for i in np.flatnonzero(alive)]

    def _target(self, index: int, time_utc_s: float) -> Target:
        track = self.tracks[index]
        times = track.time_utc_s
        right = int(np.clip(np.searchsorted(times, time_utc_s), 0, len(track) - 1))
        left = max(right - 1, 0)
        span = float(times[right] - times[left])
        u = float(np.clip((time_utc_s - times[left]) / span, 0.0, 1.0)) if span > 0.0 else 1.0
        places = np.stack([track.east_m[[left, right]], track.north_m[[left, right]]], axis=1)
        ends_mps = np.stack(
            [track.velocity_east_mps[[left, right]], track.velocity_north_mps[[left, right]]],
            axis=1,
        )
        # The cubic of Hermite: a target that turns stays on its way between two points.
        chord = places[1] - places[0]
        bend, twist = ends_mps[0] * span - chord, chord - ends_mps[1] * span
        place = places[0] + u * chord + u * (1.0 - u) * ((1.0 - u) * bend + u * twist)
        covariance = (1.0 - u) * track.covariance_m2[left] + u * track.covariance_m2[right]
        kinds = {int(track.kind[right]), int(track.kind[left] if u < 1.0 else track.kind[right])}
        return Target(
            track=track,
            index=index,
            east_north_m=place,
            covariance_m2=covariance
            if 0.0 < u < 1.0
            else track.covariance_m2[left if u == 0.0 else right],
            speed_mps=float((1.0 - u) * track.speed_mps[left] + u * track.speed_mps[right]),
            measured=int(PointKind.EXTRAPOLATED) not in kinds,
        )


class BoxBook:
    """Boxes by the frame that they are in, or by their time where they name no frame."""

    def __init__(self, boxes: Boxes) -> None:
        """Take boxes in any order."""
        named = boxes.frame != NO_FRAME
        self._by_frame = boxes[named][np.argsort(boxes.frame[named], kind="stable")]
        timed = boxes[~named & np.isfinite(boxes.time_utc_s)]
        self._by_time = timed[np.argsort(timed.time_utc_s, kind="stable")]

    def at(self, frame: int, time_utc_s: float) -> Boxes:
        """Boxes of a frame."""
        first, last = np.searchsorted(self._by_frame.frame, [frame, frame + 1])
        if last > first or not len(self._by_time):
            return self._by_frame[first:last]
        around = [time_utc_s - _TOLERANCE_S, time_utc_s + _TOLERANCE_S]
        first, last = np.searchsorted(self._by_time.time_utc_s, around)
        return self._by_time[first:last]


def box_of_each(
    feet_px: FloatArray, boxes: Boxes, numbers: Sequence[int], scale: float
) -> tuple[list[int | None], BoolArray]:
    """The box of each target, by where its place lies in the picture.

    The place of a target on the water lies next to the middle of its box's lower edge. Each box is
    of one target at most, and all together are as near as they can be.

    Args:
        feet_px: (N, 2) pixels of the targets' places; NaN where they are not seen.
        boxes: Of one frame.
        numbers: N numbers of the tracks: of boxes as near, that with this track id is taken.
        scale: Of the picture, 1 where it has 720 rows.

    Returns:
        N rows of boxes, None where there is none; and for each box whether it is nobody's.
    """
    n, m = len(feet_px), len(boxes)
    rows: list[int | None] = [None] * n
    free = np.ones(m, dtype=bool)
    if not (n and m):
        return rows, free
    x1, y1, x2, y2 = boxes.xyxy_px.T
    slack = _SLACK_PX * scale
    aside = (feet_px[:, None, 0] - 0.5 * (x1 + x2)) / (0.5 * (x2 - x1) + slack)
    above = (feet_px[:, None, 1] - y2) / (0.5 * (y2 - y1) + slack)
    apart = np.hypot(aside, above)
    same = np.asarray(numbers)[:, None] == boxes.track_id
    cost = np.where(apart < 1.0, apart - 1e-3 * same, _FAR)
    for i, j in zip(*linear_sum_assignment(np.where(np.isfinite(cost), cost, _FAR)), strict=True):
        if cost[i, j] < _FAR:
            rows[int(i)] = int(j)
            free[j] = False
    return rows, free
