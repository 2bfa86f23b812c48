"""Signals by which somebody asks a command to stop: Ctrl-C, `kill`, a terminal that is closed.

Where a command can end with what it has (`stoppable`), and has something, the first of them only
sets an event. Else, and from the second on, the command is broken off where it stands; nothing half
is left, since files get their names when they are whole.

A service reads its configuration again when it is sent SIGHUP, unless its terminal was closed.

Nothing here loads a library, so that it is in place before any other module is.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sightline.stopping import Stop

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


class _Asked:
    """By what somebody asked, and what hears of it."""

    def __init__(self) -> None:
        self.number = 0
        self.event: Stop | None = None
        self.reread: threading.Event | None = None
        self.has_terminal = False
        self.broken_off = False


_asked = _Asked()


def install() -> None:
    """Handle the signals from now on, except those that whoever started the program ignores."""
    _asked.number = 0
    _asked.broken_off = False
    if threading.current_thread() is not threading.main_thread():
        return
    for name in _NAMES:
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _hear)


def uninstall() -> None:
    """Let the signals end the process, as they do where nobody handles them."""
    if threading.current_thread() is threading.main_thread():
        for name in _NAMES:
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) is _hear:
                signal.signal(number, signal.SIG_DFL)


@contextmanager
def installed() -> Iterator[None]:
    """Handle the signals while the block lasts."""
    before = {
        name: signal.getsignal(getattr(signal, name)) for name in _NAMES if hasattr(signal, name)
    }
    install()
    try:
        yield
    finally:
        if threading.current_thread() is threading.main_thread():
            for name, handler in before.items():
                signal.signal(getattr(signal, name), handler)


@contextmanager
def stoppable(reread: threading.Event | None = None) -> Iterator[Stop]:
    """An event that the first signal sets while the block lasts, instead of breaking it off.

    Args:
        reread: Is set by SIGHUP, which then stops nothing; None: it asks to stop as well.

    Before something was seen of the source, there is nothing to end, and it is broken off.

    Ctrl-C is heard even where a shell ignores it for what runs in the background: who sends it to
    this process means it.
    """
    event = Stop()
    main = threading.current_thread() is threading.main_thread()
    ignored = main and signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, _hear)
    _asked.event, _asked.reread = event, reread
    _asked.has_terminal = _terminal_is_there()
    try:
        yield event
    finally:
        _asked.event = _asked.reread = None
        if ignored:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


def broken_off() -> bool:
    """Whether a signal broke the command off where it stood."""
    return _asked.broken_off


def status() -> int:
    """Exit status of a command that was broken off: 128 and the number of the signal."""
    return 128 + (_asked.number or signal.SIGINT)


def _terminal_is_there() -> bool:
    try:
        os.close(os.open("/dev/tty", os.O_RDWR))
    except OSError:
        return False
    return True


def _hear(number: int, _frame: FrameType | None) -> None:
    # A terminal that was closed has gone; a service had none.
    hung_up = _asked.has_terminal and not _terminal_is_there()
    if number == getattr(signal, "SIGHUP", None) and _asked.reread is not None and not hung_up:
        _asked.reread.set()
        return
    _asked.number = number
    event = _asked.event
    if event is not None and event.begun and not event.is_set():
        event.set()
        return
    if _asked.broken_off:
        # Not even what was begun to be removed is waited for.
        os._exit(128 + number)
    _asked.broken_off = True
    raise KeyboardInterrupt
