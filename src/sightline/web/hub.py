"""What the pages show: the newest moment, those who listen, and how it goes."""

from __future__ import annotations

import asyncio
import math
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Protocol

from sightline.formats.tiles import Tiles
from sightline.moment import Moment
from sightline.text import encodable_text
from sightline.web.memory import TrackMemory

_QUEUE = 2


class Kept(Protocol):
    """What was published before, as a store has it."""

    def extent_utc_s(self) -> tuple[float, float] | None:
        """Times of the first and the last moment; None where there is none."""

    def moments(self, from_utc_s: float, seconds: float, step_s: float) -> list[Moment]:
        """Moments of a part of the time, one a step."""


class OnTheMap(Protocol):
    """The newest picture as it lies on the map."""

    @property
    def possible(self) -> bool:
        """Whether there can be one."""

    def about(self) -> dict[str, object] | None:
        """Where it lies; None where there is none."""

    def picture(self) -> bytes | None:
        """It, as WebP; None where there is none."""


_SILENT_S = 30.0
# Each metric, the key of a line or zone that it has, and which way that is.
_COUNTED = {
    "line_crossings_total": ("left_to_right", "left_to_right"),
    "line_crossings_total ": ("right_to_left", "right_to_left"),
    "zone_inside": ("inside", ""),
    "zone_entries_total": ("entries", ""),
    "zone_exits_total": ("exits", ""),
    "zone_mean_dwell_seconds": ("mean_dwell_s", ""),
    "zone_longest_dwell_seconds": ("longest_dwell_s", ""),
}
_NOT_IN_A_NAME = re.compile("[^a-zA-Z0-9_]+")


def message(moment: Moment) -> str | None:
    """The text of a moment; None where a number in it is none, which JSON does not know."""
    try:
        return moment.text
    except ValueError:
        return None


class Listener:
    """A WebSocket: the two newest messages that it has not got yet."""

    def __init__(self) -> None:
        self.dropped = 0
        self._waiting: deque[Moment] = deque()
        self._newest: Moment | None = None
        self._wake = asyncio.Event()
        self._closed = False

    def offer(self, moment: Moment) -> bool:
        """Hand a moment over; False where one had to give way to it."""
        # One that came while this one was let in is here already.
        if moment is self._newest:
            return True
        self._newest = moment
        full = len(self._waiting) == _QUEUE
        if full:
            self._waiting.popleft()
            self.dropped += 1
        self._waiting.append(moment)
        self._wake.set()
        return not full

    def close(self) -> None:
        """Let whoever waits go."""
        self._closed = True
        self._wake.set()

    async def next(self) -> Moment | None:
        """The oldest that waits; None at the end."""
        while not self._waiting and not self._closed:
            self._wake.clear()
            await self._wake.wait()
        return None if self._closed else self._waiting.popleft()


