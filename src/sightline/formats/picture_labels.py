"""Labels of single pictures: YOLO's text files, and COCO's JSON."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sightline.errors import InputError
from sightline.formats import _files
from sightline.types import BoolArray, FloatArray, StrArray

CLASS_FILES = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml", "data.yml", "dataset.yml")
"""Files that name the classes of YOLO labels, in the order in which they are looked for."""

_MOST_BYTES = 2**29
_MOST_CLASSES = 10_000
# Boxes are drawn to the edge of a picture and rounded beyond it.
_BEYOND_PX = 2.0
_SHOWN = 40
_LARGEST = 2**53


@dataclass(frozen=True, eq=False)
class PictureLabels:
    """The boxes that were drawn in one picture.

    Attributes:
        xyxy: (M, 4) corners: shares of width and height in YOLO's labels, pixels in COCO's.
        label: (M,) names of their classes.
        crowd: (M,) bool, whether a box is of many things, which are not told apart.
        size_px: Width and height of the picture; None where the labels do not say.
    """

    xyxy: FloatArray
    label: StrArray
    crowd: BoolArray
    size_px: tuple[int, int] | None = None

    def in_pixels(self, size_px: tuple[int, int]) -> FloatArray:
        """(M, 4) corners in a picture of a width and height, px, none beyond its edges.

        Raises:
            InputError: The labels are of a picture of another size.
        """
        if self.size_px is None:
            return np.asarray(np.clip(self.xyxy, 0.0, 1.0) * np.tile(size_px, 2))
        if self.size_px != size_px:
            raise InputError(
                f"has {size_px[0]} x {size_px[1]} px, and its labels are of a picture of "
                f"{self.size_px[0]} x {self.size_px[1]} px"
            )
        return np.asarray(np.clip(self.xyxy, 0.0, np.tile(size_px, 2)))

    @classmethod
    def none(cls) -> PictureLabels:
        """Of a picture in which there is nothing."""
        return cls(np.empty((0, 4)), np.empty(0, dtype=np.str_), np.empty(0, dtype=bool))


def read_yolo_labels(
    path: str | os.PathLike[str], classes: Sequence[str] | None = None
) -> PictureLabels:
    """A text file of YOLO's: ``class x y width height`` a line, middle and size as shares.

    An outline, ``class x1 y1 x2 y2 x3 y3 ...``, is taken for the box around it. A file without a
    line says that there is nothing in the picture.

    Args:
        path: The file.
        classes: Names of the classes, in the order of their numbers. Absent: nobody names them,
            and there may be one only, of number 0.

    Raises:
        InputError: A line cannot be understood, its class is not known, or its box does not lie in
            the picture.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not text; expected labels as YOLO has them") from error
    boxes, names = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields:
            continue
        where = f"{path}: line {number}"
        values = _numbers(where, fields)
        names.append(_class_name(where, values[0], classes))
        boxes.append(_corners_of_shares(where, values[1:]))
    count = len(boxes)
    return PictureLabels(
        np.array(boxes, dtype=np.float64).reshape(-1, 4),
        np.array(names, dtype=np.str_),
        np.zeros(count, dtype=bool),
    )


def _numbers(where: str, fields: Sequence[str]) -> list[float]:
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise InputError(f"{where}: {_shown(' '.join(fields))} are not all numbers") from error
    if not all(map(math.isfinite, values)):
        raise InputError(f"{where}: {_shown(' '.join(fields))} are not all finite")
    # Five, or a class and the corners of an outline.
    if len(values) != 5 and (len(values) < 7 or len(values) % 2 == 0):
        raise InputError(
            f"{where}: has {len(values)} numbers; expected class, x, y, width and height"
        )
    return values


