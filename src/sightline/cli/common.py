"""What the commands share: consoles, progress, folders, and results as JSON."""

from __future__ import annotations

import math
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from sightline.errors import InputError, no_model_file, no_scene_file

if TYPE_CHECKING:
    from sightline.evaluation.forecast import ForecastError
    from sightline.evaluation.report import Report
    from sightline.progress import Progress as Tell


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Let `main` decide that this is no error."""
        raise BrokenPipeError


# A file is as wide as a table wants.
stdout = _Console(width=None if sys.stdout.isatty() else 200)
stderr = Console(stderr=True)


@dataclass
class Settings:
    """What holds for every command.

    Attributes:
        debug: Show tracebacks of errors that are the user's.
    """

    debug: bool = False


def say(line: str = "") -> None:
    """Print a line as it is, however wide the terminal."""
    stdout.print(line, soft_wrap=True, highlight=False, markup=False)


@contextmanager
def progress() -> Iterator[Tell]:
    """A progress line on standard error, where that is a terminal; gone when the work is done."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
    )
    off = not stderr.is_terminal
    with Progress(*columns, console=stderr, transient=True, disable=off) as bars:
        task = bars.add_task("starting", total=None)

        def tell(what: str, share: float) -> None:
            known = math.isfinite(share)
            bars.update(
                task,
                description=what,
                total=1.0 if known else None,
                completed=share if known else 0.0,
            )

        yield tell


def write_result(path: Path | None, content: Mapping[str, object]) -> None:
    """Write a command's result where ``--json`` says, if it does."""
    if path is not None:
        from sightline.evaluation.report import write_json

        write_json(path, content)


def keep_apart(outputs: Iterable[Path | None], inputs: Iterable[Path | str | None]) -> None:
    """Refuse to write a result over what it is made from.

    Raises:
        InputError: An output is an input.
    """
    read = {os.path.realpath(path) for path in inputs if path is not None}
    for path in outputs:
        if path is not None and os.path.realpath(path) in read:
            raise InputError(f"{path}: is read by this command; give the result another name")


def check_scene_is_there(path: Path) -> None:
    """Refuse a scene file that does not exist, before the library is loaded that reads it.

    Raises:
        InputError: There is none. What else can be wrong with it is left to its reader.
    """
    try:
        path.stat()
    except FileNotFoundError as error:
        raise no_scene_file(path) from error
    except OSError:
        return


def check_model_is_there(path: Path | None) -> None:
    """Refuse a model file that does not exist, before the library is loaded that reads it.

    Raises:
        ModelFileError: There is none.
    """
    if path is not None and not path.is_file():
        raise no_model_file(path)


@contextmanager
def folder_for_results(path: Path) -> Iterator[Path]:
    """A folder that results can go to; made if it is not there, and gone again if the work fails.

    Raises:
        InputError: There is a file of that name, or the folder cannot be made.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: is a file; give a folder for the results")
    new = [folder for folder in (path, *path.parents) if not folder.exists()]
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made: {error.strerror}") from error
    try:
        yield path
    except BaseException:
        if new:
            shutil.rmtree(new[-1])
        raise


def describe(report: Report, what: str) -> str:
    """A report in a line or two."""
    from sightline.evaluation.comparison import number, percent

    ape, cover = report.ape, report.coverage
    with_log = ""
    if cover.reference_sigma_m > 0.0:
        with_log = (
            f" ({percent(cover.p95_with_log)} with the log's own error of "
            f"{number(cover.reference_sigma_m)} m)"
        )
    return (
        f"{what}: {ape.n} pairs, RMSE {number(ape.rmse)} m, median {number(ape.median)} m, "
        f"90 % within {number(ape.p90)} m, {percent(ape.per_range)} of the range; "
        f"95 % ellipses hold {percent(cover.p95)}{with_log}"
    )


def describe_forecast(error: ForecastError, what: str) -> str:
    """The error of forecasts in a line, beside what the log itself would have foretold."""
    from sightline.evaluation.comparison import number, percent

    beside = error.beside_log
    return (
        f"{what}: {error.n} pairs, RMSE {number(error.rmse)} m, median {number(error.median)} m, "
        f"90 % within {number(error.p90)} m; 95 % ellipses hold {percent(error.coverage_p95)}; "
        f"over {beside.n} moments RMSE {number(beside.rmse)} m, constant velocity from the log's "
        f"last two fixes {number(beside.log_rmse)} m"
    )
