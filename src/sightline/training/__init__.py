"""Training of detectors; the libraries of the extra ``train`` are imported when first used."""

from sightline.training.architecture import (
    ARCHITECTURES,
    ExportInfo,
    InputFormat,
    Prediction,
    Target,
    Trainable,
    build,
)

__all__ = [
    "ARCHITECTURES",
    "ExportInfo",
    "InputFormat",
    "Prediction",
    "Target",
    "Trainable",
    "build",
]
