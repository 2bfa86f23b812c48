"""Positions in the forms that people paste: from a chart, a telephone, or a map's address."""

from __future__ import annotations

import math
import re
from urllib.parse import parse_qs, unquote, urlsplit

from sightline.errors import InputError
from sightline.formats._degrees import angle

_LONGEST = 2000
_SHOWN = 80
_DECIMAL = r"[+-]?\d{1,3}(?:\.\d+)?"
_GEO = re.compile(rf"geo:({_DECIMAL}),({_DECIMAL})(?:,{_DECIMAL})?(?:[;?].*)?", re.IGNORECASE)
_MAP = re.compile(rf"(?:^|[&#?])map=\d+(?:\.\d+)?/({_DECIMAL})/({_DECIMAL})")
_AT = re.compile(rf"@({_DECIMAL}),({_DECIMAL})(?:,|/|$)")
_PIN = re.compile(rf"!3d({_DECIMAL})!4d({_DECIMAL})")
_PAIR = re.compile(rf"(?:loc:)?({_DECIMAL})\s*,\s*({_DECIMAL})")
_QUERIES = (("mlat", "mlon"), ("lat", "lon"), ("lat", "lng"), ("latitude", "longitude"))
_PLACES = ("q", "ll", "query", "center", "sll", "destination")
_MINUS = str.maketrans({"\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{NO-BREAK SPACE}": " "})
_EXAMPLES = "32.7, -117.2, or 32°42.3'N 117°10.2'W, or a link of a map"
_WORDS = re.compile(r"\b(North|South|East|West)\b", re.IGNORECASE)
_NAMES = re.compile(r"\b(?:lat(?:itude)?|lon(?:gitude)?|lng|long)\b\.?\s*[:=]?\s*", re.IGNORECASE)


def parse_position(text: str) -> tuple[float, float]:
    """Latitude and longitude of a position that somebody pasted.

    Understood are decimal degrees (``32.7, -117.2``), degrees with letters on either side, degrees
    and minutes, degrees, minutes and seconds, ``geo:`` addresses, and links of OpenStreetMap
    (``#map=17/32.7/-117.2``, ``?mlat=32.7&mlon=-117.2``) and of maps that write ``@32.7,-117.2``.
    Latitude comes first, unless letters say otherwise.

    Args:
        text: What was pasted.

    Returns:
        Degrees north and degrees east.

    Raises:
        InputError: It is no position, may be several, or is not on the earth.
    """
    plain = " ".join(text.translate(_MINUS).split())
    if not plain or len(plain) > _LONGEST:
        raise _refused(text, "is no position")
    found = _from_link(plain, text)
    if found is None:
        found = _from_degrees(plain, text)
    latitude, longitude = found
    if not (math.isfinite(latitude) and math.isfinite(longitude)):
        raise _refused(text, "is no position")
    if abs(latitude) > 90.0:
        swapped = abs(longitude) <= 90.0 and abs(latitude) <= 180.0
        why = "; are latitude and longitude swapped?" if swapped else ""
        raise _refused(text, f"has a latitude of {latitude:g}°, which is on no earth{why}")
    if abs(longitude) > 180.0:
        raise _refused(text, f"has a longitude of {longitude:g}°; give it from -180° to 180°")
    return latitude, longitude


def _refused(text: str, why: str) -> InputError:
    shown = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text.strip())
    shown = shown if len(shown) <= _SHOWN else f"{shown[: _SHOWN - 3]}..."
    return InputError(f"{shown!r} {why}; write latitude, longitude: {_EXAMPLES}")


def _from_link(plain: str, text: str) -> tuple[float, float] | None:
    """A position of an address; None for what is none."""
    geo = _GEO.fullmatch(plain)
    if geo is not None:
        return float(geo[1]), float(geo[2])
    if "://" not in plain and not re.search(r"(?:^|[?&#])(?:m?lat|map)=", plain):
        return None
    try:
        parts = urlsplit(plain)
        queries = parse_qs(parts.query)
    except ValueError as error:
        raise _refused(text, "is no address that can be read") from error
    path, fragment = unquote(parts.path), unquote(parts.fragment)
    # A marker is a place that somebody chose, a view is only what was on the screen.
    for latitude, longitude in _QUERIES:
        if latitude in queries and longitude in queries:
            return _numbers(queries[latitude] + queries[longitude], text)
    pins = _PIN.findall(path)
    if pins:
        return _numbers(list(pins[-1]), text)
    for name in _PLACES:
        for value in queries.get(name, []):
            pair = _PAIR.fullmatch(value)
            if pair is not None:
                return float(pair[1]), float(pair[2])
    for pattern, where in ((_AT, path), (_MAP, f"#{fragment}"), (_MAP, plain)):
        seen = pattern.search(where)
        if seen is not None:
            return float(seen[1]), float(seen[2])
    raise _refused(text, "is an address without a position")


def _numbers(values: list[str], text: str) -> tuple[float, float]:
    if len(values) != 2 or any(re.fullmatch(_DECIMAL, value.strip()) is None for value in values):
        raise _refused(text, "holds no position, or several")
    return float(values[0]), float(values[1])


def _from_degrees(plain: str, text: str) -> tuple[float, float]:
    plain = plain.removeprefix("(").removesuffix(")").removeprefix("[").removesuffix("]")
    plain = _WORDS.sub(lambda word: word[1][0].upper(), _NAMES.sub(" ", plain)).strip()
    halves = _halves(plain)
    if halves is None:
        raise _refused(text, "is no position, or may be several")
    first, second = halves
    swapped = bool(re.search("[EWew]", first)) or bool(re.search("[NSns]", second))
    if swapped:
        first, second = second, first
    angles = angle(first, 0), angle(second, 1)
    if angles[0] is None or angles[1] is None:
        raise _refused(text, "is no position, or may be several")
    return angles[0], angles[1]


def _halves(plain: str) -> tuple[str, str] | None:
    """The texts of two angles; None where it is not certain where one ends."""
    for separator in (";", "/", "|"):
        if plain.count(separator) == 1:
            return _both(plain.split(separator))
    letters = [found.start() for found in re.finditer("[NSEWnsew]", plain)]
    if len(letters) == 2:
        parts = (
            # Letters before, or letters behind.
            [plain[: letters[1]], plain[letters[1] :]]
            if letters[0] == 0
            else [plain[: letters[0] + 1], plain[letters[0] + 1 :]]
        )
        return _both([part.strip(" ,") for part in parts])
    if letters:
        return None
    commas = plain.count(",")
    if commas == 1 and re.search(r",\s|[°'\"′″]\s*,|\.\d+\s*,|,\s*[+-]?\d+\.", plain):
        return _both(plain.split(","))
    if commas == 1 and re.fullmatch(r"[+-]?\d{1,3},[+-]?\d{1,3}", plain):
        # 32,7 may be one number, with a comma for a point.
        return None
    if commas == 3 or (commas == 2 and ", " in plain):
        parts = plain.split(", ")
        return _both(parts) if len(parts) == 2 else None
    if commas in (0, 2):
        parts = plain.split()
        if len(parts) == 2:
            return _both(parts)
        # Degrees, minutes and seconds of either, as many of both, told apart by their marks.
        marks = [found.end() for found in re.finditer(r"°", plain)]
        if len(marks) == 2:
            start = re.search(r"[+-]?\d+(?:\.\d+)?\s*$", plain[: marks[1] - 1])
            if start is not None:
                return _both([plain[: start.start()], plain[start.start() :]])
    return None


def _both(parts: list[str]) -> tuple[str, str] | None:
    first, second = (part.strip(" ,") for part in parts)
    return (first, second) if first and second else None
