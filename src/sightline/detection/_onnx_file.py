"""What an ONNX file names besides itself, read before a library opens it.

A file may keep its weights in other files, by a path that says where. Protocol buffers are read
here as far as that takes: tags and lengths, without the package ``onnx``.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from sightline.errors import InputError

# By the type of a message: the fields that hold messages, and their types. From onnx.proto.
_MODEL, _GRAPH, _NODE, _ATTRIBUTE, _TENSOR = "model", "graph", "node", "attribute", "tensor"
_SPARSE, _FUNCTION, _TRAINING, _ENTRY = "sparse", "function", "training", "entry"
_MESSAGES: Mapping[str, Mapping[int, str]] = {
    _MODEL: {7: _GRAPH, 20: _TRAINING, 25: _FUNCTION},
    _GRAPH: {1: _NODE, 5: _TENSOR, 15: _SPARSE},
    _NODE: {5: _ATTRIBUTE},
    _ATTRIBUTE: {5: _TENSOR, 6: _GRAPH, 10: _TENSOR, 11: _GRAPH, 22: _SPARSE, 23: _SPARSE},
    _SPARSE: {1: _TENSOR, 2: _TENSOR},
    _FUNCTION: {7: _NODE, 11: _ATTRIBUTE},
    _TRAINING: {1: _GRAPH, 2: _GRAPH},
    _TENSOR: {13: _ENTRY},
}
_ENTRY_KEY, _ENTRY_VALUE = 1, 2
_NODE_OPERATOR = 4
_DEEPEST = 40
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
# Holds what a processor's maker has compiled, and may name a file with it.
_COMPILED = "EPContext"


def check_onnx_file(path: str | os.PathLike[str]) -> None:
    """Raise InputError for a file that is no ONNX, or that names files outside of its folder.

    Raises:
        InputError: As said; or it holds operators that are compiled programs.
    """
    folder = Path(os.path.realpath(path)).parent
    try:
        with (
            Path(path).open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            for location in _named_files(data):
                _check_inside(path, folder, location)
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: is no ONNX file that can be run, or is damaged ({error})"
        ) from error


def _check_inside(path: str | os.PathLike[str], folder: Path, location: str) -> None:
    shown = location if len(location) <= 80 else f"{location[:77]}..."
    outside = InputError(
        f"{path}: keeps weights outside of its folder ({shown!r}), which a file from somebody else "
        "is not to reach; put them beside it, or export it in one file"
    )
    if "\0" in location or os.path.isabs(location) or location[1:2] == ":" or "\\" in location:
        raise outside
    if os.path.normpath(location).startswith(".."):
        raise outside
    # Where the file itself is a link, its weights may lie beside what it leads to.
    real = Path(os.path.realpath(Path(os.path.abspath(path)).parent / location))
    if not any(
        real.is_relative_to(one) for one in (folder, Path(os.path.realpath(Path(path).parent)))
    ):
        raise outside
    if not real.is_file():
        raise InputError(f"{path}: its weights are in {shown!r}, which is not there")


def _named_files(data: mmap.mmap) -> Iterator[str]:
    """The files in which tensors say that their values are."""
    waiting = [(_MODEL, 0, len(data), 0)]
    while waiting:
        kind, start, stop, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ValueError("its graphs lie too deep in one another")
        for number, first, last in _fields(data, start, stop):
            inner = _MESSAGES[kind].get(number)
            if inner == _ENTRY:
                key, value = _entry(data, first, last)
                if key == "location":
                    yield value
            elif inner is not None:
                waiting.append((inner, first, last, depth + 1))
            elif (
                kind == _NODE
                and number == _NODE_OPERATOR
                and data[first:last] == _COMPILED.encode()
            ):
                raise ValueError(f"it holds a compiled program, {_COMPILED}")


def _entry(data: mmap.mmap, start: int, stop: int) -> tuple[str, str]:
    texts = {
        number: data[first:last].decode("utf-8")
        for number, first, last in _fields(data, start, stop)
    }
    return texts.get(_ENTRY_KEY, ""), texts.get(_ENTRY_VALUE, "")


def _fields(data: mmap.mmap, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Number, and first and last place, of each field of bytes in a message."""
    at = start
    while at < stop:
        tag, at = _varint(data, at)
        wire = tag & 7
        if wire == _VARINT:
            _, at = _varint(data, at)
        elif wire == _BYTES:
            length, at = _varint(data, at)
            if length > stop - at:
                raise ValueError("it is cut short")
            yield tag >> 3, at, at + length
            at += length
        elif wire in (_FIXED64, _FIXED32):
            at += 8 if wire == _FIXED64 else 4
        else:
            raise ValueError("it is no protocol buffer")
    if at != stop:
        raise ValueError("it is cut short")


def _varint(data: mmap.mmap, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 70:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise ValueError("it is no protocol buffer")
