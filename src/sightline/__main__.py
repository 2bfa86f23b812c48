"""`python -m sightline`, and the installed command: the command line.

Signals are heard, and the standard streams are there, before anything is loaded that takes time.
"""

import os
import sys
from contextlib import suppress

from sightline import signals


def main() -> None:
    """Run the command line and exit."""
    _open_standard_streams()
    try:
        signals.install()
        from sightline.cli import main as run

        run()
    except SystemExit as error:
        if signals.broken_off():
            _leave(int(error.code or 0))
        raise
    except BaseException:
        # Broken off while a library was loaded, which may have made something else of it.
        if not signals.broken_off():
            raise
        with suppress(OSError):
            sys.stderr.write("stopped\n")
        _leave(signals.status())
    finally:
        # All is written. Whoever still asks to stop waits for no more than the end.
        signals.uninstall()


def _leave(status: int) -> None:
    """Exit without more ado: Python may take its own exit for that of an interrupt."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            if stream is not None:
                stream.flush()
    os._exit(status)


def _open_standard_streams() -> None:
    """Open those that are closed: the next file would take their numbers, and what is printed."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


if __name__ == "__main__":
    main()
