"""The command line: one module a command."""

from __future__ import annotations

import errno
import logging
import sys
import traceback
from typing import Any

import typer

from sightline import __version__
from sightline.cli import common
from sightline.cli.check import check
from sightline.cli.compare import compare
from sightline.cli.demo import demo
from sightline.cli.detect import detect
from sightline.cli.detector import detector
from sightline.cli.evaluate import evaluate
from sightline.cli.fit import fit
from sightline.cli.run import run
from sightline.cli.simulate import simulate
from sightline.cli.track import track
from sightline.errors import SightlineError
from sightline.text import terminal_text

# What is wrong with a command line: typer brings it along under a private name.
_CommandError: Any = typer.BadParameter.__mro__[2]

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NOT_ALLOWED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP)

app = typer.Typer(
    name="sightline",
    help="Smooth, georeferenced tracks from the video of one camera that nobody calibrated.",
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in (demo, check, run, fit, compare, track, evaluate, detect, simulate):
    app.command()(command)
app.add_typer(detector)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sightline {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    context: typer.Context,
    debug: bool = typer.Option(False, help="Show the traceback of an error."),
    _version: bool = typer.Option(
        False, "--version", callback=_print_version, is_eager=True, help="Show the version."
    ),
) -> None:
    context.ensure_object(common.Settings).debug = debug


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: 0 on success, 2 on bad input, 1 on a bug."""
    sys.exit(_run(arguments))


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
    except SightlineError as error:
        if settings.debug:
            sys.stderr.write(terminal_text(traceback.format_exc()))
        return _refuse(str(error))
    except _CommandError as error:
        # There is no message where the help was printed, since no command was given.
        return _refuse(error.format_message())
    except (typer.Abort, KeyboardInterrupt):
        common.stderr.print("stopped")
        return 130
    except BrokenPipeError:
        # Whoever read the output has read enough.
        sys.stdout = None
        return 0
    except OSError as error:
        if error.errno in _NO_ROOM:
            return _refuse(f"the output cannot be written: {error.strerror}")
        if error.errno in _NOT_ALLOWED and error.filename is not None:
            return _refuse(f"{error.filename}: cannot be used: {error.strerror}")
        raise
    except MemoryError as error:
        return _refuse(f"there is not enough memory for this: {error}")
    finally:
        logging.getLogger("sightline").removeHandler(warnings)
    return status if isinstance(status, int) else 0


def _refuse(message: str) -> int:
    if message:
        common.say_aside("error:", message, "red")
    return 2
