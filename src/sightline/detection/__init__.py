"""Stage 1: frames in, boxes out."""

from sightline.detection.detector import Detector
from sightline.detection.motion import MotionDetector, MotionSettings
from sightline.errors import unknown_name

DETECTORS = ("motion",)
"""The detectors that need nothing but a name."""

__all__ = ["DETECTORS", "Detector", "MotionDetector", "MotionSettings", "detector_by_name"]


def detector_by_name(name: str, *, horizon_px: tuple[float, float] | None = None) -> Detector:
    """A new detector.

    Args:
        name: One of `DETECTORS`.
        horizon_px: Rows of the horizon at the left and the right edge of the image, where known.

    Raises:
        InputError: The name is none of them.
    """
    if name == "motion":
        return MotionDetector(horizon_px=horizon_px)
    raise unknown_name("detector", name, DETECTORS)
