"""What programs call the columns of their logs."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence


def _names(*groups: str) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(group.split()) for group in groups)


# Names of columns, less case and marks; those of an earlier group are taken first.
TIMES = _names(
    "timeutc utctime datetimeutc utcdatetime timestamputc utctimestamp utc",
    "time timestamp datetime",
    "gpstime gpstimestamp gpsdatetime isotime iso8601 iso8601time fixtime datetimestamp "
    "basedatetime",
    "loggedat recordedat createdat devicetime locationtime timeofday",
    "epoch epochtime unix unixtime unixtimestamp posix posixtime ts timems timestampms epochms "
    "unixms unixtimems timens timestampns timesec times timestamps timestampus timeus "
    "timestampmillis timemillis tst gpst",
    "loggingtime updatetime zeitstempel zeitpunkt datumzeit datumuhrzeit horodatage dateheure "
    "dateetheure fechahora fechayhora dataora dataeora datahora datumtijd tijdstip zeit "
    "uhrzeit heure hora tiempo ora tijd tid",
)
DATES = (
    "dateutc",
    "utcdate",
    "date",
    "gpsdate",
    "fixdate",
    "day",
    "datum",
    "fecha",
    "data",
    "dato",
)
ZONES = ("tz", "timezone", "tzoffset", "utcoffset", "timezoneoffset", "gmtoffset")
LOCAL = (
    *("timelocal", "localtime", "datetimelocal", "localdatetime"),
    *("ortszeit", "lokalzeit", "heurelocale", "horalocal", "oralocale"),
)
LATITUDES = _names(
    "latitudedeg",
    "latitude lat latdeg latitudedegrees gpslatitude gpslat latitudedd latdd latdegrees "
    "latitudewgs84 latwgs84 gpslatdeg locationlatitude positionlat positionlatitude locationlat "
    "latitudedecimal latdecimal "
    "latitudens latns latddmm latddmmmmmm latitudeddmm latnmea latitudenmea",
    "latitudee7 late7 latitudee6 late6",
    "breite breitengrad geogrbreite geographischebreite latitud latitudine breedtegraad breedte "
    "bredde breddegrad",
)
LONGITUDES = _names(
    "longitudedeg",
    "longitude lon lng long londeg lngdeg longitudedegrees gpslongitude gpslon gpslong gpslng "
    "longitudedd londd londegrees gpslongdeg locationlongitude longitudewgs84 lonwgs84 "
    "positionlon positionlong "
    "positionlongitude locationlon locationlng longitudedecimal londecimal longitudeew lonew "
    "londdmm londddmm londddmmmmmm longitudeddmm longitudedddmm lonnmea longitudenmea",
    "longitudee7 lone7 lnge7 longitudee6 lone6 lnge6",
    "lange laenge langengrad laengengrad geogrlange geographischelange longitud longitudine "
    "lengtegraad lengte lengde lengdegrad",
)
HEMISPHERES = _names(
    "ns northsouth latns nsindicator latdir latdirection latitudedir latitudedirection lathemi "
    "lathemisphere latitudehemisphere latref latituderef gpslatituderef",
    "ew eastwest lonew ewindicator londir londirection longitudedir longitudedirection lonhemi "
    "lonhemisphere longitudehemisphere lonref longituderef gpslongituderef",
)
# What programs call a heading alone is often the course over ground.
HEADINGS = ("headingdeg", "headingtrue", "headingtruedeg", "trueheading", "trueheadingdeg", "hdt")
VESSELS = ("mmsi", "sourcemmsi", "vesselmmsi", "shipmmsi", "mmsinumber")
COURSES = ("cog", "cogdeg", "course", "coursedeg", "courseoverground", "coursetrue")
# Of languages that write the day first.
_DAY_FIRST = frozenset((*TIMES[-1], "datum", "fecha", "data", "dato")) - {
    "loggingtime",
    "updatetime",
}
# The Danish Maritime Authority does so, in days of AIS of one date each.
_DANISH = {"timestamp", "typeofmobile", "mmsi"}
# Parts of a time, as receivers of u-blox and their libraries write them.
PARTS = {
    "year": ("year",),
    "month": ("month",),
    "day": ("day",),
    "hour": ("hour", "hours"),
    "minute": ("minute", "minutes", "min"),
    "second": ("second", "seconds", "sec"),
    "nano": ("nano", "nanosecond", "nanoseconds"),
}
_BOTH, _GRID = _names(
    "position positions coordinates coordinate coords location latlon latlng latlong lonlat "
    "geometry geom wkt point gps gpsposition gpscoordinates koordinaten coordonnees coordenadas",
    "easting northing utmeasting utmnorthing utmx utmy eastings northings",
)
_SPEEDS = ("sog", "speed", "speedoverground", "groundspeed")
_SPEED_UNITS = {
    r"kn|kts?|knots?": 1852.0 / 3600.0,
    r"m/s|mps|ms-1|ms": 1.0,
    r"km/h|kmh|kph": 1.0 / 3.6,
    r"mph": 1609.344 / 3600.0,
}
ANY_TIME = frozenset((*sum(TIMES, ()), *DATES, *LOCAL))
ANY_LATITUDE, ANY_LONGITUDE = frozenset(sum(LATITUDES, ())), frozenset(sum(LONGITUDES, ()))


def plain(name: str) -> str:
    """The name of a column less case, accents, marks, and what stands in brackets behind it."""
    lower = "".join(
        c for c in unicodedata.normalize("NFKD", name.lower()) if not unicodedata.combining(c)
    )
    bare = re.sub(r"[^a-z0-9]", "", re.sub(r"[\[(].*", "", lower))
    # GPS (Lat.) [deg]
    return re.sub(r"[^a-z0-9]", "", lower) if bare == "gps" else bare or lower


def tail(name: str) -> str:
    """What stands behind the last point of a name: of ``field.latitude`` the latitude."""
    return plain(name.rsplit(".", 1)[-1])


def day_first(names: Sequence[str]) -> bool | None:
    """Whether a table of such columns writes the day before the month; None: nothing tells."""
    plains = set(map(plain, names))
    return True if plains >= _DANISH or plains & _DAY_FIRST else None


def what_mends(names: Sequence[str]) -> str:
    """What would make a table of such columns a log, behind a semicolon; ``""``: not known."""
    for name in names:
        if plain(name) in _BOTH or (
            plain(name) not in ANY_LATITUDE and "lat" in name.lower() and "lon" in name.lower()
        ):
            return f"; if {name} holds both, make two columns of it, latitude_deg and longitude_deg"
        if plain(name) in _GRID:
            return f"; {name} is of a grid in metres: write degrees"
    if sum(any(c.isdigit() for c in name) for name in names) > len(names) / 2:
        return "; is its first line a header?"
    return ""


def of_place_and_time(names: Iterable[str]) -> dict[str, str]:
    """Which name is that of the time, of the latitude and of the longitude, as far as one is.

    Of several the one that says most clearly what it is, then the first.
    """
    plains = {name: plain(name) for name in names}
    found = {}
    for key, groups in (
        ("time", (*TIMES, DATES)),
        ("latitude", LATITUDES),
        ("longitude", LONGITUDES),
    ):
        ranked = [name for group in groups for name, bare in plains.items() if bare in group]
        if ranked:
            found[key] = ranked[0]
    return found


def mps_of_unit(name: str) -> float | None:
    """Metres a second of the unit that the name of a column of speeds tells; None: it tells none.

    What is called SOG is in knots, as in AIS.
    """
    words = re.split(r"[^a-z/]+", re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower())
    for unit, mps in _SPEED_UNITS.items():
        if any(re.fullmatch(unit, word) for word in words):
            return mps
    return _SPEED_UNITS[r"kn|kts?|knots?"] if plain(name) in ("sog", "speedoverground") else None


def is_speed(name: str) -> bool:
    units = "|".join(_SPEED_UNITS).replace("/", "").replace("-1", "1")
    return re.sub(rf"({units})$", "", plain(name)) in _SPEEDS
