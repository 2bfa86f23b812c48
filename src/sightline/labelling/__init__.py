"""Labelling: boxes drawn by hand, and those proposed from a fitted camera and a log."""

from sightline.labelling.advice import Advice, OddBox, ThinCell
from sightline.labelling.drawing import Drawing, DrawnBox, FrameSummary
from sightline.labelling.expected import Expected, TargetSize, expect, learn_size
from sightline.labelling.proposals import DEFAULT_LABEL, SOURCE, Proposals, propose
from sightline.labelling.sheets import SheetBox, contact_sheets, write_sheet

__all__ = [
    "DEFAULT_LABEL",
    "SOURCE",
    "Advice",
    "Drawing",
    "DrawnBox",
    "Expected",
    "FrameSummary",
    "OddBox",
    "Proposals",
    "SheetBox",
    "TargetSize",
    "ThinCell",
    "contact_sheets",
    "expect",
    "learn_size",
    "propose",
    "write_sheet",
]
