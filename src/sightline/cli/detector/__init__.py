"""`sightline detector`: stage 1 by itself, one module a command."""

from __future__ import annotations

import typer

from sightline.cli.detector.adapt import adapt
from sightline.cli.detector.combine import combine
from sightline.cli.detector.compare import compare
from sightline.cli.detector.evaluate import evaluate
from sightline.cli.detector.export import export
from sightline.cli.detector.label import label
from sightline.cli.detector.quantize import quantize
from sightline.cli.detector.train import train

detector = typer.Typer(
    name="detector",
    help="Label, train, adapt, measure, compare, export, combine and quantise detectors.",
    no_args_is_help=True,
)
for command in (label, train, adapt, evaluate, compare, export, combine, quantize):
    detector.command()(command)
