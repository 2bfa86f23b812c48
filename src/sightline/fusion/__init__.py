"""One picture from several cameras: their tracks associated, compared and fused."""

from sightline.fusion.bias import BiasPrior
from sightline.fusion.fuse import (
    CameraSummary,
    CameraTracks,
    FuseSettings,
    Fusion,
    cameras_of,
    fuse,
)
from sightline.fusion.handover import HandoverSettings
from sightline.fusion.intersection import intersect

__all__ = [
    "BiasPrior",
    "CameraSummary",
    "CameraTracks",
    "FuseSettings",
    "Fusion",
    "HandoverSettings",
    "cameras_of",
    "fuse",
    "intersect",
]
