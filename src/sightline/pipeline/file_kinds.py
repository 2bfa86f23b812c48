"""Which kind of file something is, by what is in it."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from sightline import formats
from sightline.errors import InputError

_SUFFIXES = {
    ".toml": "scene",
    ".safetensors": "model",
    ".onnx": "detector",
    ".otrfpts": "control points",
    ".otdet": "boxes",
    ".ottrk": "boxes",
}
_HEAD_BYTES = 65536
_LOOKED_AT = 4096
_TABLE_SUFFIXES = (".csv", ".txt", ".log", ".tsv")
_SENTENCE = re.compile(r"[$!][A-Z]{5},")
_POLYGON = re.compile(rb'"type"\s*:\s*"(?:Multi)?Polygon"')
_TRACK_SUFFIXES = (".geojson", ".parquet", ".gpkg")
_TIMES_OF_A_LINE = re.compile(rb'"(?:coordTimes|coordinateProperties|temporalGeometry)"\s*:')

# The columns that tell a table, those that tell more first.
_TABLES = (
    ({"x_px", "y_px"}, "control points"),
    ({"track_id", "latitude_deg", "longitude_deg"}, "tracks"),
    ({"water_level_m"}, "water levels"),
    ({"frame", "utc"}, "clock"),
    ({"x1", "y1"}, "boxes"),
    ({"latitude_deg"}, "log"),
)


def kind_of(path: Path) -> str:
    """The kind of a file or folder, as the checks of files name it.

    Raises:
        InputError: There is no such file, or it is empty.
    """
    if path.is_dir():
        return "pictures"
    if not path.exists():
        raise InputError(f"{path}: there is no such file")
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise InputError(f"{path}: is empty")
    suffix = path.suffix.lower()
    if suffix in _SUFFIXES:
        return _SUFFIXES[suffix]
    if suffix in (".geojson", ".json") and _POLYGON.search(head):
        return "area"
    if suffix in _TRACK_SUFFIXES:
        return "log" if suffix == ".geojson" and _TIMES_OF_A_LINE.search(head) else "tracks"
    text = _text(head)
    if text is None:
        return "video"
    if _SENTENCE.search(text) or text.startswith(("<", "{", "[")):
        return "log"
    if suffix not in _TABLE_SUFFIXES:
        # Streams of pictures may begin without a zero, but not with letters alone.
        return "log" if text.isascii() else "video"
    return _kind_of_table(text)


def _text(head: bytes) -> str | None:
    """The beginning of a text, without blanks before it; None where it is none."""
    encoding = "utf-8-sig"
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif b"\0" in head[:_LOOKED_AT]:
        if head[:_LOOKED_AT:2].count(0) == 0:
            encoding = "utf-16-le"
        elif head[1:_LOOKED_AT:2].count(0) == 0:
            encoding = "utf-16-be"
        elif not _SENTENCE.search(head.decode("latin-1")):
            return None
    return head.decode(encoding, "replace").lstrip()


def _kind_of_table(text: str) -> str:
    header = next(iter(text.splitlines()), "")
    names = {name.strip(' "').lower() for name in re.split(r"[,;\t]", header)}
    for told, kind in _TABLES:
        if told <= names:
            return kind
    if formats.is_log_table(text):
        return "log"
    place = any(name.startswith(("lat", "position_lat")) for name in names)
    return "log" if place else "boxes"
