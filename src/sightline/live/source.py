"""A camera that is watched: its newest frame, whatever happens to it and to the network.

A thread reads. The newest frame waits to be taken, in the place of the one before it; those that
nobody took are counted, so that whoever is slower than the camera falls behind by no more than a
frame. Another thread watches the first, since a stream that hangs says nothing.
"""

from __future__ import annotations

import random
import threading
import time
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Literal, Protocol

import av
import numpy as np
from numpy.typing import NDArray

from sightline.clock import Clock
from sightline.errors import InputError
from sightline.live.capture_times import CaptureTime, CaptureTimes, sender_utc_s
from sightline.moment import CaptureClock
from sightline.tally import Tally
from sightline.text import without_secrets
from sightline.types import Frame
from sightline.video import frames
from sightline.video.containers import film_stream, has_times, open_camera
from sightline.video.conversion import Conversion
from sightline.video.interruption import interruptible
from sightline.video.pictures import MOST_PIXELS

Health = Literal["starting", "ok", "lost", "silent", "frozen", "black", "resized", "ended"]
"""How a source is."""

EventKind = Literal[
    "connected",
    "refused",
    "lost",
    "silent",
    "frozen",
    "black",
    "resized",
    "resumed",
    "clock-stepped",
    "clock-wrong",
    "ended",
]
"""What happens to a source."""

_LOOKS_APART_S = 0.1
_CLOSE_S = 1.0
_EVERY = 8
_DARK, _FLAT = 26.0, 3.0
_MOST_FAILURES = 25


@dataclass(frozen=True)
class SourceEvent:
    """Something that happened to a source.

    Attributes:
        kind: What.
        time_utc_s: When, by this machine's clock.
        text: In words, without secrets.
    """

    kind: EventKind
    time_utc_s: float
    text: str


