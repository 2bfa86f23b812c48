"""Shared parts of the commands: consoles, progress, folders, and results as JSON."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from sightline.atomic import atomic_folder
from sightline.errors import no_model_file, no_scene_file
from sightline.text import terminal_text, without_secrets

if TYPE_CHECKING:
    from sightline.evaluation.forecast import ForecastError
    from sightline.evaluation.report import Report
    from sightline.progress import Progress as Tell


class _Console(Console):
    def on_broken_pipe(self) -> None:
        """Leave a broken pipe to `main`, as no error."""
        raise BrokenPipeError


# A file is as wide as a table wants. Where standard output is closed, there is none.
stdout = _Console(width=None if sys.stdout is not None and sys.stdout.isatty() else 200)
stderr = Console(stderr=True)


@dataclass
class Settings:
    """Settings that hold for every command.

    Attributes:
        debug: Show tracebacks of errors that are the user's.
    """

    debug: bool = False


def say(line: str = "") -> None:
    """Print a line without wrapping it; control characters in names are shown, not sent."""
    shown = terminal_text(without_secrets(line))
    stdout.print(shown, soft_wrap=True, highlight=False, markup=False, emoji=False)


def say_aside(head: str, message: str, style: str) -> None:
    """Print a message in one line on standard error, after a word in a colour."""
    said = terminal_text(without_secrets(" ".join(message.split())))
    line = Text.assemble((head, f"bold {style}"), f" {said}")
    stderr.print(line, soft_wrap=True, highlight=False)


def warn(line: str) -> None:
    """Print a warning to standard error, without wrapping it."""
    stderr.print(
        f"[bold yellow]warning:[/] {escape(terminal_text(without_secrets(line)))}",
        soft_wrap=True,
        highlight=False,
    )


@contextmanager
def progress() -> Iterator[Tell]:
    """Show progress on standard error, where that is a terminal; removed when done."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
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
                description=terminal_text(what),
                total=1.0 if known else None,
                completed=share if known else 0.0,
            )

        yield tell


def write_result(path: Path | None, content: Mapping[str, object]) -> None:
    """Write a command's result to ``--json``, if it is given."""
    if path is not None:
        from sightline.evaluation.report import write_json

        write_json(path, content)


def check_scene_is_there(path: Path) -> None:
    """Raise where the scene file does not exist, before the library that reads it is loaded.

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
    """Raise where the model file does not exist, before the library that reads it is loaded.

    Raises:
        ModelFileError: There is none.
    """
    if path is not None and not path.is_file():
        raise no_model_file(path)


@contextmanager
def folder_for_results(
    path: Path, inputs: Iterable[str | os.PathLike[str]] = ()
) -> Iterator[ResultsFolder]:
    """A folder for results, which appear when the block ends well; see `atomic_folder`.

    Args:
        path: Where they go.
        inputs: What is read, and must not be replaced.

    Raises:
        InputError: There is a file of that name, the folder cannot be made, or another run is
            writing to it.
    """
    with atomic_folder(path, inputs=inputs) as work:
        yield ResultsFolder(work, path)


@dataclass(frozen=True)
class ResultsFolder:
    """Where results are written, and where they will be.

    Attributes:
        work: Of the run's own.
        final: That somebody asked for.
    """

    work: Path
    final: Path

    def place(self, path: Path) -> Path:
        """Where a file of the working folder will be."""
        return self.final / path.relative_to(self.work)


def describe(report: Report, what: str) -> str:
    """Summarise a report in a line or two."""
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
    """Summarise the errors of forecasts in a line, beside those of the log's own extrapolation."""
    from sightline.evaluation.comparison import number, percent

    beside = error.beside_log
    return (
        f"{what}: {error.n} pairs, RMSE {number(error.rmse)} m, median {number(error.median)} m, "
        f"90 % within {number(error.p90)} m; 95 % ellipses hold {percent(error.coverage_p95)}; "
        f"over {beside.n} moments RMSE {number(beside.rmse)} m, constant velocity from the log's "
        f"last two fixes {number(beside.log_rmse)} m"
    )
