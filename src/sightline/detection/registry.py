"""Detectors by name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import as_file, files
from pathlib import Path

from sightline._plugins import loaded, registered
from sightline.detection.detector import Detector
from sightline.detection.motion import MotionDetector
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.errors import InputError, unknown_name

DETECTORS = ("motion", "harbour")
"""The detectors that need nothing but a name."""

DEFAULT_DETECTOR = "harbour"

ENTRY_POINT_GROUP = "sightline.detectors"


def check_detector_name(name: str | Detector) -> None:
    """Raise InputError for an unknown detector name, without loading one.

    Raises:
        InputError: The name is none of `DETECTORS`, no ONNX file's, and no other package's.
    """
    if not isinstance(name, str) or name in DETECTORS or name.lower().endswith(".onnx"):
        return
    others = registered(ENTRY_POINT_GROUP)
    if name not in others:
        known = (*DETECTORS, *sorted(others), "a file that ends in .onnx")
        raise unknown_name("detector", name, known)


def takes_options(name: str | Detector) -> bool:
    """Whether a detector is made of an ONNX file, and so takes `DetectorOptions`."""
    return isinstance(name, str) and (name == "harbour" or name.lower().endswith(".onnx"))


def detector_by_name(
    name: str | Detector,
    *,
    horizon_px: tuple[float, float] | None = None,
    options: DetectorOptions | None = None,
) -> Detector:
    """A new detector by its name; an object is reset and returned.

    Args:
        name: One of `DETECTORS`, the path of an ONNX file, a name that another package registers
            under the entry point group ``sightline.detectors`` (it names a callable without
            arguments), or an object.
        horizon_px: Rows of the horizon at the left and the right edge of the image, where known.
        options: How a detector in an ONNX file is run.

    Raises:
        InputError: The name is none of them, the file cannot be used, or options are given to a
            detector that has none.
    """
    if not isinstance(name, str):
        name.reset()
        return name
    if name.lower().endswith(".onnx"):
        return OnnxDetector(name, options=options, horizon_px=horizon_px)
    check_detector_name(name)
    if name == "harbour":
        return _harbour(horizon_px, options)
    if options is not None and options != DetectorOptions():
        what = "finds what moves and runs no network" if name == "motion" else "runs no ONNX file"
        raise InputError(
            f"the detector {name!r} {what}, so it has no decoder, classes, threshold, provider or "
            "views; leave them out, or give an ONNX file"
        )
    if name == "motion":
        return MotionDetector(horizon_px=horizon_px)
    made: Detector = loaded(registered(ENTRY_POINT_GROUP)[name])()
    return made


def _harbour(
    horizon_px: tuple[float, float] | None, options: DetectorOptions | None
) -> OnnxDetector:
    with shipped_file() as path:
        return OnnxDetector(path, name="harbour", options=options, horizon_px=horizon_px)


@contextmanager
def shipped_file() -> Iterator[Path]:
    """The ONNX file of the detector that ships with the package, while the block lasts.

    Raises:
        InputError: It is not in this installation.
    """
    packaged = files("sightline.detection") / "harbour" / "harbour.onnx"
    if not packaged.is_file():
        raise InputError(
            "the detector 'harbour' is not in this installation (sightline/detection/harbour/"
            "harbour.onnx is missing); install sightline anew, or give an ONNX file"
        )
    with as_file(packaged) as path:
        yield path
