"""`sightline detector`: stage 1 by itself, one module a command."""

from __future__ import annotations

import typer

from sightline.cli.detector.evaluate import evaluate

detector = typer.Typer(
    name="detector",
    help="Measure detectors.",
    no_args_is_help=True,
)
for command in (evaluate,):
    detector.command()(command)
