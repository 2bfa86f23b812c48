"""The points of KML and TCX files as they stand there, found among what expat reads."""

from __future__ import annotations

from sightline.formats._gpx_points import GpxLine, GpxPoint, GpxPoints, GpxTrack


class _TextReader:
    """Takes the texts of some elements, whatever namespace or prefix they have.

    Attributes:
        points: What was found so far.
        rows: Points so far.
    """

    texts: frozenset[str]

    def __init__(self, found: GpxPoints) -> None:
        self.points = found
        self.rows = 0
        self._open: list[str] = []
        self._text: list[str] | None = None

    def start(self, _: str, name: str, __: dict[str, str]) -> None:
        """Take the beginning of an element."""
        self._open.append(name)
        self._text = [] if name in self.texts else None
        self.begun(name)

    def end(self) -> None:
        """Take the end of an element."""
        name = self._open.pop()
        text, self._text = self._text, None
        self.ended(name, self._open[-1] if self._open else "", "".join(text or []).strip())

    def characters(self, text: str) -> None:
        """Take text, where it is asked for."""
        if self._text is not None:
            self._text.append(text)

    def begun(self, name: str) -> None:
        """Take the name of an element that begins."""

    def ended(self, name: str, above: str, text: str) -> None:
        """Take an element: its name, that of the one it stands in, and its text."""

    def point(self, latitude: str, longitude: str, time: str) -> GpxPoint:
        """The next point."""
        self.rows += 1
        return GpxPoint(self.rows, latitude, longitude, time)


class KmlReader(_TextReader):
    """Takes the points of each ``gx:Track``, and placemarks that are a point with a time.

    A track has as many ``when`` as ``gx:coord``, of which some may be empty (KML reference,
    developers.google.com/kml). In version 2.3 they are ``Track`` and ``coord``.
    """

    texts = frozenset(("when", "coord", "coordinates", "name"))

    def __init__(self) -> None:
        super().__init__(
            GpxPoints(
                "KML",
                lacks=(
                    "holds no gx:Track and no Placemark that is a Point with a TimeStamp; a line "
                    "has no times: export the log as GPX"
                ),
            )
        )
        self._track = GpxTrack()
        self._whens: list[str] = []
        self._places: list[str] = []
        self._point = ""

    def begun(self, name: str) -> None:
        """Forget the times and places of the element before."""
        if name == "Placemark":
            self._track = GpxTrack()
        if name in ("Placemark", "Track"):
            self._whens, self._places, self._point = [], [], ""

    def ended(self, name: str, above: str, text: str) -> None:
        """Take a time, a place, or the end of what has them."""
        if name == "name" and above == "Placemark":
            self._track.name = text
        elif name == "when" and above in ("Track", "TimeStamp"):
            self._whens.append(text)
        elif name == "coord":
            self._places.append(text)
        elif name == "coordinates" and above == "Point":
            self._point = text
        elif name == "Track":
            self._add_track()
        elif name == "Placemark" and self._point and self._whens:
            self.points.waypoints[0].points.append(
                self.point(*_north_east(self._point.split(",")), self._whens[0])
            )

    def _add_track(self) -> None:
        if len(self._whens) != len(self._places):
            # Which time is of which place is not told.
            self.points.wrong = (
                f"has {len(self._whens)} times (when) and {len(self._places)} places (gx:coord) in "
                "a track, which are to be as many; export the log as GPX"
            )
            return
        points = [
            self.point(*_north_east(place.split()), time)
            for time, place in zip(self._whens, self._places, strict=True)
        ]
        self.points.tracks.append(GpxLine(self._track, points))
        self._whens, self._places = [], []


class TcxReader(_TextReader):
    """Takes the points of each ``Track`` of a Training Center file."""

    texts = frozenset(("Time", "LatitudeDegrees", "LongitudeDegrees"))

    def __init__(self) -> None:
        super().__init__(GpxPoints("TCX"))
        self._track = GpxTrack()

    def begun(self, name: str) -> None:
        """Begin a track or a point."""
        if name in ("Activity", "Course"):
            self._track = GpxTrack()
        elif name == "Track":
            self.points.tracks.append(GpxLine(self._track))
        elif name == "Trackpoint" and self.points.tracks:
            self.points.tracks[-1].points.append(self.point("", "", ""))

    def ended(self, name: str, above: str, text: str) -> None:
        """Take a time or a place."""
        if not (self.points.tracks and self.points.tracks[-1].points):
            return
        point = self.points.tracks[-1].points[-1]
        if name == "Time" and above == "Trackpoint":
            point.time = text
        elif name == "LatitudeDegrees" and above == "Position":
            point.latitude = text
        elif name == "LongitudeDegrees" and above == "Position":
            point.longitude = text


def _north_east(texts: list[str]) -> tuple[str, str]:
    """Latitude and longitude of a place as KML writes it, the longitude first."""
    return (texts[1].strip(), texts[0].strip()) if len(texts) in (2, 3) else ("", "")
