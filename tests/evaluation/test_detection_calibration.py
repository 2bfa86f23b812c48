"""Calibration of a detector's confidence, against probabilities that are known."""

from __future__ import annotations

import numpy as np
import pytest

from sightline.detection.metadata import DetectorMetadata, read_metadata
from sightline.errors import InputError
from sightline.evaluation.calibration import calibrated, fit_calibration, reliability
from sightline.evaluation.detection import JudgedFrame, right_boxes


def test_error_of_a_detector_that_is_right_half_as_often_as_it_says() -> None:
    confidence = np.array([0.8] * 10 + [0.4] * 30)
    right = np.array([True] * 4 + [False] * 6 + [True] * 6 + [False] * 24)
    found = reliability(confidence, right)
    # (10 * |0.8 - 0.4| + 30 * |0.4 - 0.2|) / 40
    assert found.error == pytest.approx(0.25)
    assert found.count.sum() == 40
    assert found.right[8] == pytest.approx(0.4)
    assert np.isnan(found.right[0])


def test_of_no_boxes_there_is_no_error() -> None:
    assert np.isnan(reliability(np.empty(0), np.empty(0, dtype=bool)).error)


def test_a_confidence_of_one_has_a_bin() -> None:
    assert reliability(np.array([1.0]), np.array([True])).error == 0.0


def test_boxes_are_right_as_often_as_their_calibrated_confidence_says() -> None:
    rng = np.random.default_rng(4)
    logit = rng.normal(0.0, 2.0, 20_000)
    score = 1.0 / (1.0 + np.exp(-logit))
    # The truth is less sure, and shifted.
    probability = 1.0 / (1.0 + np.exp(-(0.5 * logit - 1.0)))
    right = rng.random(20_000) < probability
    assert reliability(score, right).error > 0.15
    mapping = fit_calibration(score[:10_000], right[:10_000])
    assert mapping is not None
    told = calibrated(score[10_000:], mapping)
    assert reliability(told, right[10_000:]).error < 0.02
    assert np.abs(told - probability[10_000:]).max() < 0.06
    # No box changes places with another.
    order = np.argsort(score[10_000:])
    assert (np.diff(told[order]) >= 0.0).all()


@pytest.mark.parametrize("right", [[True] * 50, [False] * 50, [False] * 25 + [True] * 4])
def test_too_few_boxes_of_a_kind_tell_nothing(right: list[bool]) -> None:
    assert fit_calibration(np.linspace(0.1, 0.9, len(right)), np.array(right)) is None


def test_scores_that_fall_where_boxes_are_right_tell_nothing() -> None:
    score = np.linspace(0.05, 0.95, 60)
    assert fit_calibration(score, score < 0.5) is None


def test_right_boxes_are_those_that_overlap_drawn_ones() -> None:
    frame = JudgedFrame(
        "1",
        np.array([[0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 60.0, 60.0]]),
        np.array([False, True]),
        np.array([[0.0, 0.0, 10.0, 9.0], [30.0, 30.0, 40.0, 40.0], [50.0, 50.0, 60.0, 60.0]]),
        np.array([0.9, 0.6, 0.5]),
    )
    confidence, right = right_boxes([frame])
    # The third is of another boat, and counts neither way.
    assert confidence.tolist() == [0.9, 0.6]
    assert right.tolist() == [True, False]


def test_a_file_keeps_its_calibration() -> None:
    mapping = ((0.0, 0.0), (0.5, 0.2), (1.0, 0.9))
    told = DetectorMetadata(decoder="yolov8", classes=("boat",), calibration=mapping)
    read = read_metadata("x.onnx", {"sightline": told.to_json()})
    assert read is not None
    assert read.calibration == mapping


@pytest.mark.parametrize("mapping", ["[[0, 0.5], [1, 0.2]]", "[[0.5, 0], [0.5, 1]]", "[[0, 1]]"])
def test_a_calibration_that_does_not_rise_is_refused(mapping: str) -> None:
    text = f'{{"format": 1, "decoder": "yolov8", "classes": ["boat"], "calibration": {mapping}}}'
    with pytest.raises(InputError, match="calibration"):
        read_metadata("x.onnx", {"sightline": text})
