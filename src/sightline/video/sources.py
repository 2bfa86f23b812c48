"""Packets of a video: from a file as they are asked for, from a stream as they arrive."""

from __future__ import annotations

import atexit
import errno
import itertools
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol

import av
import av.container.core

from sightline.errors import InputError
from sightline.tally import Tally
from sightline.video import containers
from sightline.video.containers import (
    film_stream,
    has_times,
    is_address,
    is_cut_short,
    is_live,
    open_container,
)
from sightline.video.pictures import MOST_PIXELS

# How often a demuxer may fail in a row before the video counts as broken off.
_MOST_FAILURES = 10
_MOST_PACKETS = 1024
# Of a transport stream so much is searched for its next packet at once.
_SEARCHED_BYTES = 32768
# What a stream hands over so soon after its opening has waited since before.
_WAITING_S = 0.05
_LOOK_S = 0.25
# FFmpeg asks whether it shall wait on ten times a second.
_LEAVE_S = 1.0

_receivers: dict[threading.Thread, threading.Event] = {}


class BreakError(Exception):
    """A video cannot be read further; the message completes "breaks off after N frames (...)"."""


class Source(Protocol):
    """An opened video.

    Attributes:
        container: What the stream is in.
        stream: The film among its streams.
        live: Whether it has no end; its frames are of the time of their arrival.
    """

    container: av.container.InputContainer
    stream: av.VideoStream
    live: bool

    def packets(self) -> Iterator[av.Packet[av.VideoStream]]:
        """The packets of the stream.

        Raises:
            BreakError: It cannot be read further.
        """
        ...

    def arrival_s(self) -> float:
        """POSIX seconds at which the last packet arrived; never less than before."""
        ...

    def close(self) -> None:
        """Read no further."""
        ...


def open_source(name: str, tally: Tally) -> Source:
    """Open a file or a stream; see `open_container`."""
    source: Source = StreamSource(name, tally) if is_address(name) else FileSource(name, tally)
    tally.format = source.container.format.long_name
    # What a header says of the size, pictures need not keep to.
    source.stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
    # Threads that each decode a picture hold as many back, which a stream's times would show.
    source.stream.thread_type = "SLICE" if source.live else "AUTO"
    return source


class FileSource:
    """A video file; see `Source`."""

    live = False

    def __init__(self, name: str, tally: Tally) -> None:
        self._name = name
        self.container = open_container(name)
        try:
            self.stream = film_stream(self.container, name, tally)
        except InputError:
            self.container.close()
            raise

    def packets(self) -> Iterator[av.Packet[av.VideoStream]]:
        """The packets, past places that are damaged."""
        yield from _demuxed(self.container, self.stream)
        if is_cut_short(Path(self._name), self.container.format.name):
            raise BreakError("it is shorter than it says")

    def arrival_s(self) -> float:
        """Of no use: a file is there as a whole."""
        return time.time()

    def close(self) -> None:
        """Close the file."""
        self.container.close()


class StreamSource:
    """A stream at an address; see `Source`.

    A thread waits for it, since who waits inside FFmpeg hears no Ctrl-C, and since a packet has
    arrived when it has arrived, however long the frame before it is worked on.
    """

    def __init__(self, name: str, tally: Tally) -> None:
        self._queue: queue.Queue[object] = queue.Queue(_MOST_PACKETS)
        self._stop = threading.Event()
        self._arrival_s = 0.0
        receiver = threading.Thread(
            target=_receive, args=(name, self._queue, self._stop), daemon=True, name=name
        )
        for ended in [one for one in list(_receivers) if not one.is_alive()]:
            del _receivers[ended]
        receiver.start()
        _receivers[receiver] = self._stop
        opened = self._next()
        if isinstance(opened, Exception):
            raise opened
        assert isinstance(opened, av.container.InputContainer)
        self.container = opened
        self.live = is_live(opened, name)
        self.stream = film_stream(opened, name, tally)

    def packets(self) -> Iterator[av.Packet[av.VideoStream]]:
        """The packets, as they arrive."""
        while True:
            received = self._next()
            if isinstance(received, BreakError):
                raise received
            if received is None:
                if self.live:
                    raise BreakError("it has ended")
                return
            assert isinstance(received, tuple)
            arrival_s, packet = received
            self._arrival_s = max(self._arrival_s, arrival_s)
            yield packet

    def arrival_s(self) -> float:
        """POSIX seconds at which the last packet arrived."""
        return self._arrival_s

    def close(self) -> None:
        """Let the thread end; it closes the stream when it next hears of it."""
        self._stop.set()

    def __del__(self) -> None:
        self._stop.set()

    def _next(self) -> object:
        while True:
            try:
                return self._queue.get(timeout=_LOOK_S)
            except queue.Empty:
                continue