def _class_name(where: str, value: float, classes: Sequence[str] | None) -> str:
    if value < 0.0 or value != int(value):
        raise InputError(f"{where}: its class is {value:g}; classes are whole numbers from 0")
    number = int(value)
    if classes is None:
        if number:
            raise InputError(
                f"{where}: nothing names class {number}; give --label-classes NAME,... in the "
                f"order of their numbers, or a {CLASS_FILES[0]} beside the labels"
            )
        return "0"
    if number >= len(classes):
        raise InputError(
            f"{where}: unknown class {number}; known are "
            + _shown(", ".join(f"{i} {name}" for i, name in enumerate(classes)), 4 * _SHOWN)
        )
    return classes[number]


def _corners_of_shares(where: str, values: Sequence[float]) -> tuple[float, float, float, float]:
    if not all(0.0 <= value <= 1.0 for value in values):
        outside = next(value for value in values if not 0.0 <= value <= 1.0)
        raise InputError(
            f"{where}: {outside:g} is no share of the picture; expected numbers from 0 to 1"
        )
    if len(values) != 4:
        x, y = values[::2], values[1::2]
        corners = min(x), min(y), max(x), max(y)
    else:
        x_middle, y_middle, width, height = values
        corners = (
            x_middle - 0.5 * width,
            y_middle - 0.5 * height,
            x_middle + 0.5 * width,
            y_middle + 0.5 * height,
        )
    if not (corners[0] < corners[2] and corners[1] < corners[3]):
        raise InputError(f"{where}: its box has no width or no height")
    return corners


def find_class_names(folders: Sequence[Path]) -> tuple[str, ...] | None:
    """Names of YOLO's classes from the first of `CLASS_FILES` in the first folder that has one.

    Raises:
        InputError: It names none.
    """
    for folder in folders:
        for name in CLASS_FILES:
            if (folder / name).is_file():
                return read_class_names(folder / name)
    return None


