"""Tiles of a map from one file: MBTiles 1.3 (SQLite), and PMTiles version 3.

What the file says of itself is not trusted: it is read alone, in bounds, and a tile that is no
picture and no vector tile is refused.

- MBTiles: https://github.com/mapbox/mbtiles-spec/blob/master/1.3/spec.md
- PMTiles: https://github.com/protomaps/PMTiles/blob/main/spec/v3/spec.md
"""

from __future__ import annotations

import gzip
import html
import io
import json
import math
import os
import re
import sqlite3
import struct
import threading
import zlib
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol, TypeVar
from urllib.parse import quote

from sightline.errors import InputError

RASTER, VECTOR = "raster", "vector"
"""Kinds of tiles."""

LARGEST_ZOOM = 24

_MOST_TILE_BYTES = 4_000_000
_MOST_METADATA_BYTES = 1_000_000
_MOST_TEXT = 300
_MOST_LAYERS = 60
_GZIP = b"\x1f\x8b"
_PICTURES = {
    b"\x89PNG\r\n\x1a\n": "image/png",
    b"\xff\xd8\xff": "image/jpeg",
    b"RIFF": "image/webp",
}
_VECTOR_TYPE = "application/x-protobuf"
_ENDINGS = (".mbtiles", ".pmtiles")


@dataclass(frozen=True)
class TileSet:
    """What a file of tiles says of itself.

    Attributes:
        kind: ``"raster"`` or ``"vector"``.
        zooms: The lowest and the highest zoom.
        bounds_deg: West, south, east and north, degrees.
        attribution: To whom it is owed, as plain text.
        layers: Names of a vector map's layers.
    """

    kind: str
    zooms: tuple[int, int]
    bounds_deg: tuple[float, float, float, float]
    attribution: str
    layers: tuple[str, ...]


class Tiles(Protocol):
    """A file of tiles."""

    about: TileSet

    def tile(self, zoom: int, x: int, y: int) -> tuple[bytes, str] | None:
        """A tile and its media type; None where the file has none there.

        Args:
            zoom: Of the tile.
            x: Column, from the west.
            y: Row, from the north.

        Raises:
            InputError: It is damaged, too large, or of a kind that no map shows.
        """

    def close(self) -> None:
        """Let go of the file."""


def open_tiles(path: str | os.PathLike[str]) -> Tiles:
    """Open a file of tiles.

    Args:
        path: An MBTiles or PMTiles file.

    Raises:
        InputError: It is neither, or cannot be used.
    """
    path = Path(path)
    if path.suffix.lower() not in _ENDINGS:
        raise InputError(f"{path}: is no map of tiles; expected an .mbtiles or a .pmtiles file")
    try:
        with path.open("rb") as file:
            begin = file.read(16)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if begin.startswith(b"PMTiles"):
        return PmTiles(path)
    if begin.startswith(b"SQLite format 3\0"):
        return MbTiles(path)
    raise InputError(f"{path}: is neither MBTiles (SQLite) nor PMTiles")


