"""Stage 1: detection, frames in and boxes out."""

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
from sightline.detection.run import FrameObserver, detect, observe
from sightline.detection.tiling import VIEWS, Tile, TilingSettings

__all__ = [
    "DEFAULT_DETECTOR",
    "DETECTORS",
    "VIEWS",
    "Detector",
    "DetectorOptions",
    "FrameObserver",
    "LowerEdge",
    "MotionDetector",
    "MotionSettings",
    "OnnxDetector",
    "Tile",
    "TilingSettings",
    "check_detector_name",
    "detect",
    "detector_by_name",
    "observe",
]
