"""Proposed boxes of a logged target for frames without drawn ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sightline.errors import InputError
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.expected import Expected, TargetSize, expect, place_of
from sightline.labelling.snapping import GATE, Background, BoxPrior, Look, snap
from sightline.scene import Recording
from sightline.synchronisation import check_overlap
from sightline.types import BoolArray, Boxes, FloatArray, Frame, IntArray, StrArray

SOURCE = "log"
"""The annotator of a proposed box."""
DEFAULT_LABEL = "boat"

_SMALLEST_PX = 3.0
_LEAST_SHOWN = 0.15
"""Share of a box that must lie in the picture."""
_FIRST_SHAPE_SIGMA, _SHAPE_SIGMA = 0.5, 0.3
"""Of the logarithms of width and height, before and after the pictures told the size."""
_HABIT_PX = 3.0
"""Besides all else that is unsure: what counts as the edge of a boat."""
_ASIDE = 0.2
"""The middle of a boat is off its receiver by this share of its width, and the edge of its hull."""
_SURE, _FEWEST_SURE = 0.3, 5
_CLEAR = 5.0

IN_GAP = "the log has a gap"
OUTSIDE = "outside the picture"
TOO_SMALL = "too far to be seen"
NOTHING = "nothing stands out there"
UNSURE = "less sure than was asked for"
OTHER = "what stands out there is not of its size"


@dataclass(frozen=True, eq=False)
class Proposals:
    """Proposed boxes of a recording, one row a frame that was examined.

    Attributes:
        recording: Its name.
        frame: (N,) int64.
        time_utc_s: (N,) float64, POSIX seconds by the recording's clock.
        expected: (N,) where the log says the target is.
        xyxy_px: (N, 4) float64, the proposed box; NaN where there is none.
        confidence: (N,) float64, 0 to 1; 0 where there is none.
        reason: (N,) str, why there is none; ``""`` where there is one.
    """

    recording: str
    frame: IntArray
    time_utc_s: FloatArray
    expected: Expected
    xyxy_px: FloatArray
    confidence: FloatArray
    reason: StrArray

    def __len__(self) -> int:
        return int(self.frame.size)

    @property
    def made(self) -> BoolArray:
        """(N,) bool, whether there is a box."""
        return np.asarray(np.isfinite(self.xyxy_px[:, 0]))

    def surer_than(self, confidence: float) -> Proposals:
        """Drop the boxes of less confidence than this, 0 to 1."""
        out = self.made & (self.confidence < confidence)
        return replace(
            self,
            xyxy_px=np.where(out[:, None], np.nan, self.xyxy_px),
            confidence=np.where(out, 0.0, self.confidence),
            reason=np.array(
                [UNSURE if bad else why for bad, why in zip(out, self.reason, strict=True)],
                dtype=np.str_,
            ),
        )

    def boxes(self, label: str = DEFAULT_LABEL) -> Boxes:
        """The proposed boxes, by the annotator ``"log"``."""
        rows = self.made
        return Boxes.of(
            self.xyxy_px[rows],
            frame=self.frame[rows],
            time_utc_s=self.time_utc_s[rows],
            confidence=self.confidence[rows],
            source=SOURCE,
            label=label,
        )


def propose(
    recording: Recording,
    georeferencer: Georeferencer,
    size: TargetSize,
    *,
    every_s: float = 1.0,
    leave_out: IntArray | None = None,
    detections: Boxes | None = None,
    background: Background | None = None,
) -> Proposals:
    """Propose a box of the logged target for each frame of a recording.

    Where the target must be follows from the log, the clock and the camera; what it looks like
    there is what differs from the recording's background, or the detection that fits best where
    the recording has detections.

    Args:
        recording: Has pictures and a log.
        georeferencer: Has a camera; its clock offsets are honoured.
        size: Of the target.
        every_s: Frames that follow the last one sooner are left out.
        leave_out: (M,) frames that are left out, since they have boxes already.
        detections: To choose from; absent: the recording's own, if it has any.
        background: Of the recording; absent: it is estimated.

    Raises:
        InputError: The recording has no pictures, no log or no times, or a file cannot be used.
    """
    if recording.source is None:
        raise InputError(f"recording {recording.name}: has no pictures; give video or frames")
    recording.fixes()
    if background is None:
        background = Background.of(recording.frames(), recording.name)
    if detections is None and recording.detections_path is not None:
        detections = recording.detections()
    skipped = set() if leave_out is None else {int(frame) for frame in leave_out}
    levels = recording.water_levels()
    views: list[_View] = []
    last_s, timed = -np.inf, False
    for frame in recording.frames():
        time_s = frame.time_utc_s
        if not np.isfinite(time_s):
            continue
        timed = True
        if frame.index in skipped or time_s - last_s < every_s:
            continue
        last_s = time_s
        expected = expect(
            place_of(recording, georeferencer, np.array([time_s])),
            georeferencer,
            size,
            None if levels is None else levels.at([time_s]),
        )
        seen = None if detections is None else detections[detections.frame == frame.index]
        views.append(_view(frame, expected, background, seen))
    if not timed:
        raise InputError(
            f"recording {recording.name}: nothing tells the times of its frames; give start_utc "
            "(with a video) or clock (a table frame,utc)"
        )
    if views and all(view.expected.in_gap[0] for view in views):
        check_overlap(
            np.array([view.time_utc_s for view in views]),
            recording.fixes(),
            f"recording {recording.name}",
        )
    found = _choose(views)
    return Proposals(
        recording=recording.name,
        frame=np.array([view.frame for view in views], dtype=np.int64),
        time_utc_s=np.array([view.time_utc_s for view in views], dtype=float),
        expected=Expected(
            *(
                np.concatenate([getattr(view.expected, name) for view in views] or [empty])
                for name, empty in _EMPTY.items()
            )
        ),
        xyxy_px=np.array([box for box, _, _ in found], dtype=float).reshape(-1, 4),
        confidence=np.array([sure for _, sure, _ in found], dtype=float),
        reason=np.array([why for _, _, why in found], dtype=np.str_),
    )


def propose_in(
    frames: Sequence[Frame], expected: Expected, background: Background
) -> tuple[FloatArray, FloatArray]:
    """Propose boxes in single frames.

    Args:
        frames: N of a recording.
        expected: In these.
        background: Of the recording.

    Returns:
        (N, 4) boxes, NaN where there is none, and (N,) confidences, 0 there.
    """
    views = [
        _view(frame, expected[np.array([i])], background, None) for i, frame in enumerate(frames)
    ]
    found = _choose(views)
    boxes = np.array([box for box, _, _ in found], dtype=float).reshape(-1, 4)
    return boxes, np.array([sure for _, sure, _ in found], dtype=float)


_EMPTY = {
    "xyxy_px": np.empty((0, 4)),
    "sigma_px": np.empty((0, 2)),
    "range_m": np.empty(0),
    "in_gap": np.empty(0, dtype=bool),
}


@dataclass(frozen=True, eq=False)
class _View:
    """What `_choose` needs of a frame, so that it is decoded once."""

    frame: int
    time_utc_s: float
    expected: Expected
    belief: BoxPrior | None
    look: Look | None
    seen: Boxes | None
    reason: str


def _view(frame: Frame, expected: Expected, background: Background, seen: Boxes | None) -> _View:
    height, width = frame.image_bgr.shape[:2]
    box = expected.xyxy_px[0]
    reason, belief, look = "", None, None
    if expected.in_gap[0]:
        reason = IN_GAP
    elif not np.isfinite(box).all():
        reason = OUTSIDE
    elif box[3] - box[1] < _SMALLEST_PX:
        reason = TOO_SMALL
    else:
        # A boat at the border shows a part of itself.
        inside = np.clip(box, 0.0, [width, height, width, height])
        shown, size = inside[2:] - inside[:2], box[2:] - box[:2]
        if shown.min() < _SMALLEST_PX or np.prod(shown) < _LEAST_SHOWN * np.prod(size):
            reason = OUTSIDE
        else:
            sigma = np.hypot(expected.sigma_px[0], _HABIT_PX)
            sigma = np.hypot(sigma, _ASIDE * size)
            belief = BoxPrior(inside, sigma, _FIRST_SHAPE_SIGMA)
            look = Look.at(background, frame.image_bgr, belief)
    return _View(frame.index, frame.time_utc_s, expected, belief, look, seen, reason)


def _choose(views: list[_View]) -> list[tuple[FloatArray, float, str]]:
    """Choose boxes (4,) or NaN, with confidences, and the reason where there is none.

    Annotators draw wider or tighter than what stands out. So how large the target looks, and where
    by its log, is learned from the pictures in a first round, and is the prior of a second.
    """
    first = [_one(view, view.belief) for view in views]
    sure = [i for i, (_, confidence, _) in enumerate(first) if confidence >= _SURE]
    if len(sure) < _FEWEST_SURE:
        return first
    expected = np.array([_belief(views[i]).xyxy_px for i in sure])
    boxes = np.array([first[i][0] for i in sure])
    ratio = np.median((boxes[:, 2:] - boxes[:, :2]) / (expected[:, 2:] - expected[:, :2]), axis=0)
    height = expected[:, 3] - expected[:, 1]
    lower = float(np.median((boxes[:, 3] - expected[:, 3]) / height))
    second = []
    for view in views:
        belief = view.belief
        if belief is not None:
            x1, y1, x2, y2 = belief.xyxy_px
            foot = y2 + lower * (y2 - y1)
            half, tall = 0.5 * ratio[0] * (x2 - x1), ratio[1] * (y2 - y1)
            middle = 0.5 * (x1 + x2)
            belief = BoxPrior(
                np.array([middle - half, foot - tall, middle + half, foot]),
                belief.place_sigma_px,
                _SHAPE_SIGMA,
            )
        second.append(_one(view, belief))
    return second


def _belief(view: _View) -> BoxPrior:
    assert view.belief is not None
    return view.belief


def _one(view: _View, belief: BoxPrior | None) -> tuple[FloatArray, float, str]:
    none = np.full(4, np.nan)
    if belief is None or view.look is None:
        return none, 0.0, view.reason
    candidates: list[tuple[FloatArray, float]] = []
    if view.seen is not None and len(view.seen):
        candidates = [(row, 1.0) for row in view.seen.xyxy_px]
    snapped = snap(view.look, belief)
    if snapped is not None:
        candidates.append((snapped[0], 1.0 - float(np.exp(-snapped[1] / _CLEAR))))
    if not candidates:
        return none, 0.0, NOTHING
    surprise = belief.surprise(np.array([box for box, _ in candidates]))
    likely = np.exp(-0.125 * surprise) * np.array([weight for _, weight in candidates])
    best = int(np.argmax(likely))
    if surprise[best] > GATE**2:
        return none, 0.0, OTHER
    return np.asarray(candidates[best][0], dtype=float), float(likely[best]), ""