class MbTiles:
    """Tiles in a table of SQLite.

    Args:
        path: The file.

    Raises:
        InputError: It cannot be used.
    """

    # A view may stand for the table, as written by tippecanoe, and one that never ends as well.
    _MOST_STEPS = 400
    _STEP_OPERATIONS = 10_000

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._steps = 0
        try:
            self._base = sqlite3.connect(
                f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1",
                uri=True,
                check_same_thread=False,
            )
        except sqlite3.Error as error:
            raise InputError(f"{path}: cannot be opened: {error}") from error
        self._base.text_factory = lambda data: data.decode("utf-8", "replace")
        self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MOST_TILE_BYTES)
        self._base.set_progress_handler(self._count, self._STEP_OPERATIONS)
        try:
            self._ask("PRAGMA trusted_schema = OFF", ())
            told = {
                str(name): str(value)[:_MOST_METADATA_BYTES]
                for name, value in self._ask("SELECT name, value FROM metadata LIMIT 200", ())
            }
            zooms = self._ask("SELECT min(zoom_level), max(zoom_level) FROM tiles", ())
            first = self._ask("SELECT tile_data FROM tiles LIMIT 1", ())
            if not first or zooms[0][0] is None:
                raise InputError(f"{path}: holds no tile")
            self.about = self._about(told, zooms[0], first[0][0])
        except InputError:
            self._base.close()
            raise

    def tile(self, zoom: int, x: int, y: int) -> tuple[bytes, str] | None:
        """See `Tiles.tile`."""
        _check_place(zoom, x, y)
        rows = self._ask(
            "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
            " LIMIT 1",
            (zoom, x, (1 << zoom) - 1 - y),
        )
        if not rows:
            return None
        return _checked(rows[0][0], self.about.kind, f"{self._path}: tile {zoom}/{x}/{y}")

    def close(self) -> None:
        """See `Tiles.close`."""
        with self._lock:
            self._base.close()

    def _about(self, told: dict[str, str], zooms: tuple[object, ...], first: object) -> TileSet:
        where = str(self._path)
        vector = told.get("format", "").lower() in ("pbf", "mvt")
        kind = VECTOR if vector else RASTER
        _checked(first, kind, f"{where}: its first tile")
        layers = _layers(_json(told.get("json", "{}"), where))
        bounds = [_float(part) for part in told.get("bounds", "").split(",")]
        low, high = (_whole(one) for one in zooms)
        return _tile_set(kind, (low, high), bounds, told.get("attribution", ""), layers, where)

    def _count(self) -> int:
        self._steps += 1
        return int(self._steps > self._MOST_STEPS)

    def _ask(self, query: str, values: tuple[int, ...]) -> list[tuple[object, ...]]:
        with self._lock:
            self._steps = 0
            try:
                return self._base.execute(query, values).fetchall()
            # What it complains of may have letters that are none in it.
            except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
                raise InputError(
                    f"{self._path}: is no MBTiles that can be used: {error}"
                ) from error


_HEADER = struct.Struct("<7sB11Q6B4iB2i")
_HEADER_BYTES = 127
_NO_COMPRESSION, _GZIPPED = 1, 2
_TYPES = {1: VECTOR, 2: RASTER, 3: RASTER, 4: RASTER}
_MOST_DIRECTORY_BYTES = 16_000_000
_MOST_ENTRIES = 1_000_000
_DEEPEST = 4
_DIRECTORIES = 64


@dataclass(frozen=True)
class _Directory:
    """Entries of a directory of PMTiles, in the order of their first tile."""

    tile: list[int]
    run: list[int]
    length: list[int]
    offset: list[int]


