"""Track observations of a recording: foot points of boxes, thinned to independent ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sightline.tracking import ImageTracker
from sightline.tracking.static_map import PASSED_BY, StaticMap
from sightline.types import NO_TRACK, BoolArray, Boxes, FloatArray, IntArray

BIN_S = 0.5
"""Boxes of one track within this time count as one: a detector's errors are correlated as long."""

SPLIT_S = 3.0
"""A track that was not seen for longer is taken apart; its ids may not be of the same thing."""

_FOLLOWABLE_S = 1.0


@dataclass(frozen=True, eq=False)
class TrackObservations:
    """Foot points of boxes, one row a track and half second.

    Attributes:
        time_utc_s: (N,) float64, increasing within a track.
        foot_px: (N, 2) float64, the median foot.
        size_px: (N, 2) float64, the median width and height.
        track: (N,) int64, the track of each.
        box: (N,) int64, the box nearest to the median, a row of ``boxes``.
        row_of_box: (M,) int64, the observation that each box is part of.
        boxes: (M,) the boxes.
        followed: Whether tracks are more than single boxes.
        interval_s: Time between moments at which anything is seen.
    """

    time_utc_s: FloatArray
    foot_px: FloatArray
    size_px: FloatArray
    track: IntArray
    box: IntArray
    row_of_box: IntArray
    boxes: Boxes
    followed: bool
    interval_s: float

    def __len__(self) -> int:
        return int(self.time_utc_s.size)


def observe(boxes: Boxes, *, moving_only: bool = False) -> TrackObservations:
    """Thin the boxes of a recording to observations.

    Boxes without track ids are followed in the image where they come often enough; where they do
    not, each stands alone.

    Args:
        boxes: (M,) of anything, with times.
        moving_only: Whether to leave out what stays in its place.
    """
    boxes = boxes[np.argsort(boxes.time_utc_s, kind="stable")]
    moments = np.unique(boxes.time_utc_s)
    interval_s = float(np.median(np.diff(moments))) if moments.size > 1 else np.inf
    followed = bool(interval_s <= _FOLLOWABLE_S)
    if followed and (boxes.track_id == NO_TRACK).all():
        boxes = _followed(boxes)
    if moving_only:
        boxes = boxes[~_staying(boxes, followed)]
    track = _tracks(boxes) if followed else np.arange(len(boxes))
    cell = np.floor((boxes.time_utc_s - boxes.time_utc_s.min(initial=np.inf)) / BIN_S)
    if not len(boxes):
        cell = np.empty(0)
    keys = np.stack([track, cell.astype(np.int64)], axis=1)
    kept, row_of_box = np.unique(keys, axis=0, return_inverse=True)
    row_of_box = row_of_box.reshape(-1)
    xyxy = boxes.xyxy_px
    foot = np.stack([0.5 * (xyxy[:, 0] + xyxy[:, 2]), xyxy[:, 3]], axis=1)
    size = xyxy[:, 2:] - xyxy[:, :2]
    n = len(kept)
    time_s, middle, extent = np.empty(n), np.empty((n, 2)), np.empty((n, 2))
    box = np.empty(n, dtype=np.int64)
    order = np.argsort(row_of_box, kind="stable")
    for i, rows in enumerate(np.split(order, np.flatnonzero(np.diff(row_of_box[order])) + 1)):
        if not rows.size:
            continue
        middle[i] = np.median(foot[rows], axis=0)
        extent[i] = np.median(size[rows], axis=0)
        off = np.abs(foot[rows] - middle[i]).sum(axis=1) + np.abs(size[rows] - extent[i]).sum(
            axis=1
        )
        box[i] = rows[np.argmin(off)]
        time_s[i] = np.mean(boxes.time_utc_s[rows])
    return TrackObservations(
        time_utc_s=time_s,
        foot_px=middle,
        size_px=extent,
        track=kept[:, 0].astype(np.int64),
        box=box,
        row_of_box=row_of_box.astype(np.int64),
        boxes=boxes,
        followed=followed,
        interval_s=max(interval_s, BIN_S),
    )


def _followed(boxes: Boxes) -> Boxes:
    """Boxes with the track ids that a tracker assigns; those of no track are left out."""
    tracker = ImageTracker()
    cuts = np.flatnonzero(np.diff(boxes.time_utc_s) > 0.0) + 1
    parts = np.split(np.arange(len(boxes)), cuts)
    return Boxes.concatenate([tracker.update(boxes[rows]) for rows in parts if rows.size])


def _staying(boxes: Boxes, followed: bool) -> BoolArray:
    """(M,) whether each box is of something that stays in its place."""
    learned = StaticMap()
    learned.update(boxes)
    learned.finish()
    alone: BoolArray = np.asarray(learned.at(boxes) != PASSED_BY)
    if not followed:
        return alone
    out = np.zeros(len(boxes), dtype=bool)
    for key in np.unique(boxes.track_id):
        rows = np.flatnonzero(boxes.track_id == key)
        out[rows] = alone[rows] if key == NO_TRACK else learned.staying(boxes[rows])
    return out


def _tracks(boxes: Boxes) -> IntArray:
    """(M,) track numbers: as the boxes have them, split where a track was not seen for long."""
    out = np.full(len(boxes), -1, dtype=np.int64)
    count = 0
    for key in np.unique(boxes.track_id):
        rows = np.flatnonzero(boxes.track_id == key)
        if key == NO_TRACK:
            out[rows] = count + np.arange(rows.size)
            count += rows.size
            continue
        part = np.cumsum(
            np.diff(boxes.time_utc_s[rows], prepend=boxes.time_utc_s[rows[0]]) > SPLIT_S
        )
        out[rows] = count + part
        count += int(part[-1]) + 1
    return out
