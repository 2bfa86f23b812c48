"""The points of GPX files as they stand there, found among what expat reads."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

_NAMESPACES = (
    "",
    "http://www.topografix.com/GPX/1/0",
    "http://www.topografix.com/GPX/1/1",
)
_POINTS = {"trkpt": ["gpx", "trk", "trkseg"], "rtept": ["gpx", "rte"], "wpt": ["gpx"]}


@dataclass
class GpxPoint:
    """A point: its number among its kind, from 1, and its texts.

    Attributes:
        row: Number in the file among points of its kind, from 1.
        latitude: Text of ``lat``.
        longitude: Text of ``lon``.
        time: Text of ``time``, or ``""``.
    """

    row: int
    latitude: str
    longitude: str
    time: str = ""


@dataclass
class GpxTrack:
    """What is said of a track.

    Attributes:
        name: Its name, or ``""``.
        number: Its number, or None.
        kind: What its ``type`` says, or ``""``.
    """

    name: str = ""
    number: int | None = None
    kind: str = ""


@dataclass
class GpxLine:
    """A segment of a track, a route, or the waypoints.

    Attributes:
        track: The track that it belongs to.
        points: Its points in their order.
    """

    track: GpxTrack = field(default_factory=GpxTrack)
    points: list[GpxPoint] = field(default_factory=list)


@dataclass
class GpxPoints:
    """The points of a file.

    Attributes:
        format: GPX, KML or TCX.
        tracks: A line a segment.
        routes: A line a route.
        waypoints: One line.
        lacks: What is said where none of its points has a time.
        wrong: Why it is refused whatever else it holds, or ``""``.
    """

    format: str
    tracks: list[GpxLine] = field(default_factory=list)
    routes: list[GpxLine] = field(default_factory=list)
    waypoints: list[GpxLine] = field(default_factory=lambda: [GpxLine()])
    lacks: str = ""
    wrong: str = ""


class GpxReader:
    """Takes what expat finds: elements of GPX in their places, and nothing else."""

    def __init__(self) -> None:
        self.points = GpxPoints("GPX")
        # Local names of GPX elements, None for those of others.
        self._open: list[str | None] = []
        self._namespace = ""
        self._text: list[str] | None = None
        self._point: GpxPoint | None = None
        self._track = GpxTrack()
        self._counts = dict.fromkeys(_POINTS, 0)

    def start(self, namespace: str, name: str, attributes: dict[str, str]) -> None:
        """Take the beginning of an element."""
        if not self._open:
            self._namespace = namespace
        ours = namespace == self._namespace or namespace in _NAMESPACES
        above = self._open[:]
        self._open.append(name if ours else None)
        if not ours:
            return
        if name == "trk" and above == ["gpx"]:
            self._track = GpxTrack()
        elif name == "trkseg" and above == ["gpx", "trk"]:
            self.points.tracks.append(GpxLine(self._track))
        elif name == "rte" and above == ["gpx"]:
            self.points.routes.append(GpxLine())
        elif _POINTS.get(name) == above:
            self._counts[name] += 1
            latitude, longitude = (attributes.get(key, "").strip() for key in ("lat", "lon"))
            self._point = GpxPoint(self._counts[name], latitude, longitude)
            self._line(name).points.append(self._point)
        elif (name == "time" and self._point is not None and above[-1] in _POINTS) or (
            name in ("name", "number", "type") and above == ["gpx", "trk"]
        ):
            self._text = []

    def end(self) -> None:
        """Take the end of an element."""
        name = self._open.pop()
        if name in _POINTS:
            self._point = None
        if self._text is None or name not in ("time", "name", "number", "type"):
            return
        text, self._text = "".join(self._text).strip(), None
        if name == "time" and self._point is not None:
            self._point.time = text
        elif name == "name":
            self._track.name = text
        elif name == "type":
            self._track.kind = text
        elif re.fullmatch(r"\d{1,18}", text):
            self._track.number = int(text)

    def characters(self, text: str) -> None:
        """Take text, where it is asked for."""
        if self._text is not None and self._open[-1] is not None:
            self._text.append(text)

    def _line(self, point: str) -> GpxLine:
        if point == "wpt":
            return self.points.waypoints[0]
        return (self.points.tracks if point == "trkpt" else self.points.routes)[-1]