@dataclass(frozen=True)
class SourceSettings:
    """Settings of a source.

    Attributes:
        size_px: Width and height that pictures must have; others are not handed on. None: any.
        options: Of FFmpeg, for the camera's address.
        clock: Whose clock tells capture times: ``"auto"``, ``"sender"`` or ``"arrival"``.
        largest_clock_error_s: How far a camera's clock may be off before arrival is gone by.
        open_s: How long a camera may take to answer.
        silent_s: Without a frame for so long, the connection is made anew.
        frozen_s: Pictures that stay the same for so long are of a camera that hangs.
        black_s: Pictures that are black for so long are of a camera that sees nothing.
        first_wait_s: Before the first attempt to connect again; each wait is twice the one before.
        longest_wait_s: The longest of them.
    """

    size_px: tuple[int, int] | None = None
    options: Mapping[str, str] = field(default_factory=dict)
    clock: str = "auto"
    largest_clock_error_s: float = 30.0
    open_s: float = 10.0
    silent_s: float = 5.0
    frozen_s: float = 10.0
    black_s: float = 5.0
    first_wait_s: float = 0.5
    longest_wait_s: float = 5.0

    def __post_init__(self) -> None:
        for name in ("open_s", "silent_s", "frozen_s", "black_s", "first_wait_s", "longest_wait_s"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"source: {name} is {getattr(self, name):g}; expected above 0")
        if self.clock not in ("auto", "sender", "arrival"):
            raise InputError(f"source: clock is {self.clock!r}; known are auto, sender and arrival")


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A frame of a source.

    Attributes:
        frame: Picture and capture time.
        capture: Whose clock the capture time is of.
        sigma_s: Its standard deviation.
        arrived_s: When it came, by `time.monotonic`.
        clock_step_s: By how much that clock was set since the frame that was taken before.
    """

    frame: Frame
    capture: CaptureClock
    sigma_s: float
    arrived_s: float
    clock_step_s: float = 0.0


@dataclass
class SourceCounts:
    """Counts of a source.

    Attributes:
        seen: Frames that came.
        left_out: Those that nobody took in time.
        paused: Those that were of no use: frozen, black, of another size, damaged.
        taken: Those that were taken.
        connections: How often it was connected.
        events: Events by kind.
    """

    seen: int = 0
    left_out: int = 0
    paused: int = 0
    taken: int = 0
    connections: int = 0
    events: Counter[str] = field(default_factory=Counter)

    @property
    def reconnections(self) -> int:
        """How often it was connected again."""
        return max(0, self.connections - 1)


class Source(Protocol):
    """What hands on the newest frame of a camera, or of what is played as one.

    Attributes:
        counts: Of its frames.
        health: How it is.
        reason: Why it is not well, in words; empty where it is.
    """

    counts: SourceCounts
    health: Health
    reason: str

    def start(self) -> None:
        """Begin to read."""
        ...

    def take(self, timeout_s: float) -> LiveFrame | None:
        """The newest frame; None where there was none for so long, or there are no more."""
        ...

    def age_s(self) -> float | None:
        """Seconds since the last frame came; None before there was one."""
        ...

    def close(self) -> None:
        """Read no further, and let go of threads and sockets."""
        ...


Listener = Callable[[SourceEvent], None]
_Make = Callable[[], NDArray[np.uint8]]


class _Reader(ABC):
    """What sources have in common: threads, the newest frame, counts, and events."""

    def __init__(self, name: str, settings: SourceSettings, listener: Listener | None) -> None:
        self.counts = SourceCounts()
        self.health: Health = "starting"
        self.reason = ""
        self._name, self._settings, self._listener = name, settings, listener
        self._stop = threading.Event()
        self._changed = threading.Condition()
        self._newest: tuple[LiveFrame, _Make] | None = None
        self._step_s = 0.0
        self._last_utc_s = -np.inf
        self._arrived_s: float | None = None
        self._picture = _PictureWatch(settings)
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """See `Source`."""
        self._begin(self._read, "sightline-reader")

    def take(self, timeout_s: float) -> LiveFrame | None:
        """See `Source`."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while self._newest is None:
                left_s = until_s - time.monotonic()
                if left_s <= 0.0 or self.health == "ended" or self._stop.is_set():
                    return None
                self._changed.wait(left_s)
            waiting, make = self._newest
            self._newest = None
            self.counts.taken += 1
            step_s, self._step_s = self._step_s, 0.0
        frame = Frame(waiting.frame.index, waiting.frame.time_utc_s, make())
        return LiveFrame(frame, waiting.capture, waiting.sigma_s, waiting.arrived_s, step_s)

    def age_s(self) -> float | None:
        """See `Source`."""
        return None if self._arrived_s is None else time.monotonic() - self._arrived_s

    def close(self) -> None:
        """See `Source`."""
        self._stop.set()
        with self._changed:
            self._newest = None
            self._changed.notify_all()
        until_s = time.monotonic() + _CLOSE_S
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(max(0.0, until_s - time.monotonic()))

    @abstractmethod
    def _read(self) -> None:
        """Put frames in the place of the newest until there are no more."""

    def _begin(self, target: Callable[[], None], name: str) -> None:
        thread = threading.Thread(target=target, daemon=True, name=name)
        self._threads.append(thread)
        thread.start()

    def _tell(self, kind: EventKind, text: str) -> None:
        event = SourceEvent(kind, time.time(), without_secrets(f"{self._name}: {text}"))
        self.counts.events[kind] += 1
        if self._listener is not None:
            self._listener(event)

    def _become(self, health: Health, text: str) -> None:
        """Change how the source is; told once."""
        if health == self.health:
            return
        before, self.health = self.health, health
        self.reason = "" if health == "ok" else without_secrets(text)
        if health == "ok":
            if before != "starting":
                self._tell("resumed", f"{text} (after: {before})")
        elif health in ("silent", "frozen", "black", "resized", "lost", "ended"):
            self._tell(health, text)

    def _admit(self, found: CaptureTime, arrived_s: float, picture: _Seen, step_s: float) -> None:
        """Put a frame in the place of the newest, if it is of use."""
        self.counts.seen += 1
        self._arrived_s = arrived_s
        health, text = self._picture.look(picture, arrived_s)
        if health != "ok":
            self.counts.paused += 1
            self._become(health, text)
            return
        self._become("ok", "frames come")
        if step_s:
            self._tell("clock-stepped", f"its clock was set by {step_s:+.3f} s")
            self._last_utc_s += step_s
        if not found.utc_s > self._last_utc_s:
            self.counts.left_out += 1
            with self._changed:
                self._step_s += step_s
            return
        self._last_utc_s = found.utc_s
        frame = Frame(self.counts.seen - 1, found.utc_s, _NOTHING)
        live = LiveFrame(frame, found.clock, found.sigma_s, arrived_s)
        with self._changed:
            self._step_s += step_s
            if self._newest is not None:
                self.counts.left_out += 1
            self._newest = live, picture.make
            self._changed.notify_all()


