"""`sightline detector`: stage 1 by itself, one module a command."""

from __future__ import annotations

import typer

from sightline.cli.detector.evaluate import evaluate
from sightline.cli.detector.label import label

detector = typer.Typer(
    name="detector",
    help="Measure detectors, and make what they learn from.",
    no_args_is_help=True,
)
for command in (evaluate, label):
    detector.command()(command)
