"""Labelling: training boxes proposed from a fitted camera and the log of a target."""

from sightline.labelling.expected import Expected, TargetSize, expect, learn_size
from sightline.labelling.proposals import DEFAULT_LABEL, SOURCE, Proposals, propose
from sightline.labelling.sheets import SheetBox, contact_sheets, write_sheet

__all__ = [
    "DEFAULT_LABEL",
    "SOURCE",
    "Expected",
    "Proposals",
    "SheetBox",
    "TargetSize",
    "contact_sheets",
    "expect",
    "learn_size",
    "propose",
    "write_sheet",
]
