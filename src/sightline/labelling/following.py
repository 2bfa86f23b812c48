"""A drawn box followed to neighbouring frames, until it is unsure."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.detection import Detector
from sightline.labelling.expected import Expected
from sightline.labelling.proposals import propose_in
from sightline.labelling.snapping import Background
from sightline.overlap import iou
from sightline.types import FloatArray, Frame

Grey = NDArray[np.uint8]

LONGEST_STEP_S = 1.0
"""Frames that are further apart show a boat too differently to be followed."""

_MOST_POINTS, _FEWEST_POINTS, _GRID = 120, 6, 11
_LEAST_SHARE = 0.3
_WINDOW, _LEVELS = (15, 15), 3
# Points that do not come back to where they began, forward and backward, are lost.
_ASTRAY_PX, _ASTRAY_SHARE = 0.7, 0.02
_MOST_SCALE = 1.15
# Picture to picture the flow drifts; against the box that was drawn it does not.
_SEARCH_PX, _SEARCH_SHARE = 3.0, 0.12
_LEAST_ALIKE = 0.55
_LEAST_SHOWN_PX = 5.0
_MARGIN = 0.15
_OVERLAP = 0.3
_MOST_UNSEEN = 2
_FEWEST_HABITS = 3
# A step that is so many box sizes off what was expected is one to something else.
_MOST_ASIDE = 0.75


@dataclass(frozen=True, eq=False)
class Followed:
    """A box in a frame that it was followed to.

    Attributes:
        frame: The frame.
        xyxy_px: (4,) float64.
        confidence: 0 to 1.
    """

    frame: int
    xyxy_px: FloatArray
    confidence: float


class _Drawn:
    """What the drawn box shows, held against later frames at any size."""

    def __init__(self, image_bgr: Grey, box: FloatArray) -> None:
        self._box = box
        size = box[2:] - box[:2]
        low = np.maximum(np.floor(box[:2] - _MARGIN * size), 0).astype(int)
        high = np.ceil(box[2:] + _MARGIN * size).astype(int)
        part = image_bgr[low[1] : high[1], low[0] : high[0]]
        self._patch = np.ascontiguousarray(part)
        self._corner = low.astype(float)

    def settle(self, image_bgr: Grey, box: FloatArray) -> tuple[FloatArray, float]:
        """The box moved to where the drawn one is most alike, and how alike, -1 to 1."""
        scale = (box[2:] - box[:2]) / (self._box[2:] - self._box[:2])
        height, width = self._patch.shape[:2]
        size = np.maximum(np.rint(np.array([width, height]) * scale), 4).astype(int)
        real = size / np.array([width, height])
        patch = cv2.resize(self._patch, size.tolist(), interpolation=cv2.INTER_AREA)
        corner = box[:2] - (self._box[:2] - self._corner) * real
        reach = np.ceil(np.maximum(_SEARCH_PX, _SEARCH_SHARE * size)).astype(int)
        first = np.rint(corner).astype(int) - reach
        last = first + size + 2 * reach
        picture = np.array([image_bgr.shape[1], image_bgr.shape[0]])
        cut_low, cut_high = np.maximum(first, 0), np.minimum(last, picture)
        # At the border it could not be found further out, and would seem to stay there.
        if (corner < -0.5).any() or (corner + size > picture + 0.5).any():
            return box, -1.0
        window = image_bgr[cut_low[1] : cut_high[1], cut_low[0] : cut_high[0]]
        alike = np.asarray(cv2.matchTemplate(window, patch, cv2.TM_CCOEFF_NORMED), np.float32)
        _, best, _, (x, y) = cv2.minMaxLoc(alike)
        found = cut_low + np.array([x + _vertex(alike[y, :], x), y + _vertex(alike[:, x], y)])
        low = found + (self._box[:2] - self._corner) * real
        return np.concatenate([low, low + (box[2:] - box[:2])]), float(best)


def _vertex(values: NDArray[np.float32], at: int) -> float:
    """How far the top of a parabola through three values is off the middle one."""
    if not 0 < at < values.size - 1:
        return 0.0
    before, here, after = (float(value) for value in values[at - 1 : at + 2])
    bend = before - 2.0 * here + after
    return 0.0 if bend >= 0.0 else float(np.clip(0.5 * (before - after) / bend, -0.5, 0.5))


def _moved(before: Grey, now: Grey, box: FloatArray, shift: FloatArray) -> tuple[FloatArray, float]:
    """A box carried along by optical flow that comes back, and the share of points that do."""
    size = box[2:] - box[:2]
    steps = np.linspace(0.06, 0.94, _GRID)
    grid = box[:2] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) * size
    mask = np.zeros(before.shape, np.uint8)
    low, high = np.maximum(np.floor(box[:2]), 0).astype(int), np.ceil(box[2:]).astype(int)
    mask[low[1] : high[1], low[0] : high[0]] = 255
    corners = cv2.goodFeaturesToTrack(before, _MOST_POINTS, 0.01, 2.0, mask=mask)
    points = grid if corners is None else np.concatenate([corners.reshape(-1, 2), grid])
    start = points.astype(np.float32).reshape(-1, 1, 2)
    guess = (points + shift).astype(np.float32).reshape(-1, 1, 2)
    ahead, there, _ = cv2.calcOpticalFlowPyrLK(
        before,
        now,
        start,
        guess,
        winSize=_WINDOW,
        maxLevel=_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(
        now,
        before,
        ahead,
        start.copy(),
        winSize=_WINDOW,
        maxLevel=_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    astray = np.hypot(*(back - start).reshape(-1, 2).T)
    kept = (there.ravel() == 1) & (again.ravel() == 1)
    kept &= astray <= max(_ASTRAY_PX, _ASTRAY_SHARE * float(size.max()))
    share = float(kept.mean())
    if kept.sum() < _FEWEST_POINTS or share < _LEAST_SHARE:
        return box, 0.0
    old, new = points[kept], ahead.reshape(-1, 2)[kept].astype(float)
    # Water in the box goes elsewhere than the boat: what most agree on counts.
    turn, _ = cv2.estimateAffinePartial2D(
        old, new, method=cv2.RANSAC, ransacReprojThreshold=max(0.7, 0.02 * float(size.max()))
    )
    if turn is None:
        return box, 0.0
    scale = float(np.hypot(turn[0, 0], turn[1, 0]))
    if not 1.0 / _MOST_SCALE < scale < _MOST_SCALE:
        return box, 0.0
    middle = 0.5 * (box[:2] + box[2:])
    there_middle = turn[:, :2] @ middle + turn[:, 2]
    half = 0.5 * scale * size
    return np.concatenate([there_middle - half, there_middle + half]), share


def follow_box(
    frames: Iterable[Frame],
    box: FloatArray,
    *,
    expected: Callable[[int], FloatArray | None] = lambda _: None,
    detector: Detector | None = None,
) -> Iterator[Followed]:
    """Follow a box through frames, until it is unsure.

    Each step is one of optical flow, which has to come back when it is followed backward, and is
    then held against the box as it was drawn, so that it does not drift. It ends where too few
    points come back, where what is there does not look like what was drawn, where it jumps, where
    the box leaves the picture, and where a detector that sees the drawn box sees it twice no more.

    Args:
        frames: The frame of the box first, then its neighbours, in either direction.
        box: (4,) in the first frame.
        expected: From a frame's number, where a camera and a log expect the box, (4,), if known.
        detector: Checks each step.

    Yields:
        Frames after the first.
    """
    remaining = iter(frames)
    first = next(remaining)
    drawn, box = _Drawn(first.image_bgr, box), box.astype(float)
    height, width = first.image_bgr.shape[:2]
    before = _grey(first)
    if detector is not None:
        detector.reset()
        detector = detector if _sees(detector, first, box) else None
    shift, was, unseen, held = np.zeros(2), first, 0, list[Followed]()
    for frame in remaining:
        step_s = abs(frame.time_utc_s - was.time_utc_s)
        if step_s > LONGEST_STEP_S:
            return
        there, here = expected(frame.index), expected(was.index)
        if there is not None and here is not None:
            shift = 0.5 * ((there[:2] + there[2:]) - (here[:2] + here[2:]))
        now = _grey(frame)
        carried, share = _moved(before, now, box, shift)
        if share == 0.0:
            return
        settled, alike = drawn.settle(frame.image_bgr, carried)
        size = box[2:] - box[:2]
        step = 0.5 * (settled[:2] + settled[2:] - box[:2] - box[2:])
        inside = settled[:2].min() >= 0.0 and (settled[2:] <= (width, height)).all()
        jumps = (np.abs(step - shift) > _MOST_ASIDE * np.maximum(size, size.mean())).any()
        if alike < _LEAST_ALIKE or not inside or jumps or size.min() < _LEAST_SHOWN_PX:
            return
        sure = float(np.clip(alike, 0.0, 1.0) * min(1.0, 0.5 + share))
        found = Followed(frame.index, settled, sure)
        if detector is not None and not _sees(detector, frame, settled):
            unseen += 1
            held.append(found)
            if unseen >= _MOST_UNSEEN:
                return
        else:
            # One frame in which a detector sees nothing is usual.
            yield from held
            held, unseen = [], 0
            yield found
        box, shift, before, was = settled, step, now, frame


def _grey(frame: Frame) -> Grey:
    return np.asarray(cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY), np.uint8)


def _sees(detector: Detector, frame: Frame, box: FloatArray) -> bool:
    boxes = detector.detect(frame)
    return bool(len(boxes) and iou(boxes.xyxy_px, box[None, :]).max() >= _OVERLAP)


def where_expected(
    frames: Sequence[Frame], expected: Expected, background: Background, drawn: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Boxes where a fitted camera and the log expect them, snapped to what stands out there.

    For frames too far apart for `follow_box`. What people draw reaches beyond what stands out, or
    less far; by how much is learned from the boxes that are drawn.

    Args:
        frames: N of a recording.
        expected: In these.
        background: Of the recording.
        drawn: (N, 4) boxes as they were drawn, NaN where there is none.

    Returns:
        (N, 4) boxes, NaN where there is none, and (N,) confidences.
    """
    boxes, sure = propose_in(frames, expected, background)
    known = np.isfinite(boxes).all(axis=1) & np.isfinite(drawn).all(axis=1)
    if known.sum() < _FEWEST_HABITS:
        return boxes, 0.5 * sure
    size = np.tile(boxes[:, 2:] - boxes[:, :2], 2)
    boxes = boxes + np.median((drawn - boxes)[known] / size[known], axis=0) * size
    # What stands out and the camera err for reasons of their own.
    boxes[:, 3] = 0.5 * (boxes[:, 3] + expected.xyxy_px[:, 3])
    boxes[boxes[:, 1] >= boxes[:, 3]] = np.nan
    return boxes, np.where(np.isfinite(boxes[:, 0]), sure, 0.0)
