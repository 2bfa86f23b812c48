"""Detectors by their names."""

from __future__ import annotations

from importlib.resources import as_file, files

from sightline.detection.detector import Detector
from sightline.detection.motion import MotionDetector
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.errors import InputError, unknown_name

DETECTORS = ("motion", "harbour")
"""The detectors that need nothing but a name."""

DEFAULT_DETECTOR = "harbour"


def check_detector_name(name: str) -> None:
    """Refuse what names no detector, without loading one.

    Raises:
        InputError: The name is none of `DETECTORS`, and no ONNX file's.
    """
    if name not in DETECTORS and not name.lower().endswith(".onnx"):
        raise unknown_name("detector", name, (*DETECTORS, "a file that ends in .onnx"))


def detector_by_name(
    name: str,
    *,
    horizon_px: tuple[float, float] | None = None,
    options: DetectorOptions | None = None,
) -> Detector:
    """A new detector.

    Args:
        name: One of `DETECTORS`, or the path of an ONNX file.
        horizon_px: Rows of the horizon at the left and the right edge of the image, where known.
        options: How a detector in an ONNX file is run.

    Raises:
        InputError: The name is none of them, the file cannot be used, or options are given to a
            detector that has none.
    """
    if name.lower().endswith(".onnx"):
        return OnnxDetector(name, options=options, horizon_px=horizon_px)
    if name == "motion":
        if options is not None and options != DetectorOptions():
            raise InputError(
                "the detector 'motion' finds what moves and runs no network, so it has no "
                "decoder, classes, threshold, provider or views; leave them out, or give an ONNX "
                "file"
            )
        return MotionDetector(horizon_px=horizon_px)
    check_detector_name(name)
    return _harbour(horizon_px, options)


def _harbour(
    horizon_px: tuple[float, float] | None, options: DetectorOptions | None
) -> OnnxDetector:
    packaged = files("sightline.detection") / "harbour" / "harbour.onnx"
    if not packaged.is_file():
        raise InputError(
            "the detector 'harbour' is not in this installation (sightline/detection/harbour/"
            "harbour.onnx is missing); install sightline anew, or give an ONNX file"
        )
    with as_file(packaged) as path:
        return OnnxDetector(path, name="harbour", options=options, horizon_px=horizon_px)