def read_class_names(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Names of YOLO's classes: a line each, or ``names`` of a YAML file.

    Raises:
        InputError: The file names none.
    """
    text = _files.whole_text(path, _MOST_BYTES)
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        names = _yaml_names(text)
    else:
        names = [line.strip() for line in text.splitlines()]
        while names and not names[-1]:
            names.pop()
    if not names or not all(names) or len(names) > _MOST_CLASSES:
        raise InputError(f"{path}: names no classes that can be read; expected one a line")
    return tuple(names)


_LIST = re.compile(r"^names\s*:\s*[\[{](.*?)[\]}]", re.MULTILINE | re.DOTALL)
_BLOCK = re.compile(r"^names\s*:\s*(?:#.*)?\n((?:[ \t]*(?:-|\d+\s*:).*\n?|\s*\n)+)", re.MULTILINE)
_ITEM = re.compile(r"^\s*(?:-\s*|(\d+)\s*:\s*)?(.*?)\s*$")


def _yaml_names(text: str) -> list[str]:
    """Names as Ultralytics writes them: a list or a map, in a line or over several."""
    inline = _LIST.search(text)
    block = None if inline else _BLOCK.search(text)
    if inline is not None:
        parts = inline[1].replace("\n", " ").split(",")
    else:
        parts = block[1].splitlines() if block is not None else []
    named: dict[int, str] = {}
    for part in parts:
        item = _ITEM.match(part.split(" #")[0])
        if item is None or not item[2]:
            continue
        number = int(item[1]) if item[1] and len(item[1]) < 6 else len(named)
        named[number] = item[2].strip("'\"")
    complete = set(named) == set(range(len(named)))
    return [named[i] for i in range(len(named))] if complete else []


def read_coco_labels(path: str | os.PathLike[str]) -> dict[str, PictureLabels]:
    """The boxes of a COCO file, by the ``file_name`` of the picture.

    Raises:
        InputError: The file is no such JSON, an annotation is of an unknown picture or category, or
            its box does not lie in the picture.
    """
    try:
        content = json.loads(_files.whole_text(path, _MOST_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, or is cut short ({error})") from error
    parts = [content.get(key) if isinstance(content, dict) else None for key in _PARTS]
    if not all(isinstance(part, list) for part in parts):
        raise InputError(f"{path}: is no COCO file; expected lists {', '.join(_PARTS)}")
    pictures, annotations, categories = (list(_rows(path, *one)) for one in _named(parts))
    names = {_number(path, row, "id"): _text(path, row, "name") for row in categories}
    known: dict[int, tuple[str, tuple[int, int]]] = {}
    for row in pictures:
        size = _number(path, row, "width"), _number(path, row, "height")
        known[_number(path, row, "id")] = _text(path, row, "file_name"), size
    found: dict[int, list[tuple[list[float], str, bool]]] = {key: [] for key in known}
    for row in annotations:
        picture, category = _number(path, row, "image_id"), _number(path, row, "category_id")
        where = f"{path}: annotation {_shown(str(row.get('id', '?')))}"
        if picture not in known:
            raise InputError(f"{where}: is of picture {picture}, which the file does not list")
        if category not in names:
            listed = _shown(", ".join(f"{i} {name}" for i, name in names.items()), 4 * _SHOWN)
            raise InputError(f"{where}: unknown category {category}; known are {listed}")
        box = _corners_of_pixels(where, row.get("bbox"), known[picture][1])
        found[picture].append((box, names[category], bool(row.get("iscrowd", 0))))
    out: dict[str, PictureLabels] = {}
    for key, (name, size) in known.items():
        if name in out:
            raise InputError(f"{path}: lists the picture {_shown(name)} twice")
        boxes = found[key]
        out[name] = PictureLabels(
            np.array([box for box, _, _ in boxes], dtype=np.float64).reshape(-1, 4),
            np.array([label for _, label, _ in boxes], dtype=np.str_),
            np.array([crowd for _, _, crowd in boxes], dtype=bool),
            size,
        )
    return out


_PARTS = ("images", "annotations", "categories")


def _named(parts: Sequence[object]) -> Iterator[tuple[str, object]]:
    yield from zip(_PARTS, parts, strict=True)


def _rows(path: str | os.PathLike[str], name: str, rows: object) -> Iterator[Mapping[str, object]]:
    assert isinstance(rows, list), "checked before"
    for number, row in enumerate(rows, start=1):
        if not isinstance(row, dict):
            raise InputError(f"{path}: {name}[{number}] is no object")
        yield row


def _number(path: str | os.PathLike[str], row: Mapping[str, object], key: str) -> int:
    value = row.get(key)
    # Some tools write all numbers with a point.
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or abs(value) > _LARGEST:
        raise InputError(f"{path}: {key} of {_shown(str(row))} is no whole number")
    return value


def _text(path: str | os.PathLike[str], row: Mapping[str, object], key: str) -> str:
    value = row.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(f"{path}: {key} of {_shown(str(row))} is no text")
    return value


def _corners_of_pixels(where: str, box: object, size_px: tuple[int, int]) -> list[float]:
    usable = isinstance(box, list) and len(box) == 4
    numbers = [v for v in box if isinstance(v, int | float)] if isinstance(box, list) else []
    # Neither what is not a number nor what is too large for one is less.
    values = [v for v in numbers if abs(v) < _LARGEST]
    if not usable or len(values) != 4:
        raise InputError(f"{where}: bbox is {_shown(repr(box))}; expected x, y, width, height, px")
    x, y, width, height = map(float, values)
    if not (width > 0.0 and height > 0.0):
        raise InputError(f"{where}: its box has no width or no height")
    right, bottom = size_px[0] + _BEYOND_PX, size_px[1] + _BEYOND_PX
    if not (min(x, y) >= -_BEYOND_PX and x + width <= right and y + height <= bottom):
        raise InputError(
            f"{where}: its box {_shown(repr(box))} reaches out of the picture of {size_px[0]} x "
            f"{size_px[1]} px"
        )
    return [x, y, x + width, y + height]


def _shown(text: str, most: int = _SHOWN) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."