class Hub:
    """Takes moments from any thread, and hands them to those who listen in the server's.

    Args:
        health: Numbers, and a ``state`` that is ``ok`` or else has a ``reason``.
        picture: The newest picture as JPEG; None where there is none.
        store: The file of what is kept, whose size is told.
        shore: GeoJSON of the user's, which the map shows.
        tiles: A basemap of the user's, which it shows as well.
    """

    def __init__(
        self,
        *,
        health: Callable[[], dict[str, object]] | None = None,
        picture: Callable[[], bytes | None] | None = None,
        store: Path | None = None,
        shore: bytes | None = None,
        tiles: Tiles | None = None,
    ) -> None:
        self.picture = picture
        self.shore, self.tiles = shore, tiles
        self.on_the_map: OnTheMap | None = None
        self.store = store
        self.boundaries: Mapping[str, object] | None = None
        self.kept: Kept | None = None
        self.memory = TrackMemory()
        self.newest: Moment | None = None
        self.listeners: set[Listener] = set()
        self.moments = 0
        self.dropped = 0
        self._health = health
        self._arrived_s = -math.inf
        self._loop: asyncio.AbstractEventLoop | None = None
        self._new: deque[Moment] = deque(maxlen=_QUEUE)
        self._lock = threading.Lock()
        self._called = False

    def attach(self, loop: asyncio.AbstractEventLoop | None) -> None:
        """Say in which loop listeners live; None: in none any more."""
        with self._lock:
            self._loop = loop

    def publish(self, moment: Moment) -> None:
        """Take a moment over; returns at once, whoever listens."""
        self.memory.add(moment)
        with self._lock:
            self.newest = moment
            self.moments += 1
            self._arrived_s = time.monotonic()
            self._new.append(moment)
            if self._called or self._loop is None:
                return
            self._called = True
            try:
                self._loop.call_soon_threadsafe(self._hand_on)
            except RuntimeError:
                # The loop has ended meanwhile.
                self._called = False

    def close_listeners(self) -> None:
        """Let all that listen go; in the loop's thread."""
        for listener in tuple(self.listeners):
            listener.close()

    def health(self) -> dict[str, object]:
        """What is known of how it goes, ready for JSON; never raises."""
        told: dict[str, object] = {"state": "ok"}
        with self._lock:
            silent_s = time.monotonic() - self._arrived_s
            moments = self.moments
        if self._health is not None:
            try:
                told = dict(self._health())
            except Exception as error:
                told = {"state": "failed", "reason": f"health cannot be told: {error!r}"}
        elif silent_s > _SILENT_S:
            reason = f"no moment for {silent_s:.0f} s" if moments else "no moment yet"
            told = {"state": "silent", "reason": reason}
        told["web"] = {"moments": moments, "clients": len(self.listeners), "dropped": self.dropped}
        if self.store is not None:
            try:
                told["store_bytes"] = self.store.stat().st_size
            except OSError:
                told["store_bytes"] = None
        cleaned = _clean(told)
        assert isinstance(cleaned, dict)
        return cleaned

    def metrics(self) -> str:
        """Numbers of health in the text format of Prometheus."""
        health = self.health()
        newest = self.newest
        camera = "" if newest is None else newest.camera
        escaped = _escaped(camera)
        values = {"up": float(health.get("state") == "ok")}
        if newest is not None:
            values["moment_age_seconds"] = time.time() - newest.time_utc_s
            values["targets"] = float(len(newest.targets))
        for name, value in _numbers(health):
            values.setdefault(name, value)
        lines = []
        for name, value in values.items():
            lines.append(f"# TYPE sightline_{name} gauge")
            lines.append(f'sightline_{name}{{camera="{escaped}"}} {value!r}')
        lines += _boundary_lines(health.get("boundaries"), escaped)
        return "\n".join(lines) + "\n"

    def _hand_on(self) -> None:
        with self._lock:
            self._called = False
            new = tuple(self._new)
            self._new.clear()
        for moment in new:
            for listener in self.listeners:
                self.dropped += not listener.offer(moment)


def _escaped(label: str) -> str:
    return encodable_text(label).replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _boundary_lines(boundaries: object, camera: str) -> Iterator[str]:
    """What was counted at lines and in zones, each name a label."""
    if not isinstance(boundaries, list):
        return
    for name, (key, label) in _COUNTED.items():
        rows = [one for one in boundaries if isinstance(one, Mapping) and one.get(key) is not None]
        # A crossing is of one metric, whichever way it goes.
        if rows and not label.endswith("right_to_left"):
            kind = "counter" if name.endswith("_total") else "gauge"
            yield f"# TYPE sightline_{name.partition(' ')[0]} {kind}"
        for one in rows:
            labels = f'camera="{camera}",boundary="{_escaped(str(one.get("name")))}"'
            labels += f',direction="{label}"' if label else ""
            yield f"sightline_{name.partition(' ')[0]}{{{labels}}} {float(one[key])!r}"


def _clean(value: object) -> object:
    """A value as JSON can hold it."""
    if isinstance(value, Mapping):
        return {str(key): _clean(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_clean(one) for one in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return str(value)
    return number if math.isfinite(number) else None


def _numbers(values: Mapping[str, object], prefix: str = "") -> Iterator[tuple[str, float]]:
    """All numbers of nested tables, with names that Prometheus takes."""
    for key, value in values.items():
        name = f"{prefix}{_NOT_IN_A_NAME.sub('_', key).strip('_')}"
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{name}_")
        elif isinstance(value, bool | int | float):
            yield name, float(value)
