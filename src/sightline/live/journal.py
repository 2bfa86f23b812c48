"""A log as JSON lines: an object an event, as journald, Loki and jq read it."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from pathlib import Path
from typing import TextIO

from sightline.errors import InputError, OutputError
from sightline.text import json_text, without_secrets
from sightline.types import rfc3339

_BEGINS = '{"time_utc": "'


class JournalHandler(logging.Handler):
    """Writes what the library warns of to a journal."""

    def __init__(self, journal: Journal) -> None:
        super().__init__(logging.WARNING)
        self._journal = journal

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler`."""
        self._journal.write("warning", record.getMessage())


class Journal:
    """Writes what happens, a line an event; any thread may."""

    def __init__(self, path: Path | None) -> None:
        """Open the log.

        Args:
            path: The file, which is added to; ``-``: standard error; None: nothing is written.

        Raises:
            InputError: The file holds something else than such a log.
            OutputError: The file cannot be written.
        """
        self._lock = threading.Lock()
        self._file: TextIO | None = None
        self._own = path is not None and str(path) != "-"
        if path is not None and self._own:
            _check_log(path)
            try:
                self._file = path.open("a", encoding="utf-8")
            except OSError as error:
                raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
        elif path is not None:
            self._file = sys.stderr

    def write(self, kind: str, text: str) -> None:
        """Write an event; a log that cannot be written stops nothing."""
        if self._file is None:
            return
        line = {"time_utc": rfc3339(time.time()), "event": kind, "text": without_secrets(text)}
        with self._lock:
            try:
                self._file.write(json_text(json.dumps(line, ensure_ascii=False)) + "\n")
                self._file.flush()
            except (OSError, ValueError):
                return

    def close(self) -> None:
        """Close the file."""
        if self._file is not None and self._own:
            with self._lock:
                self._file.close()
                self._file = None


def _check_log(path: Path) -> None:
    """Raise where a file is there that is no log to be added to.

    Raises:
        InputError: It is not.
    """
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            begins = file.read(len(_BEGINS))
    except OSError:
        # Who may write a file need not be allowed to read it.
        return
    if begins and begins != _BEGINS.encode():
        raise InputError(
            f"{path}: exists and is not a log that sightline wrote, so nothing is added to it; "
            "give another name"
        )