_NOTHING: NDArray[np.uint8] = np.zeros((1, 1, 3), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A picture that came.

    Attributes:
        size_px: Width and height as shown.
        sample: Some of its brightnesses.
        make: Makes the picture in BGR.
    """

    size_px: tuple[int, int]
    sample: NDArray[np.uint8]
    make: _Make


class _PictureWatch:
    """Notices pictures that show nothing new, nothing at all, or have another size."""

    def __init__(self, settings: SourceSettings) -> None:
        self._settings = settings
        self._mark: int | None = None
        self._same_since_s = self._light_s = -np.inf

    def look(self, picture: _Seen, now_s: float) -> tuple[Health, str]:
        """How the source is by its newest picture, and why."""
        settings = self._settings
        if settings.size_px is not None and picture.size_px != settings.size_px:
            return "resized", (
                "its pictures have {} x {} px, and the model learned from {} x {} px; paused until "
                "they have again".format(*picture.size_px, *settings.size_px)
            )
        sample = picture.sample
        mark = zlib.crc32(sample.tobytes())
        if mark != self._mark:
            self._mark, self._same_since_s = mark, now_s
        if sample.mean() > _DARK or sample.std() > _FLAT or self._light_s == -np.inf:
            self._light_s = now_s
        if now_s - self._light_s >= settings.black_s:
            return "black", f"its picture has been black for {settings.black_s:g} s; paused"
        if now_s - self._same_since_s >= settings.frozen_s:
            return "frozen", (
                f"its picture has been the same for {settings.frozen_s:g} s; paused until it moves"
            )
        return "ok", ""


class CameraSource(_Reader):
    """A camera at an address, connected again whenever it is lost; see `Source`."""

    def __init__(
        self,
        address: str,
        settings: SourceSettings | None = None,
        listener: Listener | None = None,
    ) -> None:
        """Take the camera; `start` connects to it.

        Args:
            address: RTSP, RTMP, SRT, HTTP, UDP, TCP, or a video device; may hold credentials,
                which are never told.
            settings: How it is watched.
            listener: Is told what happens, from the threads that read and watch.
        """
        settings = settings or SourceSettings()
        super().__init__(without_secrets(address), settings, listener)
        self._address = address
        self._times = CaptureTimes(settings.clock, settings.largest_clock_error_s)
        self._leave = threading.Event()
        self._reading_since_s: float | None = None
        self._told_wrong = False
        self._failures = 0

    def probe(self) -> tuple[int, int]:
        """Connect once, and return the size of the first picture.

        Raises:
            InputError: It does not answer, refuses, or sends no picture.
        """
        with interruptible(self._stop.is_set):
            container, stream, conversion = self._opened()
            try:
                for packet in container.demux(stream):
                    for picture in _decoded(packet):
                        return conversion.shown_px(picture)
            except (av.FFmpegError, OSError) as error:
                raise InputError(f"{self._name}: sends no picture ({_why(error)})") from error
            finally:
                container.close()
        raise InputError(f"{self._name}: sends no picture that can be decoded")

    def start(self) -> None:
        """See `Source`."""
        super().start()
        self._begin(self._watch, "sightline-watchdog")

    def _read(self) -> None:
        wait_s = self._settings.first_wait_s
        with interruptible(lambda: self._stop.is_set() or self._leave.is_set()):
            while not self._stop.is_set():
                self._leave.clear()
                seen = self.counts.seen
                self._connection()
                if self.counts.seen > seen:
                    wait_s = self._settings.first_wait_s
                # Many that lose one server at once are not to come back at once.
                self._stop.wait(wait_s * random.uniform(0.5, 1.0))  # noqa: S311
                wait_s = min(2.0 * wait_s, self._settings.longest_wait_s)

    def _connection(self) -> None:
        """One connection, from its beginning to its end."""
        try:
            container, stream, conversion = self._opened()
        except Exception as error:
            if not self._stop.is_set():
                self._refused(str(error) or type(error).__name__)
            return
        reason = "it has ended, or its connection was closed"
        try:
            self.counts.connections += 1
            self._tell("connected", f"connected, {stream.codec_context.name}")
            self._times.connected()
            self._failures = 0
            self._reading_since_s = time.monotonic()
            for packet in container.demux(stream):
                self._packet(packet, container, stream, conversion)
                if self._stop.is_set() or self._leave.is_set():
                    break
        # What decoders raise is no closed set, and a camera is connected again whatever it was.
        except Exception as error:
            reason = _why(error)
        finally:
            self._reading_since_s = None
            container.close()
        if not self._stop.is_set():
            # What was silent before is told once.
            self._lost(reason)

    def _refused(self, text: str) -> None:
        self.reason = without_secrets(text)
        self.counts.events["refused"] += 1
        if self.health not in ("lost", "silent"):
            self._become("lost", f"cannot be connected to: {text}")

    def _lost(self, reason: str) -> None:
        if self.health not in ("silent", "lost"):
            self._become("lost", f"its connection is lost: {reason}")

    def _opened(
        self,
    ) -> tuple[av.container.InputContainer, av.VideoStream, Conversion]:
        settings = self._settings
        container = open_camera(
            self._address,
            self._name,
            options=settings.options,
            # The watchdog asks for frames; this is for what sends nothing at all.
            timeout_s=(settings.open_s, 2.0 * settings.silent_s),
        )
        try:
            stream = film_stream(container, self._name)
        except InputError:
            container.close()
            raise
        stream.codec_context.options = {"max_pixels": str(MOST_PIXELS)}
        # Threads that each decode a picture hold as many back.
        stream.thread_type = "SLICE"
        return container, stream, Conversion(stream, self._name, Tally(self._name))

    def _packet(
        self,
        packet: av.Packet[av.VideoStream],
        container: av.container.InputContainer,
        stream: av.VideoStream,
        conversion: Conversion,
    ) -> None:
        arrived_s = time.monotonic()
        tick_s = float(stream.time_base or 0)
        if packet.pts is not None:
            presented_s = float(packet.pts) * tick_s
            reported_s = sender_utc_s(packet)
            if reported_s is None and container.start_time_realtime:
                reported_s = container.start_time_realtime * 1e-6 + presented_s
            if reported_s is not None:
                self._times.report(presented_s, reported_s, arrived_s)
        timed = has_times(container)
        for picture in self._pictures(packet):
            at_s = float(picture.pts) * tick_s if picture.pts is not None and timed else None
            found = self._times.of(at_s, arrived_s)
            self._look_at_sender()
            sample = _sample(picture)
            make = _maker(conversion, picture)
            seen = _Seen(conversion.shown_px(picture), sample, make)
            self._admit(found, arrived_s, seen, self._times.step_s())

    def _pictures(self, packet: av.Packet[av.VideoStream]) -> list[av.VideoFrame]:
        try:
            pictures = _decoded(packet)
        except av.error.InvalidDataError:
            # Lost bytes cost a picture or two, not the connection.
            self._failures += 1
            self.counts.paused += 1
            if self._failures > _MOST_FAILURES:
                raise
            return []
        whole = [picture for picture in pictures if not picture.is_corrupt]
        self.counts.paused += len(pictures) - len(whole)
        if whole:
            self._failures = 0
        return whole

    def _look_at_sender(self) -> None:
        off_s = self._times.sender_off_s
        wrong = off_s is not None and abs(off_s) > self._settings.largest_clock_error_s
        if wrong and off_s is not None and not self._told_wrong:
            self._tell(
                "clock-wrong",
                f"its clock is {off_s:+.1f} s off from this machine's; "
                + ("it is gone by all the same" if self._times.believed else "arrival is gone by"),
            )
        self._told_wrong = wrong

    def _watch(self) -> None:
        """Notice that no frame comes, and have the connection made anew."""
        while not self._stop.wait(_LOOKS_APART_S):
            since_s = self._reading_since_s
            if since_s is None:
                continue
            last_s = max(since_s, self._arrived_s or since_s)
            silent_s = time.monotonic() - last_s
            if silent_s > self._settings.silent_s and not self._leave.is_set():
                self._become(
                    "silent", f"no frame came for {self._settings.silent_s:g} s; connecting anew"
                )
                self._leave.set()


class PlayedSource(_Reader):
    """A recording that is played at its own pace, as if it were happening; see `Source`."""

    def __init__(
        self,
        path: Path,
        settings: SourceSettings | None = None,
        listener: Listener | None = None,
        *,
        clock: Clock | None = None,
        start_utc_s: float | None = None,
        speed: float = 1.0,
    ) -> None:
        """Take the recording.

        Args:
            path: A video, or a folder of frames.
            settings: How it is watched.
            listener: Is told what happens.
            clock: Tells the times of frames.
            start_utc_s: POSIX seconds of a video's first frame.
            speed: How much faster than its own pace it is played.
        """
        super().__init__(str(path), settings or SourceSettings(), listener)
        if not 0.0 < speed < np.inf:
            raise InputError(f"{path}: cannot be played at a speed of {speed:g}; expected above 0")
        self._path, self._clock, self._start_utc_s, self._speed = path, clock, start_utc_s, speed

    def probe(self) -> tuple[int, int]:
        """Size of the first picture.

        Raises:
            InputError: There is none.
        """
        for frame in self._frames():
            return frame.image_bgr.shape[1], frame.image_bgr.shape[0]
        raise InputError(f"{self._path}: holds no frame")

    def _frames(self) -> Iterator[Frame]:
        return frames(self._path, clock=self._clock, start_utc_s=self._start_utc_s)

    def _read(self) -> None:
        text = "it has been played to its end"
        try:
            self._play()
        except Exception as error:
            text = str(error) or type(error).__name__
        with self._changed:
            if not self._stop.is_set():
                self._become("ended", text)
            self._changed.notify_all()

    def _play(self) -> None:
        first_utc_s = first_s = None
        for frame in self._frames():
            if first_s is None or first_utc_s is None:
                first_s, first_utc_s = time.monotonic(), frame.time_utc_s
                self.counts.connections = 1
                self._tell("connected", f"is played at {self._speed:g} times its pace")
            due_s = first_s + (frame.time_utc_s - first_utc_s) / self._speed
            timed = bool(np.isfinite(frame.time_utc_s))
            if timed and self._stop.wait(max(0.0, due_s - time.monotonic())):
                return
            if self._stop.is_set():
                return
            now_s = time.monotonic()
            found = CaptureTime(time.time(), "arrival", 0.1)
            if timed:
                sigma_s = 0.0
                if self._clock is not None:
                    sigma_s = float(self._clock.sigma_s(np.array([frame.index]))[0])
                found = CaptureTime(frame.time_utc_s, "sender", sigma_s)
            image = frame.image_bgr
            sample = np.ascontiguousarray(image[::_EVERY, ::_EVERY, 1])
            seen = _Seen((image.shape[1], image.shape[0]), sample, partial(_same, image))
            self._admit(found, now_s, seen, 0.0)


def _same(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image


def _decoded(packet: av.Packet[av.VideoStream]) -> list[av.VideoFrame]:
    return list(packet.decode())


def _maker(conversion: Conversion, picture: av.VideoFrame) -> _Make:
    return lambda: conversion.to_bgr(picture)


def _sample(picture: av.VideoFrame) -> NDArray[np.uint8]:
    """Some of the brightnesses of a picture: of its first plane, which is that of the luma."""
    plane = picture.planes[0]
    rows = np.frombuffer(memoryview(plane), dtype=np.uint8)
    rows = rows[: plane.line_size * plane.height].reshape(plane.height, plane.line_size)
    return np.ascontiguousarray(rows[::_EVERY, : plane.width : _EVERY])


def _why(error: Exception) -> str:
    if isinstance(error, av.error.ExitError):
        return "it said nothing"
    return without_secrets(getattr(error, "strerror", None) or str(error) or type(error).__name__)