class PmTiles:
    """Tiles of a PMTiles archive, version 3.

    Args:
        path: The file.

    Raises:
        InputError: It cannot be used.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[int, int], _Directory] = OrderedDict()
        self._file: BinaryIO = path.open("rb")
        try:
            self._size = os.fstat(self._file.fileno()).st_size
            self._open()
        except InputError:
            self._file.close()
            raise

    def tile(self, zoom: int, x: int, y: int) -> tuple[bytes, str] | None:
        """See `Tiles.tile`."""
        wanted = tile_number(zoom, x, y)
        at, length = self._root
        for _ in range(_DEEPEST):
            found = self._entry(self._directory(at, length), wanted)
            if found is None:
                return None
            run, offset, length = found
            if run:
                data = self._read(self._tiles_at + offset, length, _MOST_TILE_BYTES)
                where = f"{self._path}: tile {zoom}/{x}/{y}"
                return _checked(data, self.about.kind, where)
            at = self._leaves_at + offset
        raise InputError(f"{self._path}: its directories lead nowhere")

    def close(self) -> None:
        """See `Tiles.close`."""
        with self._lock:
            self._file.close()

    def _open(self) -> None:
        begin = self._read(0, _HEADER_BYTES, _HEADER_BYTES)
        fields = _HEADER.unpack(begin[: _HEADER.size])
        magic, version = fields[:2]
        root_at, root_length, meta_at, meta_length, leaves_at, _, tiles_at = fields[2:9]
        internal, packed, kind, low, high = fields[14:19]
        west, south, east, north = (value / 1e7 for value in fields[19:23])
        if magic != b"PMTiles" or version != 3:
            raise InputError(f"{self._path}: is PMTiles of version {version}; expected 3")
        if kind not in _TYPES:
            raise InputError(f"{self._path}: has tiles of type {kind}, which no map here shows")
        # Archives of pictures often leave unknown, which is 0, how these are compressed.
        if not {internal, packed or _NO_COMPRESSION} <= {_NO_COMPRESSION, _GZIPPED}:
            raise InputError(
                f"{self._path}: is compressed in a way that is not read here; convert it with gzip"
            )
        self._internal = internal
        self._leaves_at, self._tiles_at, self._root = leaves_at, tiles_at, (root_at, root_length)
        meta = self._unpacked(self._read(meta_at, meta_length, _MOST_METADATA_BYTES))
        told = _json(meta.decode("utf-8", "replace"), str(self._path))
        attribution = told.get("attribution", "")
        self._directory(*self._root)
        self.about = _tile_set(
            _TYPES[kind],
            (low, high),
            [west, south, east, north],
            attribution if isinstance(attribution, str) else "",
            _layers(told) if kind == 1 else (),
            str(self._path),
        )

    def _entry(self, directory: _Directory, wanted: int) -> tuple[int, int, int] | None:
        """Run, offset and length of the entry that a tile is in."""
        i = bisect_right(directory.tile, wanted) - 1
        if i < 0:
            return None
        run = directory.run[i]
        if run and wanted >= directory.tile[i] + run:
            return None
        return run, directory.offset[i], directory.length[i]

    def _directory(self, at: int, length: int) -> _Directory:
        with self._lock:
            known = self._known.get((at, length))
            if known is not None:
                self._known.move_to_end((at, length))
                return known
        data = self._unpacked(self._read(at, length, _MOST_DIRECTORY_BYTES))
        made = self._parsed(data)
        with self._lock:
            self._known[at, length] = made
            while len(self._known) > _DIRECTORIES:
                self._known.popitem(last=False)
        return made

    def _parsed(self, data: bytes) -> _Directory:
        reader = _Varints(data, str(self._path))
        count = reader.next()
        if count > min(_MOST_ENTRIES, len(data)):
            raise InputError(f"{self._path}: has a directory of {count} entries, which is damaged")
        tile, number = [], 0
        for _ in range(count):
            number += reader.next()
            tile.append(number)
        run = [reader.next() for _ in range(count)]
        length = [reader.next() for _ in range(count)]
        offset: list[int] = []
        for i in range(count):
            value = reader.next()
            if value == 0 and i == 0:
                raise InputError(f"{self._path}: has a directory that is damaged")
            offset.append(value - 1 if value else offset[-1] + length[i - 1])
        return _Directory(tile, run, length, offset)

    def _unpacked(self, data: bytes) -> bytes:
        if self._internal == _NO_COMPRESSION:
            return data
        return _gunzipped(data, _MOST_DIRECTORY_BYTES, str(self._path))

    def _read(self, at: int, length: int, most: int) -> bytes:
        if length > most or at + length > self._size:
            raise InputError(
                f"{self._path}: a part of {length} bytes at {at} is too large, or lies beyond the "
                "end of the file, which is damaged"
            )
        with self._lock:
            try:
                self._file.seek(at)
                data = self._file.read(length)
            except (OSError, ValueError) as error:
                raise InputError(f"{self._path}: cannot be read: {error}") from error
        if len(data) < length:
            raise InputError(f"{self._path}: ends too early")
        return data


class _Varints:
    """Whole numbers of seven bits a byte, the lowest first."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._at, self._where = data, 0, where

    def next(self) -> int:
        value = shift = 0
        while self._at < len(self._data) and shift < 64:
            byte = self._data[self._at]
            self._at += 1
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
            shift += 7
        raise InputError(f"{self._where}: has a directory that is damaged")


