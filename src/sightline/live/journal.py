"""A log as JSON lines: an object an event, as journald, Loki and jq read it."""

from __future__ import annotations

import json
import logging
import sys
import threading
import time
from pathlib import Path
from typing import TextIO

from sightline.errors import OutputError
from sightline.text import json_text, without_secrets
from sightline.types import rfc3339


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
            OutputError: The file cannot be written.
        """
        self._lock = threading.Lock()
        self._file: TextIO | None = None
        self._own = path is not None and str(path) != "-"
        if path is not None and self._own:
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
