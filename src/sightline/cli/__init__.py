"""The command line: one module a command."""

from __future__ import annotations

import errno
import logging
import sys
import traceback
from contextlib import suppress
from typing import Any

import typer

from sightline import __version__, limits, signals
from sightline.cli import common
from sightline.cli.batch import batch
from sightline.cli.check import check
from sightline.cli.compare import compare
from sightline.cli.count import count
from sightline.cli.demo import demo
from sightline.cli.detect import detect
from sightline.cli.detector import detector
from sightline.cli.draw import draw
from sightline.cli.evaluate import evaluate
from sightline.cli.export import export
from sightline.cli.fit import fit
from sightline.cli.fuse import fuse
from sightline.cli.live import live
from sightline.cli.plan import plan
from sightline.cli.run import run
from sightline.cli.show import show
from sightline.cli.simulate import simulate
from sightline.cli.track import TrackCommand, track
from sightline.errors import SightlineError, StoppedError
from sightline.text import terminal_text

# What is wrong with a command line: typer brings it along under a private name.
_CommandError: Any = typer.BadParameter.__mro__[2]

# Of standard output as well, which may be full, closed, or a terminal that is gone.
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EBADF, errno.EIO)
_LONGEST_SHOWN = 1000
_NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP)

# What typer makes of an interrupt.
_INTERRUPTED = 130

app = typer.Typer(
    name="sightline",
    help="Smooth, georeferenced tracks from the video of one camera that nobody calibrated.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS = (
    *(demo, plan, check, draw, run, fit, compare, track, batch, fuse, show, live),
    *(export, evaluate, count, detect, simulate),
)
for command in COMMANDS:
    app.command(cls=TrackCommand if command in (track, export) else None)(command)
app.add_typer(detector)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sightline {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    debug: bool = typer.Option(False, help="Show the traceback of an error."),
    threads: int | None = typer.Option(
        None, metavar="N", help="Threads of each library; absent: one a core."
    ),
    _version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Show the version."
    ),
) -> None:
    context.ensure_object(common.Settings).debug = debug
    if threads is not None:
        limits.limit_threads(threads)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit.

    With 0 on success, 2 on bad input, 1 on a bug, 130 where Ctrl-C broke it off (128 and the number
    of the signal for others).
    """
    with signals.installed():
        status = _run(arguments)
    sys.exit(status)


class _Warnings(logging.Handler):
    """Shows every warning of the library in a line, once: tables are read twice."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        line = record.getMessage()
        if line not in self._shown:
            self._shown.add(line)
            common.say_aside("warning:", line, "yellow")


def _run(arguments: list[str] | None) -> int:
    warnings = _Warnings()
    settings = common.Settings()
    logging.getLogger("sightline").addHandler(warnings)
    try:
        status = app(args=arguments, standalone_mode=False, obj=settings)
        if status == _INTERRUPTED or signals.broken_off():
            return _stopped()
        _flush()
    except BaseException as error:
        # What is broken off may raise anything: a library that was being loaded is not installed.
        if signals.broken_off():
            if settings.debug:
                sys.stderr.write(terminal_text(traceback.format_exc()))
            return _stopped()
        return _status_of(error, settings)
    finally:
        logging.getLogger("sightline").removeHandler(warnings)
    return status if isinstance(status, int) else 0


def _stopped() -> int:
    with suppress(OSError):
        common.stderr.print("stopped")
    return signals.status()


def _status_of(error: BaseException, settings: common.Settings) -> int:
    """Exit status for what a command raised, once it is told; a bug is raised anew."""
    if isinstance(error, StoppedError | typer.Abort | KeyboardInterrupt):
        return _stopped()
    if isinstance(error, SightlineError):
        if settings.debug:
            sys.stderr.write(terminal_text("".join(traceback.format_exception(error))))
        return _refuse(str(error))
    if isinstance(error, _CommandError):
        # There is no message where the help was printed, since no command was given.
        return _refuse(error.format_message())
    if isinstance(error, BrokenPipeError) or _is_of_broken_pipe(error):
        # Whoever read the output has read enough; where typer saw that, it exits with 1.
        sys.stdout = None
        return 0
    if isinstance(error, OSError):
        if error.errno in _NO_ROOM and error.filename is None:
            # What is left in it cannot be written at the end either.
            sys.stdout = None
            return _refuse(f"the output cannot be written: {error.strerror}")
        if error.errno in _NO_ROOM:
            return _refuse(f"{error.filename}: cannot be written: {error.strerror}")
        if error.errno in _NOT_ALLOWED and error.filename is not None:
            name = str(error.filename)
            # One that is too long for a file may be as long as what it was read from.
            shown = name if len(name) <= _LONGEST_SHOWN else f"{name[:_LONGEST_SHOWN]}..."
            return _refuse(f"{shown}: cannot be used: {error.strerror}")
    if isinstance(error, MemoryError):
        return _refuse(f"there is not enough memory for this: {error}")
    raise error


def _is_of_broken_pipe(error: BaseException) -> bool:
    return isinstance(error, SystemExit) and isinstance(error.__context__, BrokenPipeError)


def _flush() -> None:
    if sys.stdout is not None:
        sys.stdout.flush()


def _refuse(message: str) -> int:
    if message:
        common.say_aside("error:", message, "red")
    return 2
