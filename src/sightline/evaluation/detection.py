"""Evaluation of a detector against boxes drawn by hand.

Average precision is COCO's own, by its reference implementation. Recall, precision and false
boxes at one overlap are counted here: boxes are given to drawn ones in the order of confidence,
each to the one that it overlaps most. COCO's implementation comes with the extra
``sightline[score]``.
"""

from __future__ import annotations

import contextlib
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from sightline import _optional
from sightline.errors import InputError
from sightline.evaluation.calibration import reliability
from sightline.overlap import giou, iou
from sightline.types import BoolArray, FloatArray

DEFAULT_IOU = 0.3
"""A boat of 20 x 12 px is found where two boxes differ by a few pixels; 0.5 asks for more."""

_MOST_BOXES = 100
_COCO_IOUS = np.linspace(0.5, 0.95, 10)


@dataclass(frozen=True, eq=False)
class JudgedFrame:
    """Drawn and detected boxes of one frame.

    Attributes:
        name: Of the frame, for messages.
        truth_xyxy_px: (M, 4) drawn boxes.
        ignored: (M,) bool: other boats, which it is neither right nor wrong to find.
        found_xyxy_px: (N, 4) the detector's boxes.
        confidence: (N,) their confidence.
    """

    name: str
    truth_xyxy_px: FloatArray
    ignored: BoolArray
    found_xyxy_px: FloatArray
    confidence: FloatArray


