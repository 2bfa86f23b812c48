"""Labelling: boxes drawn by hand, and those proposed from a fitted camera and a log."""

from sightline.labelling.advice import Advice, OddBox, ThinCell
from sightline.labelling.control_points import (
    ControlPointReport,
    ControlPointSheet,
    PointResidual,
    SheetPoint,
    parse_position,
)
from sightline.labelling.drawing import Drawing, DrawnBox, FrameSummary
from sightline.labelling.expected import Expected, TargetSize, expect, learn_size
from sightline.labelling.proposals import DEFAULT_LABEL, SOURCE, Proposals, propose
from sightline.labelling.sheets import SheetBox, contact_sheets, write_sheet

__all__ = [
    "DEFAULT_LABEL",
    "SOURCE",
    "Advice",
    "ControlPointReport",
    "ControlPointSheet",
    "Drawing",
    "DrawnBox",
    "Expected",
    "FrameSummary",
    "OddBox",
    "PointResidual",
    "Proposals",
    "SheetBox",
    "SheetPoint",
    "TargetSize",
    "ThinCell",
    "contact_sheets",
    "expect",
    "learn_size",
    "parse_position",
    "propose",
    "write_sheet",
]
