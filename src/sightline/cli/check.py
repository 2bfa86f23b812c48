"""`sightline check`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.common import check_scene_is_there, say, write_result
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import keep_apart
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.pipeline.check import CheckReport


def check(
    what: Annotated[
        list[Path], typer.Argument(metavar="SCENE|FILE...", help="A scene file, or any files.")
    ],
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Read all that a run would read, say what is in it, and what will go wrong."""
    keep_apart([json], what)
    if len(what) == 1 and what[0].suffix.lower() == ".toml":
        check_scene_is_there(what[0])
    from sightline.pipeline.check import check as check_any

    # What the library would warn of stands in the report.
    logger = logging.getLogger("sightline")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        report = check_any(what)
    finally:
        logger.setLevel(level)
    keep_apart([json], [file.path for file in report.files])
    keep_others([(json, "result")], overwrite=overwrite)
    write_result(json, report.to_dict())
    # The first of the problems is the error.
    for line in report.lines(problems_from=1):
        say(line)
    refuse_problems(report, "above")
    if report.recordings:
        say("Nothing stands in the way of a run.")


def refuse_problems(report: CheckReport, where: str = "see `sightline check`") -> None:
    """Raise InputError where a run would be refused, with the first of the reasons.

    Args:
        report: Of the check.
        where: The others stand.

    Raises:
        InputError: There is one.
    """
    if report.problems:
        more = len(report.problems) - 1
        raise InputError(report.problems[0] + (f" (and {more} more, {where})" if more else ""))