@dataclass(frozen=True)
class DetectionReport:
    """Precision, recall and average precision of a detector; NaN where undefined.

    Attributes:
        frames: How many were examined.
        drawn: Boxes drawn in them.
        found: Boxes that the detector found in them, at any confidence.
        map_50: Average precision at an intersection over union of 0.5.
        map_50_95: Mean of average precisions at 0.5, 0.55, ... 0.95.
        iou: The overlap from which a box counts as found in what follows.
        threshold: Least confidence of a box that counts in recall, precision and false boxes.
        recall: Share of the drawn boxes that were found.
        precision: Share of the found boxes that were drawn.
        false_per_frame: Found boxes that were not drawn, for each frame.
        allowed_per_frame: So many false boxes a frame are allowed in the next two.
        recall_at_allowed: Highest recall with no more false boxes than that.
        threshold_at_allowed: Least confidence that it takes.
        mean_iou: Of the boxes found, with those drawn.
        mean_giou: The same, generalised (Rezatofighi et al. 2019): 1 less the loss.
        foot_px: Median of how far the found boxes end below the drawn ones.
        average_precision: At the overlap ``iou``, over all confidences.
        calibration_error: Expected calibration error of the boxes from ``threshold`` on, at the
            overlap ``iou``.
    """

    frames: int
    drawn: int
    found: int
    map_50: float
    map_50_95: float
    iou: float
    threshold: float
    recall: float
    precision: float
    false_per_frame: float
    allowed_per_frame: float
    recall_at_allowed: float
    threshold_at_allowed: float
    mean_iou: float
    mean_giou: float
    foot_px: float
    average_precision: float = math.nan
    calibration_error: float = math.nan

    def to_dict(self) -> dict[str, object]:
        """The report as JSON has it."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class _Matches:
    """Matched and unmatched detections that count, most confident first.

    Attributes:
        confidence: (N,).
        right: (N,) bool, given to a drawn box.
        found_xyxy_px: (N, 4).
        truth_xyxy_px: (N, 4) the drawn box that each was given to; NaN where none.
    """

    confidence: FloatArray
    right: BoolArray
    found_xyxy_px: FloatArray
    truth_xyxy_px: FloatArray


def _match(frame: JudgedFrame, least_iou: float) -> _Matches:
    """Match detections to drawn boxes; those matched to ignored boxes are left out."""
    order = np.argsort(-frame.confidence, kind="stable")
    overlap = iou(frame.found_xyxy_px[order, None], frame.truth_xyxy_px)
    free = np.ones(len(frame.truth_xyxy_px), dtype=bool)
    right, counts, given = [], [], []
    for row in range(len(order)):
        candidates = np.where(free & ~frame.ignored, overlap[row], -1.0)
        best = int(np.argmax(candidates)) if candidates.size else -1
        hit = best >= 0 and candidates[best] >= least_iou
        if hit:
            free[best] = False
        beside = bool((overlap[row][frame.ignored] >= least_iou).any())
        right.append(hit)
        counts.append(hit or not beside)
        given.append(best if hit else -1)
    kept = np.array(counts, dtype=bool)
    hits = np.array(right, dtype=bool)[kept]
    rows = np.array(given, dtype=np.int64)[kept]
    boxes = frame.found_xyxy_px[order][kept]
    truth = np.full((len(rows), 4), np.nan)
    truth[hits] = frame.truth_xyxy_px[rows[hits]]
    return _Matches(frame.confidence[order][kept], hits, boxes, truth)


def score_detections(
    frames: Sequence[JudgedFrame],
    *,
    least_iou: float = DEFAULT_IOU,
    threshold: float = 0.0,
    allowed_per_frame: float = 1.0,
) -> DetectionReport:
    """Score detections against drawn boxes.

    Args:
        frames: What was drawn and found; found boxes of any confidence, since average precision
            is of all of them.
        least_iou: The overlap from which a drawn box counts as found.
        threshold: Least confidence of a box that counts in recall and precision.
        allowed_per_frame: How many false boxes a frame are allowed in ``recall_at_allowed``.

    Raises:
        InputError: There is no frame, an overlap is none, or the extra ``score`` is missing.
    """
    if not frames:
        raise InputError("no frame has both a picture and labels, so nothing can be measured")
    if not 0.0 < least_iou <= 1.0:
        raise InputError(f"iou is {least_iou:g}; it must lie between 0 and 1")
    each = [_match(frame, least_iou) for frame in frames]
    confidence = np.concatenate([one.confidence for one in each])
    order = np.argsort(-confidence, kind="stable")
    confidence = confidence[order]
    right = np.concatenate([one.right for one in each])[order]
    found = np.concatenate([one.found_xyxy_px for one in each])[order]
    truth = np.concatenate([one.truth_xyxy_px for one in each])[order]
    drawn = int(sum((~frame.ignored).sum() for frame in frames))
    kept = confidence >= threshold
    hits = int((right & kept).sum())
    wrong = int((~right & kept).sum())
    recall_at, threshold_at = _at_allowed(confidence, right, drawn, allowed_per_frame * len(frames))
    chosen = right & kept
    overlap = iou(found[chosen], truth[chosen])
    precisions = [math.nan] * (_COCO_IOUS.size + 1)
    if drawn:
        precisions = _average_precisions(frames, [*_COCO_IOUS.tolist(), least_iou])
    return DetectionReport(
        frames=len(frames),
        drawn=drawn,
        found=int(sum(len(frame.found_xyxy_px) for frame in frames)),
        map_50=precisions[0],
        map_50_95=float(np.mean(precisions[:-1])),
        iou=least_iou,
        threshold=threshold,
        recall=hits / drawn if drawn else math.nan,
        precision=hits / (hits + wrong) if hits + wrong else math.nan,
        false_per_frame=wrong / len(frames),
        allowed_per_frame=allowed_per_frame,
        recall_at_allowed=recall_at,
        threshold_at_allowed=threshold_at,
        mean_iou=float(overlap.mean()) if overlap.size else math.nan,
        mean_giou=float(giou(found[chosen], truth[chosen]).mean()) if overlap.size else math.nan,
        foot_px=float(np.median((found - truth)[chosen, 3])) if overlap.size else math.nan,
        average_precision=precisions[-1],
        calibration_error=reliability(confidence[kept], right[kept]).error,
    )


def right_boxes(
    frames: Sequence[JudgedFrame], least_iou: float = DEFAULT_IOU
) -> tuple[FloatArray, BoolArray]:
    """Confidence of the boxes that count, and whether each is right.

    Args:
        frames: What was drawn and found.
        least_iou: The overlap from which a drawn box counts as found.
    """
    each = [_match(frame, least_iou) for frame in frames]
    nothing = np.empty(0)
    return (
        np.concatenate([nothing, *(one.confidence for one in each)]),
        np.concatenate([nothing.astype(bool), *(one.right for one in each)]),
    )


def _at_allowed(
    confidence: FloatArray, right: BoolArray, drawn: int, allowed: float
) -> tuple[float, float]:
    """Recall and confidence threshold, with at most so many false positives in all."""
    if not drawn:
        return math.nan, math.nan
    wrong = np.cumsum(~right)
    # Boxes of the same confidence come and go together.
    last = np.r_[confidence[1:] != confidence[:-1], True] if confidence.size else np.empty(0, bool)
    possible = np.flatnonzero((wrong <= allowed) & last)
    if not possible.size:
        return 0.0, math.nan
    best = possible[-1]
    return float(right[: best + 1].sum() / drawn), float(confidence[best])


def _average_precisions(frames: Sequence[JudgedFrame], least_ious: Sequence[float]) -> list[float]:
    """Average precision at each overlap, by COCO's implementation."""
    _optional.module("pycocotools", "score")
    # Heavy, and needed by nothing else.
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    drawn: list[dict[str, object]] = []
    found: list[dict[str, object]] = []
    for image, frame in enumerate(frames, start=1):
        for box, ignored in zip(frame.truth_xyxy_px, frame.ignored, strict=True):
            x, y, width, height = _xywh(box)
            drawn.append(
                {
                    "id": len(drawn) + 1,
                    "image_id": image,
                    "category_id": 1,
                    "bbox": [x, y, width, height],
                    "area": width * height,
                    "iscrowd": int(ignored),
                }
            )
        for box, confidence in zip(frame.found_xyxy_px, frame.confidence, strict=True):
            found.append(
                {
                    "image_id": image,
                    "category_id": 1,
                    "bbox": list(_xywh(box)),
                    "score": float(confidence),
                }
            )
    if not found:
        return [0.0] * len(least_ious)
    # It tells of its progress on standard output.
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO()
        truth.dataset = {
            "info": {},
            "images": [{"id": image} for image in range(1, len(frames) + 1)],
            "annotations": drawn,
            "categories": [{"id": 1, "name": "target"}],
        }
        truth.createIndex()
        evaluation = COCOeval(truth, truth.loadRes(found), "bbox")
        evaluation.params.maxDets = [_MOST_BOXES]
        evaluation.params.iouThrs = np.array(least_ious, dtype=np.float64)
        evaluation.evaluate()
        evaluation.accumulate()
    # (overlaps, recalls, categories, areas, most boxes); of all areas.
    precision = evaluation.eval["precision"][:, :, 0, 0, -1]
    return [float(one.mean()) for one in precision]


def _xywh(box: FloatArray) -> tuple[float, float, float, float]:
    x1, y1, x2, y2 = (float(v) for v in box)
    return x1, y1, x2 - x1, y2 - y1


def pooled(judged: Mapping[str, Iterable[JudgedFrame]]) -> list[JudgedFrame]:
    """The frames of all recordings."""
    return [frame for frames in judged.values() for frame in frames]
