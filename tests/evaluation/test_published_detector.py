"""The ruler: a published network on pictures of cameras that nobody here chose it for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings
from sightline.evaluation.detection import JudgedFrame, score_detections
from sightline.scene.labelled_pictures import chosen_targets, detect_pictures, labelled_pictures


@pytest.mark.slow
def test_a_published_network_has_the_average_precision_that_was_measured_apart(
    data_dir: Path,
) -> None:
    """0.345 (recall 0.77) in tiles of the frames as they are, by other code than this."""
    if not (data_dir / "livecams").is_dir():
        pytest.skip("there are no pictures of other cameras in SIGHTLINE_DATA")
    pictures = labelled_pictures(data_dir / "livecams")
    options = DetectorOptions(
        classes=("boat",), threshold=0.01, views=TilingSettings("tiles"), threads=2
    )
    detector = OnnxDetector(data_dir / "weights" / "yolox_nano.onnx", options=options)
    judged = detect_pictures(pictures, detector, chosen_targets(pictures, detector, None))
    groups: dict[str, list[JudgedFrame]] = {}
    for picture, frame in zip(pictures.pictures, judged, strict=True):
        groups.setdefault(picture.prefix, []).append(frame)
    assert {name: len(frames) for name, frames in groups.items()} == {
        "bay": 14, "river": 14, "town": 14,
    }  # fmt: skip
    reports = [score_detections(frames, threshold=0.01) for frames in groups.values()]
    assert np.mean([one.average_precision for one in reports]) == pytest.approx(0.345, abs=0.01)
    assert np.mean([one.recall for one in reports]) == pytest.approx(0.77, abs=0.01)
