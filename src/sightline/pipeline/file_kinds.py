"""Which kind of file something is, by what is in it."""

from __future__ import annotations

import csv
import re
from pathlib import Path

from sightline.errors import InputError

_SUFFIXES = {
    ".toml": "scene",
    ".safetensors": "model",
    ".onnx": "detector",
    ".otrfpts": "control points",
}
_HEAD_BYTES = 65536
_SENTENCE = re.compile(rb"[$!][A-Z]{2}[A-Z]{3},")
_TRACK_SUFFIXES = (".geojson", ".parquet", ".gpkg", ".kml")

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
    if suffix in _TRACK_SUFFIXES:
        return "tracks"
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    if _SENTENCE.search(head) or text.startswith(b"<"):
        return "log"
    if b"\0" in head[:4096] and not head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "video"
    if suffix not in (".csv", ".txt", ".log", ".tsv"):
        return "video" if not text.isascii() else "log"
    return _kind_of_table(text.decode("utf-8", "replace"))


def _kind_of_table(text: str) -> str:
    header = text.partition("\n")[0]
    names = {name.strip().lower() for name in next(csv.reader([header]), [])}
    for told, kind in _TABLES:
        if told <= names:
            return kind
    place = any(name.startswith(("lat", "position_lat")) for name in names)
    return "log" if place else "boxes"
