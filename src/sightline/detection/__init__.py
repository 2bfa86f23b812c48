"""Stage 1: frames in, boxes out."""

from sightline.detection.detector import Detector
from sightline.detection.metadata import LowerEdge
from sightline.detection.motion import MotionDetector, MotionSettings
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.detection.registry import (
    DEFAULT_DETECTOR,
    DETECTORS,
    check_detector_name,
    detector_by_name,
)
from sightline.detection.run import Looker, detect, shown
from sightline.detection.tiling import VIEWS, View, ViewSettings

__all__ = [
    "DEFAULT_DETECTOR",
    "DETECTORS",
    "VIEWS",
    "Detector",
    "DetectorOptions",
    "Looker",
    "LowerEdge",
    "MotionDetector",
    "MotionSettings",
    "OnnxDetector",
    "View",
    "ViewSettings",
    "check_detector_name",
    "detect",
    "detector_by_name",
    "shown",
]
