"""Logs in XML, read by expat without a tree in memory: GPX, KML and TCX."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from typing import Protocol
from xml.parsers import expat

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._gpx_points import GpxPoints, GpxReader
from sightline.formats._kml_points import KmlReader, TcxReader

_MOST_BYTES = 256 * 2**20
_DEEPEST = 200
_SEPARATOR = "\x1f"
_ENCODINGS = re.compile(
    r"(?i:utf-8-sig|utf-16(-le|-be)?|(us-)?ascii|latin-?1|iso[-_]?8859-\d+|windows-125\d|cp125\d"
    r"|gb\w+|big5|shift[-_]jis|euc-\w+|koi8-\w)"
)


class _Reader(Protocol):
    """What takes the elements of one format."""

    points: GpxPoints

    def start(self, namespace: str, name: str, attributes: dict[str, str], /) -> None:
        """Take the beginning of an element: its namespace, its name and its attributes."""

    def end(self) -> None:
        """Take the end of an element."""

    def characters(self, text: str) -> None:
        """Take a text."""


_READERS: dict[str, Callable[[], _Reader]] = {
    "gpx": GpxReader,
    "kml": KmlReader,
    "TrainingCenterDatabase": TcxReader,
}


def read_xml_points(path: str | os.PathLike[str]) -> GpxPoints:
    """Read the points of a GPX, KML or TCX file; its first element says which it is.

    Raises:
        InputError: The file is too large, no XML, cut short, or of another kind; or it declares a
            document type.
    """
    text = _decoded(path)
    elements = _Elements(path)
    parser = expat.ParserCreate("utf-8", _SEPARATOR)
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = elements.document_type
    parser.StartElementHandler = elements.start
    parser.EndElementHandler = elements.end
    parser.CharacterDataHandler = elements.characters
    try:
        parser.Parse(text.encode("utf-8", errors="replace"), True)
    except expat.ExpatError as error:
        raise InputError(
            f"{path}: is no GPX file, is damaged, or is cut short ({' '.join(str(error).split())})"
        ) from error
    found = elements.reader().points
    if found.wrong:
        raise InputError(f"{path}: is {found.format}, and {found.wrong}")
    return found


class _Elements:
    """Hands what expat finds to the reader of the format that the first element names."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._path = path
        self._depth = 0
        self._reader: _Reader | None = None

    def reader(self) -> _Reader:
        """What took the elements."""
        if self._reader is None:
            raise InputError(f"{self._path}: is no GPX file; it has no element")
        return self._reader

    def document_type(self, *_: object) -> None:
        """Refuse a document type: GPX has none, and entities in it can fill the memory."""
        raise InputError(
            f"{self._path}: declares a document type, which GPX has none of and which can be "
            "abused; remove the <!DOCTYPE ...> declaration"
        )

    def start(self, written: str, attributes: dict[str, str]) -> None:
        """Take the beginning of an element."""
        namespace, _, name = written.rpartition(_SEPARATOR)
        if self._reader is None:
            if name not in _READERS:
                raise InputError(
                    f"{self._path}: is no GPX file; its first element is {_files.shortened(name)}; "
                    "expected GPX, KML with a gx:Track, or TCX"
                )
            self._reader = _READERS[name]()
        if self._depth >= _DEEPEST:
            raise InputError(f"{self._path}: is no GPX file; its elements lie too deep")
        self._depth += 1
        self._reader.start(namespace, name, attributes)

    def end(self, _: str) -> None:
        """Take the end of an element."""
        self._depth -= 1
        self.reader().end()

    def characters(self, text: str) -> None:
        """Take a text."""
        self.reader().characters(text)


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
