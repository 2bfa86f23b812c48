"""AIS messages, put together from the sentences that a receiver logged."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

from sightline.formats._sentences import (
    ReceptionClock,
    Sentence,
    SentenceReader,
    sentences_in,
)
from sightline.formats.nmea import clock_s
from sightline.tally import Tally

_CLOCKS = ("RMC", "ZDA")
_REPORTS = ("VDM", "VDO")
_PAYLOAD = re.compile(r"[0-W`-w]+")
_FILL = re.compile(r"\s*([0-5])")
_STATION = re.compile(r"(?:^|,)s:([^,*]+)|^,([rRbB][0-9A-Za-z_]{3,})(?=,|\s|$)")
_GROUP = re.compile(r"(?:^|,)g:\d+-\d+-(\w+)")
_CHANNELS = {"1": "A", "2": "B"}

_APART_S = 1.5
"""Parts of a message are sent in slots that follow each other; logs have whole seconds."""
_APART = 16
"""Most parts of other messages between two parts: ids come again after ten messages."""
_SWAPPED_APART = 8
"""Most where the later part comes first."""
_REPEATS = 4


@dataclass(frozen=True)
class Message:
    """A message all of whose parts are there.

    Attributes:
        first: The sentence of its first part.
        payload: Six bits a character, of all parts.
        fill_bits: How many of the last bits say nothing.
        received_s: POSIX seconds; None where nothing tells.
    """

    first: Sentence
    payload: str
    fill_bits: int
    received_s: float | None


def read_messages(
    path: str | os.PathLike[str], reception: ReceptionClock, tally: Tally
) -> Iterator[Message]:
    """The messages of a log in the order in which they were complete.

    Args:
        path: The log.
        reception: Tells when each sentence was received.
        tally: Takes the sentences, and what is left out of them.
    """
    assembly = _Assembly(tally)
    clocks = iter(SentenceReader(path, _CLOCKS, Tally(path), "sentences"))
    clock, own_s = next(clocks, None), None
    for sentence in SentenceReader(path, _REPORTS, tally, "AIS sentences"):
        while clock is not None and clock.order < sentence.order:
            told_s = clock_s(clock)
            own_s, clock = own_s if told_s is None else told_s, next(clocks, None)
        received_s = reception.time_s(sentence)
        part = _Part.of(sentence, received_s)
        if part is None:
            reason = "AIS sentences that cannot be read"
            tally.leave_out(reason, row=sentence.row, text=sentence.text)
            continue
        parts = assembly.add(part)
        if not parts:
            continue
        times_s = [part.received_s for part in parts if part.received_s is not None]
        if not times_s and own_s is not None:
            times_s = [own_s]
            tally.note(
                "it has no times of reception; those of the RMC or ZDA before are taken for them"
            )
        yield Message(
            first=parts[0].sentence,
            payload="".join(part.payload for part in parts),
            fill_bits=parts[-1].fill_bits,
            received_s=times_s[0] if times_s else None,
        )
    assembly.end()
    if reception.zoneless:
        tally.note("its times of reception name no zone, and are taken to be UTC")


@dataclass(frozen=True)
class _Part:
    sentence: Sentence
    total: int
    number: int
    payload: str
    fill_bits: int
    received_s: float | None

    @classmethod
    def of(cls, sentence: Sentence, received_s: float | None) -> _Part | None:
        """The part that a sentence is; None where it is none."""
        if len(sentence.fields) < 6:
            return None
        total, number, id_, _, payload, fill = sentence.fields[:6]
        filled = _FILL.match(fill)
        if not (re.fullmatch(r"[1-9]", total) and re.fullmatch(r"[1-9]", number)):
            return None
        if int(number) > int(total) or not re.fullmatch(r"\w{0,4}", id_):
            return None
        if not _PAYLOAD.fullmatch(payload) or not filled:
            return None
        return cls(sentence, int(total), int(number), payload, int(filled[1]), received_s)

    @property
    def id(self) -> str:
        """What all parts of a message have in common; empty where it is not told."""
        return self.sentence.fields[2]

    @property
    def key(self) -> tuple[str, int, str]:
        """What all parts of a message have in common, and is always told."""
        return self.sentence.address, self.total, self.id

    @cached_property
    def sender(self) -> tuple[str, str, str]:
        """Channel, station and group of the TAG block; empty where they are not told."""
        channel = self.sentence.fields[3].strip().upper()
        station = _STATION.search(self.sentence.tag) or _STATION.search(self.sentence.after)
        group = _GROUP.search(self.sentence.tag)
        return (
            _CHANNELS.get(channel, channel),
            (station[1] or station[2]) if station else "",
            group[1] if group else "",
        )


@dataclass(eq=False)
class _Waiting:
    """A message of which parts are missing.

    Attributes:
        parts: Those that have come, by their number.
        at: When the last came, counted in parts.
        until_s: By when it had come, by the times around it; None while none is known.
        again: Whether the first to come is the end of a message that is whole: by another station.
    """

    parts: dict[int, _Part]
    at: int
    until_s: float | None
    again: bool

    def may_hold(self, part: _Part) -> bool:
        """Whether nothing tells that a part came another way than these."""
        return all(
            not (theirs and ours) or theirs == ours
            for own in self.parts.values()
            for theirs, ours in zip(own.sender, part.sender, strict=True)
        )


@dataclass
class _Assembly:
    """The parts of messages, put together.

    Attributes:
        tally: Takes the parts whose others are missing.
    """

    tally: Tally
    _waiting: dict[tuple[str, int, str], list[_Waiting]] = field(default_factory=dict)
    _done: deque[str] = field(default_factory=lambda: deque(maxlen=_REPEATS))
    _at: int = 0
    _now_s: float | None = None

    def add(self, part: _Part) -> list[_Part]:
        """All parts of the message that a part completes, in their order; none while some miss."""
        self._tell(part.received_s)
        if part.total == 1:
            return [part]
        self._at += 1
        self._drop_old()
        several = self._waiting.get(part.key, [])
        fitting = [message for message in several if self._fits(message, part)]
        if len(fitting) == 1:
            return self._join(fitting[0], part)
        for message in list(several):
            # Its sender has come round to this id again.
            if part.number in message.parts and message.may_hold(part):
                self._lose(message)
        again = part.number > 1 and part.sentence.body in self._done
        self._waiting.setdefault(part.key, []).append(
            _Waiting({part.number: part}, self._at, part.received_s, again)
        )
        return []

    def end(self) -> None:
        """Count what is still waiting."""
        for message in self._all():
            self._lose(message)

    def _all(self) -> list[_Waiting]:
        return [message for several in self._waiting.values() for message in several]

    def _tell(self, time_s: float | None) -> None:
        if time_s is not None:
            self._now_s = time_s
            for message in self._all():
                message.until_s = time_s if message.until_s is None else message.until_s

    def _fits(self, message: _Waiting, part: _Part) -> bool:
        if part.number in message.parts or not message.may_hold(part):
            return False
        ahead = part.number - max(message.parts)
        if not part.id and ahead != 1:
            # Nothing but the order tells.
            return False
        return self._at - message.at <= (_APART if ahead > 0 else _SWAPPED_APART)

    def _join(self, message: _Waiting, part: _Part) -> list[_Part]:
        message.parts[part.number] = part
        message.at, message.until_s = self._at, part.received_s
        if len(message.parts) < part.total:
            return []
        self._remove(message)
        parts = [message.parts[number] for number in range(1, part.total + 1)]
        self._done.extend(each.sentence.body for each in parts)
        return parts

    def _drop_old(self) -> None:
        for message in self._all():
            late = (
                message.until_s is not None
                and self._now_s is not None
                and abs(self._now_s - message.until_s) > _APART_S
            )
            if late or self._at - message.at > _APART:
                self._lose(message)

    def _lose(self, message: _Waiting) -> None:
        self._remove(message)
        if message.again and len(message.parts) == 1:
            self.tally.count("AIS sentences received again")
            return
        first = min((part.sentence for part in message.parts.values()), key=lambda one: one.order)
        self.tally.leave_out(
            "parts of AIS messages whose other parts are missing",
            len(message.parts),
            row=first.row,
            text=first.text,
        )

    def _remove(self, message: _Waiting) -> None:
        key = next(iter(message.parts.values())).key
        self._waiting[key].remove(message)
        if not self._waiting[key]:
            del self._waiting[key]


class MessageStream:
    """Messages of sentences that come line by line, as from a receiver."""

    def __init__(self, tally: Tally) -> None:
        """Begin.

        Args:
            tally: Takes what is left out.
        """
        self._assembly, self._reception, self._tally = _Assembly(tally), ReceptionClock(), tally
        self._line = 0

    def add(self, text: str) -> Iterator[Message]:
        """The messages that a line completes.

        Args:
            text: The line; a sentence in it that has no checksum, or a wrong one, is left out.
        """
        self._line += 1
        for sentence in sentences_in(self._line, text, frozenset(_REPORTS)):
            if not sentence.whole:
                self._tally.leave_out("AIS sentences with a wrong checksum, or none")
                continue
            received_s = self._reception.time_s(sentence)
            part = _Part.of(sentence, received_s)
            parts = [] if part is None else self._assembly.add(part)
            if parts:
                times_s = [one.received_s for one in parts if one.received_s is not None]
                yield Message(
                    first=parts[0].sentence,
                    payload="".join(one.payload for one in parts),
                    fill_bits=parts[-1].fill_bits,
                    received_s=times_s[0] if times_s else None,
                )