def tile_number(zoom: int, x: int, y: int) -> int:
    """Number of a tile in PMTiles: zoom by zoom, along the curve of Hilbert.

    Args:
        zoom: Of the tile.
        x: Column, from the west.
        y: Row, from the north.

    Raises:
        InputError: There is no such tile.
    """
    _check_place(zoom, x, y)
    number = ((1 << (2 * zoom)) - 1) // 3
    side = 1 << (zoom - 1) if zoom else 0
    while side:
        right, below = int(bool(x & side)), int(bool(y & side))
        number += side * side * ((3 * right) ^ below)
        if not below:
            if right:
                x, y = side - 1 - x, side - 1 - y
            x, y = y, x
        # Only what lies within the quarter counts from here on.
        x, y = x & (side - 1), y & (side - 1)
        side >>= 1
    return number


def _check_place(zoom: int, x: int, y: int) -> None:
    if not (0 <= zoom <= LARGEST_ZOOM and 0 <= x < 1 << zoom and 0 <= y < 1 << zoom):
        raise InputError(f"there is no tile {zoom}/{x}/{y}")


def _checked(data: object, kind: str, where: str) -> tuple[bytes, str]:
    """A tile and its media type, by what is in it and not by what is said of it."""
    if not isinstance(data, bytes) or len(data) > _MOST_TILE_BYTES:
        raise InputError(f"{where} is no tile, or larger than {_MOST_TILE_BYTES // 1_000_000} MB")
    if kind == VECTOR:
        plain = _gunzipped(data, _MOST_TILE_BYTES, where) if data[:2] == _GZIP else data
        return plain, _VECTOR_TYPE
    for begin, media_type in _PICTURES.items():
        if data.startswith(begin) and (begin != b"RIFF" or data[8:12] == b"WEBP"):
            return data, media_type
    raise InputError(f"{where} is no PNG, JPEG or WebP")


def _gunzipped(data: bytes, most: int, where: str) -> bytes:
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as packed:
            plain = packed.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{where} is damaged: {error}") from error
    if len(plain) > most:
        raise InputError(f"{where} is larger than {most // 1_000_000} MB unpacked")
    return plain


def _json(text: str, where: str) -> dict[str, object]:
    try:
        told = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: its metadata is no JSON: {error}") from error
    return told if isinstance(told, dict) else {}


def _layers(told: dict[str, object]) -> tuple[str, ...]:
    """Names of the layers of a vector map."""
    listed = told.get("vector_layers")
    if not isinstance(listed, list):
        return ()
    names = [one.get("id") for one in listed[:_MOST_LAYERS] if isinstance(one, dict)]
    return tuple(name[:_MOST_TEXT] for name in names if isinstance(name, str) and name)


_Value = TypeVar("_Value")


def _float(text: object) -> float:
    return _made(lambda: float(str(text)), math.nan)


def _whole(value: object) -> int:
    return _made(lambda: int(str(value)), -1)


def _made(make: Callable[[], _Value], otherwise: _Value) -> _Value:
    try:
        return make()
    except (ValueError, OverflowError):
        return otherwise


def _tile_set(
    kind: str,
    zooms: tuple[int, int],
    bounds_deg: list[float],
    attribution: str,
    layers: tuple[str, ...],
    where: str,
) -> TileSet:
    low, high = zooms
    if not 0 <= low <= high <= LARGEST_ZOOM:
        raise InputError(f"{where}: says that its zooms are {low} to {high}; expected 0 to 24")
    whole = (-180.0, -85.0511287798066, 180.0, 85.0511287798066)
    good = len(bounds_deg) == 4 and all(map(math.isfinite, bounds_deg))
    west, south, east, north = bounds_deg if good else whole
    if not (-180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0):
        west, south, east, north = whole
    # An attribution is HTML as a rule; what it says is kept, and no markup.
    plain = html.unescape(re.sub(r"<[^<>]*>", " ", attribution[:2000]))
    text = " ".join(plain.split())[:_MOST_TEXT]
    return TileSet(kind, (low, high), (west, south, east, north), text, layers)
