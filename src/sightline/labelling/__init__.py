"""Labelling: training boxes proposed from a fitted camera and the log of a target."""

from sightline.labelling.expected import Expected, TargetSize, expect, learn_size
from sightline.labelling.proposals import DEFAULT_LABEL, SOURCE, Proposals, propose
from sightline.labelling.sheets import contact_sheets

__all__ = [
    "DEFAULT_LABEL",
    "SOURCE",
    "Expected",
    "Proposals",
    "TargetSize",
    "contact_sheets",
    "expect",
    "learn_size",
    "propose",
]
