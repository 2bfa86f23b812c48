"""The points of GPX files as they stand there, read by expat without a tree in memory."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from xml.parsers import expat

from sightline.errors import InputError
from sightline.formats import _files

_NAMESPACES = (
    "",
    "http://www.topografix.com/GPX/1/0",
    "http://www.topografix.com/GPX/1/1",
)
_MOST_BYTES = 256 * 2**20
_DEEPEST = 200
_POINTS = {"trkpt": ["gpx", "trk", "trkseg"], "rtept": ["gpx", "rte"], "wpt": ["gpx"]}
_SEPARATOR = "\x1f"
_ENCODINGS = re.compile(
    r"(?i:utf-8-sig|utf-16(-le|-be)?|(us-)?ascii|latin-?1|iso[-_]?8859-\d+|windows-125\d|cp125\d"
    r"|gb\w+|big5|shift[-_]jis|euc-\w+|koi8-\w)"
)


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
        tracks: A line a segment.
        routes: A line a route.
        waypoints: One line.
    """

    tracks: list[GpxLine]
    routes: list[GpxLine]
    waypoints: list[GpxLine]


def read_gpx_points(path: str | os.PathLike[str]) -> GpxPoints:
    """Read the points of a GPX file.

    Raises:
        InputError: The file is too large, no XML, cut short, or no GPX; or it declares a document
            type.
    """
    text = _decoded(path)
    reader = _Reader(path)
    parser = expat.ParserCreate("utf-8", _SEPARATOR)
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = reader.document_type
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.characters
    try:
        parser.Parse(text.encode("utf-8", errors="replace"), True)
    except expat.ExpatError as error:
        raise InputError(
            f"{path}: is no GPX file, is damaged, or is cut short ({' '.join(str(error).split())})"
        ) from error
    return GpxPoints(reader.tracks, reader.routes, [reader.waypoints])


def _decoded(path: str | os.PathLike[str]) -> str:
    found = _files.existing(path)
    if found.stat().st_size > _MOST_BYTES:
        raise InputError(
            f"{path}: is larger than {_MOST_BYTES // 2**20} MiB; split it into several logs"
        )
    data = found.read_bytes()
    declared = re.match(rb"""\s*<\?xml[^>]*encoding\s*=\s*["']([A-Za-z0-9._-]+)""", data)
    encoding = _files.text_encoding(data[:256])
    # What declares itself byte by byte is not in an encoding of two bytes.
    if declared and not declared[1].lower().startswith((b"utf-8", b"utf8", b"utf-16", b"utf16")):
        encoding = declared[1].decode("ascii")
    if not _ENCODINGS.fullmatch(encoding):
        raise InputError(f"{path}: is in the encoding {_files.shortened(encoding)}; expected UTF-8")
    try:
        text = data.decode(encoding)
    except (UnicodeError, LookupError) as error:
        raise InputError(f"{path}: is not text in {encoding}, so it is no GPX file") from error
    # The text is decoded: what encoding it once had is no longer true. Lines keep their numbers.
    return re.sub(r"^\s*<\?xml[^>]*\?>", "", text.lstrip("\ufeff"), count=1)


class _Reader:
    """Takes what expat finds: elements of GPX in their places, and nothing else."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path
        # Local names of GPX elements, None for those of others.
        self._open: list[str | None] = []
        self._namespace = ""
        self._text: list[str] | None = None
        self._point: GpxPoint | None = None
        self._track = GpxTrack()
        self._counts = dict.fromkeys(_POINTS, 0)
        self.tracks: list[GpxLine] = []
        self.routes: list[GpxLine] = []
        self.waypoints = GpxLine()

    def document_type(self, *_: object) -> None:
        """Refuse a document type: GPX has none, and entities in it can fill the memory."""
        raise InputError(
            f"{self._path}: declares a document type, which GPX has none of and which can be "
            "abused; remove the <!DOCTYPE ...> declaration"
        )

    def start(self, written: str, attributes: dict[str, str]) -> None:
        """Take the beginning of an element."""
        namespace, _, name = written.rpartition(_SEPARATOR)
        if not self._open:
            if name != "gpx":
                raise InputError(
                    f"{self._path}: is no GPX file; its first element is {_files.shortened(name)}"
                )
            self._namespace = namespace
        if len(self._open) >= _DEEPEST:
            raise InputError(f"{self._path}: is no GPX file; its elements lie too deep")
        ours = namespace == self._namespace or namespace in _NAMESPACES
        above = self._open[:]
        self._open.append(name if ours else None)
        if not ours:
            return
        if name == "trk" and above == ["gpx"]:
            self._track = GpxTrack()
        elif name == "trkseg" and above == ["gpx", "trk"]:
            self.tracks.append(GpxLine(self._track))
        elif name == "rte" and above == ["gpx"]:
            self.routes.append(GpxLine())
        elif _POINTS.get(name) == above:
            self._counts[name] += 1
            latitude, longitude = (attributes.get(key, "").strip() for key in ("lat", "lon"))
            self._point = GpxPoint(self._counts[name], latitude, longitude)
            self._line(name).points.append(self._point)
        elif (name == "time" and self._point is not None and above[-1] in _POINTS) or (
            name in ("name", "number", "type") and above == ["gpx", "trk"]
        ):
            self._text = []

    def end(self, _: str) -> None:
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
            return self.waypoints
        return (self.tracks if point == "trkpt" else self.routes)[-1]
