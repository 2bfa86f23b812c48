"""What a reader read of a file, and what it left out and why."""

from __future__ import annotations

import logging
import os
from dataclasses import dataclass, field

_MOST_TEXT = 60


@dataclass(frozen=True)
class LeftOut:
    """What was left out of a file for one reason.

    Attributes:
        count: How many.
        row: Where the first of them stands, as ``line 12``; empty where there is no such place.
        text: What stands there, shortened; empty where it cannot be shown.
    """

    count: int
    row: str = ""
    text: str = ""


@dataclass
class Tally:
    """Counts of what a reader read and left out, filled while it reads.

    A reader takes one as ``tally=`` from who wants to know; without it, it makes its own and logs
    what it says of things left out, once, when the file has been read.

    Attributes:
        path: The file or stream.
        format: What it was read as, in the field's words: ``NMEA 0183``.
        read: How many of each thing were there, by its plural: ``{"sentences": 213}``.
        left_out: What was not used, by reason, which completes "N left out: ...".
        notes: Sentences on what was assumed or bridged.
    """

    path: str | os.PathLike[str]
    format: str = ""
    read: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, LeftOut] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def count(self, things: str, number: int = 1) -> None:
        """Count things that were there."""
        self.read[things] = self.read.get(things, 0) + number

    def leave_out(self, reason: str, number: int = 1, *, row: str = "", text: str = "") -> None:
        """Count things that are not used; the place and the text of the first are kept.

        Args:
            reason: Why, as it completes "N left out: ...": ``wrong checksum``.
            number: How many; none is no reason.
            row: Where the first stands, as ``line 12``.
            text: What stands there.
        """
        if number <= 0:
            return
        before = self.left_out.get(reason)
        if before is not None:
            self.left_out[reason] = LeftOut(before.count + number, before.row, before.text)
            return
        printable = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
        if len(printable) > _MOST_TEXT:
            printable = f"{printable[: _MOST_TEXT - 3]}..."
        self.left_out[reason] = LeftOut(number, row, printable.strip())

    def note(self, sentence: str) -> None:
        """Keep a sentence on what was assumed or bridged; the same one is kept once."""
        if sentence not in self.notes:
            self.notes.append(sentence)

    @property
    def total_left_out(self) -> int:
        """How many things were left out for any reason."""
        return sum(left.count for left in self.left_out.values())

    def reasons(self) -> str:
        """What was left out, as ``3 with a wrong checksum (line 12: $GPRMC...), 1 ...``."""
        parts = []
        for reason, left in self.left_out.items():
            shown = ": ".join(part for part in (left.row, left.text) if part)
            parts.append(f"{left.count} {reason}" + (f" ({shown})" if shown else ""))
        return ", ".join(parts)

    def warn(self, logger: logging.Logger) -> None:
        """Log one line on what was left out, and one for each note; nothing where there is none."""
        if self.left_out:
            logger.warning("%s: left out: %s", self.path, self.reasons())
        for sentence in self.notes:
            logger.warning("%s: %s", self.path, sentence)
