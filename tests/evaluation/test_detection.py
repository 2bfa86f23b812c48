"""Measures of detectors, against closed forms and COCO's own counting."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sightline.errors import InputError
from sightline.evaluation.detection import (
    JudgedFrame,
    score_detections,
)

A = [100.0, 100.0, 140.0, 120.0]
B = [300.0, 200.0, 340.0, 220.0]


def frame(
    truth: list[list[float]],
    found: list[tuple[list[float], float]],
    ignored: list[bool] | None = None,
) -> JudgedFrame:
    return JudgedFrame(
        name="f",
        truth_xyxy_px=np.array(truth, float).reshape(-1, 4),
        ignored=np.array(ignored if ignored else [False] * len(truth), dtype=bool),
        found_xyxy_px=np.array([box for box, _ in found], float).reshape(-1, 4),
        confidence=np.array([score for _, score in found], float),
    )


def shifted(box: list[float], x: float) -> list[float]:
    return [box[0] + x, box[1], box[2] + x, box[3]]


def test_all_found_and_nothing_else() -> None:
    report = score_detections([frame([A], [(A, 0.9)]), frame([B], [(B, 0.4)]), frame([], [])])
    assert (report.frames, report.drawn, report.found) == (3, 2, 2)
    assert report.map_50 == pytest.approx(1.0)
    assert report.map_50_95 == pytest.approx(1.0)
    assert (report.recall, report.precision, report.false_per_frame) == (1.0, 1.0, 0.0)
    assert (report.recall_at_allowed, report.threshold_at_allowed) == (1.0, 0.4)
    assert (report.mean_iou, report.mean_giou, report.foot_px) == (1.0, 1.0, 0.0)


def test_half_found_is_precision_one_to_half_of_recall() -> None:
    """COCO reads the precision at 101 recalls, 0, 0.01, ... 1: 51 of them are at most a half."""
    report = score_detections([frame([A], [(A, 0.9)]), frame([B], [])])
    assert report.map_50 == pytest.approx(51 / 101)
    assert report.recall == 0.5


def test_a_false_box_before_the_right_one_halves_the_precision() -> None:
    report = score_detections([frame([A], [(B, 0.9), (A, 0.5)])], allowed_per_frame=0.0)
    assert report.map_50 == pytest.approx(0.5)
    assert (report.recall, report.precision, report.false_per_frame) == (1.0, 0.5, 1.0)
    assert report.recall_at_allowed == 0.0
    assert math.isnan(report.threshold_at_allowed)
    one = score_detections([frame([A], [(B, 0.9), (A, 0.5)])], allowed_per_frame=1.0)
    assert (one.recall_at_allowed, one.threshold_at_allowed) == (1.0, 0.5)


def test_average_precision_asks_for_more_overlap_step_by_step() -> None:
    """A box of 40 px moved by 8 px overlaps by 32 / 48 = 0.667: four of ten steps reach that."""
    report = score_detections([frame([A], [(shifted(A, 8.0), 0.9)])])
    assert report.map_50 == pytest.approx(1.0)
    assert report.map_50_95 == pytest.approx(0.4)
    assert report.mean_iou == pytest.approx(2 / 3)
    assert report.mean_giou == pytest.approx(2 / 3)
    far = score_detections([frame([A], [(shifted(A, 20.0), 0.9)])], least_iou=0.3)
    assert (far.map_50, far.recall) == (0.0, 1.0)


def test_the_threshold_counts_in_recall_and_not_in_average_precision() -> None:
    report = score_detections([frame([A], [(A, 0.2)])], threshold=0.3)
    assert report.map_50 == pytest.approx(1.0)
    assert report.recall == 0.0
    assert math.isnan(report.precision)
    assert report.recall_at_allowed == 1.0


def test_a_second_box_of_the_same_thing_is_false() -> None:
    report = score_detections([frame([A], [(A, 0.9), (shifted(A, 4.0), 0.8)])])
    assert (report.recall, report.precision) == (1.0, 0.5)


def test_other_boats_are_neither_right_nor_wrong() -> None:
    report = score_detections([frame([A, B], [(A, 0.9), (B, 0.95)], [False, True])])
    assert report.drawn == 1
    assert (report.recall, report.precision, report.map_50) == (1.0, 1.0, pytest.approx(1.0))
    missed = score_detections([frame([A, B], [(A, 0.9)], [False, True])])
    assert (missed.recall, missed.map_50) == (1.0, pytest.approx(1.0))


def test_boxes_in_frames_without_a_boat_are_false() -> None:
    report = score_detections([frame([A], [(A, 0.5)]), frame([], [(B, 0.9)])])
    assert report.precision == 0.5
    assert report.map_50 == pytest.approx(0.5)


def test_found_boxes_that_end_too_high_have_a_negative_foot() -> None:
    high = [A[0], A[1], A[2], A[3] - 3.0]
    assert score_detections([frame([A], [(high, 0.9)])]).foot_px == -3.0


def test_nothing_found_and_nothing_to_find() -> None:
    assert score_detections([frame([A], [])]).map_50 == 0.0
    nothing = score_detections([frame([], [(A, 0.9)])])
    assert math.isnan(nothing.map_50)
    assert math.isnan(nothing.recall)
    assert nothing.false_per_frame == 1.0
    with pytest.raises(InputError, match="no frame has both a picture and labels"):
        score_detections([])
    with pytest.raises(InputError, match="iou is 0"):
        score_detections([frame([A], [])], least_iou=0.0)