@atexit.register
def _leave_streams() -> None:
    """End the threads that wait for streams.

    While FFmpeg waits it asks PyAV whether it shall wait on, and whoever asks that while Python
    ends is ended in the middle of FFmpeg, the process with it (a segmentation fault). PyAV has no
    way to end a wait but the clock that it looks at.
    """
    waiting = [receiver for receiver in list(_receivers) if receiver.is_alive()]
    if not waiting:
        return
    for receiver in waiting:
        _receivers[receiver].set()
    hours = itertools.count(1e12, 3600.0)
    av.container.core.time = SimpleNamespace(monotonic=lambda: next(hours))  # type: ignore[attr-defined]
    for receiver in waiting:
        receiver.join(_LEAVE_S)


def _receive(name: str, received: queue.Queue[object], stop: threading.Event) -> None:
    """Put a container into a queue, then its packets with the times of their arrival."""

    def put(what: object) -> bool:
        while not stop.is_set():
            try:
                received.put(what, timeout=_LOOK_S)
            except queue.Full:
                continue
            return True
        return False

    begun_s = time.time()
    try:
        container = open_container(name)
        stream = film_stream(container, name)
    except Exception as error:  # It is raised where it is waited for
        put(error)
        return
    if not put(container):
        return
    try:
        for stamped in _stamped(container, stream, begun_s):
            if not put(stamped):
                return
    except BreakError as error:
        put(error)
    else:
        put(None)


def _stamped(
    container: av.container.InputContainer, stream: av.VideoStream, begun_s: float
) -> Iterator[tuple[float, av.Packet[av.VideoStream]]]:
    """Packets with their times of arrival.

    What had arrived while FFmpeg found out what it is comes all at once. Its times are told by
    its own clock, or by the pace of the first two that are waited for.
    """
    opened_s = time.time()
    waiting: list[av.Packet[av.VideoStream]] = []
    paced: list[tuple[float, av.Packet[av.VideoStream]]] | None = []
    packets = _demuxed(container, stream)
    broken: BreakError | None = None
    while broken is None:
        try:
            packet = next(packets, None)
        except BreakError as error:
            broken, packet = error, None
        now_s = time.time()
        if packet is not None and paced is None:
            yield now_s, packet
            continue
        if packet is not None and paced is not None:
            if not paced and now_s - opened_s < _WAITING_S:
                waiting.append(packet)
                continue
            paced.append((now_s, packet))
        if paced is not None and (packet is None or len(paced) == 2 or not waiting):
            yield from _before(waiting, paced, begun_s, timed=has_times(container))
            yield from paced
            paced = None
        if packet is None:
            break
    if broken is not None:
        raise broken


def _before(
    waiting: list[av.Packet[av.VideoStream]],
    paced: list[tuple[float, av.Packet[av.VideoStream]]],
    begun_s: float,
    *,
    timed: bool,
) -> Iterator[tuple[float, av.Packet[av.VideoStream]]]:
    """Packets that had waited, with the times at which they may have come."""
    until_s = paced[0][0] if paced else time.time()
    pace_s = (until_s - begun_s) / max(len(waiting), 1)
    if len(paced) == 2:
        pace_s = paced[1][0] - paced[0][0]
    reference = paced[0][1].dts if timed and paced else None
    for number, packet in enumerate(waiting):
        earlier_s = (len(waiting) - number) * pace_s
        if reference is not None and packet.dts is not None:
            earlier_s = float((reference - packet.dts) * packet.time_base)
        yield min(max(begun_s, until_s - earlier_s), until_s), packet


def _demuxed(
    container: av.container.InputContainer, stream: av.VideoStream
) -> Iterator[av.Packet[av.VideoStream]]:
    failures = 0
    # Behind so many bytes without a packet a file is asked again, to its end: what was written
    # before them comes then.
    searches = 0 if container.size <= 0 else container.size // _SEARCHED_BYTES + _MOST_FAILURES
    while True:
        try:
            for packet in container.demux(stream):
                failures = 0
                yield packet
        except av.error.BlockingIOError as error:
            searches -= 1
            if searches < 0:
                raise BreakError(_reason(error)) from error
        except av.FFmpegError as error:
            failures += 1
            if failures > _MOST_FAILURES or not isinstance(error, av.error.InvalidDataError):
                raise BreakError(_reason(error)) from error
        else:
            return


def _reason(error: av.FFmpegError) -> str:
    # FFmpeg says so of whoever interrupts it, here its own time limit.
    if isinstance(error, av.error.ExitError):
        return f"it said nothing for {containers.SILENCE_TIMEOUT_S:g} s"
    # Of an address whose connection is closed.
    if error.errno == errno.EIO and not isinstance(error, av.error.InvalidDataError):
        return "it has ended, or its connection was closed"
    return error.strerror or "it cannot be decoded"
