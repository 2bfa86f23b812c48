"""Tables of boxes of any origin: how their cells are separated, and what their columns are."""

from __future__ import annotations

import difflib
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from sightline.errors import InputError
from sightline.formats import _files

CORNERS = ("x1", "y1", "x2", "y2")
MOT_COLUMNS = ("frame", "track_id", "left", "top", "width", "height", "confidence")
"""The first columns of a MOTChallenge file, which has no header."""

KNOWN = (*CORNERS, "frame", "time_utc", "confidence", "annotator", "track_id", "label", "target")
"""The names that this project writes."""

# Each role's names, the first of a table's that is found wins.
_NAMES: dict[str, tuple[str, ...]] = {
    "frame": (
        *("frame", "frame_id", "frame_index", "frame_idx", "frame_number", "frame_no"),
        *("frame_num", "frame_nr", "frameid", "frameindex", "framenumber", "frames"),
    ),
    "time_utc": ("time_utc", "utc", "timestamp_utc", "datetime_utc", "utc_time"),
    "confidence": (
        *("confidence", "conf", "score", "confidence_score", "det_conf", "det_score"),
        *("detection_confidence", "detection_score", "probability", "prob"),
    ),
    "track_id": (
        *("track_id", "tracker_id", "trackid", "object_id", "obj_id", "target_id", "identity"),
        *("track", "tid", "id"),
    ),
    "label": ("label", "class_name", "category_name", "category", "class", "cls", "name", "type"),
    "annotator": ("annotator", "source", "detector"),
    "target": ("target",),
    "left": (
        *("x1", "xmin", "x_min", "left", "xtl", "tlx", "x_tl", "tl_x", "x_left", "left_x"),
        *("x_top_left", "top_left_x", "min_x", "minx"),
    ),
    "top": (
        *("y1", "ymin", "y_min", "top", "ytl", "tly", "y_tl", "tl_y", "y_top", "top_y"),
        *("y_top_left", "top_left_y", "min_y", "miny"),
    ),
    "right": (
        *("x2", "xmax", "x_max", "right", "xbr", "brx", "x_br", "br_x", "x_right", "right_x"),
        *("x_bottom_right", "bottom_right_x", "max_x", "maxx"),
    ),
    "bottom": (
        *("y2", "ymax", "y_max", "bottom", "ybr", "bry", "y_br", "br_y", "y_bottom", "bottom_y"),
        *("y_bottom_right", "bottom_right_y", "max_y", "maxy"),
    ),
    "width": ("width", "w", "xywh_w", "xywh_2", "xywhn_w", "xywhn_2"),
    "height": ("height", "h", "xywh_h", "xywh_3", "xywhn_h", "xywhn_3"),
    "centre_x": (
        *("cx", "xc", "x_center", "x_centre", "center_x", "centre_x", "xcenter", "xcentre"),
        *("x_c", "c_x", "xywh_x", "xywh_0", "xywhn_x", "xywhn_0"),
    ),
    "centre_y": (
        *("cy", "yc", "y_center", "y_centre", "center_y", "centre_y", "ycenter", "ycentre"),
        *("y_c", "c_y", "xywh_y", "xywh_1", "xywhn_y", "xywhn_1"),
    ),
    "x": ("x",),
    "y": ("y",),
    "visibility": ("visibility", "vis"),
    "class_id": ("class_id", "classid", "cls_id", "category_id"),
}
# Told by no note: what they say has no place here.
_PASSED_OVER = {"x", "y", "z", "visibility", "class_id", "world_x", "world_y", "world_z", ""}
_PREFIX = re.compile(r"^(bounding_?box|bbox|bb|box|rect|det|detection)_(?=.)")
_UNIT = re.compile(r"_?(\(px\)|\[px\]|px|pixels?)$")
_PLAIN_NUMBER = re.compile(r"^[-+]?\d+([.,]\d+)?$")
_ALMOST = 0.8
_LOOKED_AT_LINES = 200

_LABELS_OF_YOLO = (
    "; labels as YOLO writes them, a file a frame, name no frame: put them into one table with the "
    "header frame,class_id,xc,yc,w,h"
)
_CENTRE = ("centre_x", "centre_y", "width", "height")

Extent = Literal["corners", "size", "centre"]


@dataclass(frozen=True)
class TableForm:
    """How a table of boxes is written.

    Attributes:
        separator: Between cells, as pandas takes it.
        decimal: Decimal point or comma.
        encoding: Of the text.
        skipped_lines: Before the first row.
        columns: How many cells a row has at most.
        names: Of the columns, as they stand in the file; empty where there is no header.
        places: The column of each role.
        extent: Whether boxes are given by two corners, by a corner or by the centre and their size.
        mot: Whether MOTChallenge's conventions hold: frames count from 1.
        unused: Names of columns that say nothing here.
    """

    separator: str
    decimal: str
    encoding: str
    skipped_lines: int
    columns: int
    names: tuple[str, ...]
    places: dict[str, int]
    extent: Extent
    mot: bool
    unused: tuple[str, ...] = ()

    @property
    def bare(self) -> bool:
        """Whether nothing tells the corner from the centre: the columns are called x and y."""
        return bool(self.names) and self.extent == "size" and _plain(self.name("left")) == "x"

    @property
    def of_ultralytics(self) -> bool:
        """Whether a column has a name that YOLO gives, whose ``xywh`` begin with the centre."""
        return "cls" in map(_plain, self.names)

    def with_centres(self) -> TableForm:
        """The same table, its x and y taken for the centre."""
        places = {role: i for role, i in self.places.items() if role not in ("left", "top")}
        places |= {"centre_x": self.places["left"], "centre_y": self.places["top"]}
        return replace(self, places=places, extent="centre")

    def with_classes_first(self, ids_last: bool) -> TableForm:
        """The same rows as YOLO writes them behind the frame: class, centre, size.

        Args:
            ids_last: Whether the track follows the size, without a confidence before it.
        """
        last = ("track_id",) if ids_last else ("confidence", "track_id")
        roles = ("frame", "class_id", *_CENTRE, *last)[: self.columns]
        return replace(self, places={role: i for i, role in enumerate(roles)}, extent="centre")

    @property
    def geometry(self) -> tuple[str, str, str, str]:
        """The roles of the four columns that tell the box."""
        return {
            "corners": ("left", "top", "right", "bottom"),
            "size": ("left", "top", "width", "height"),
            "centre": _CENTRE,
        }[self.extent]

    def name(self, role: str) -> str:
        """What the file calls a column, or MOTChallenge where it has no header."""
        place = self.places[role]
        if self.names:
            return self.names[place]
        mot = ("frame", "id", "bb_left", "bb_top", "bb_width", "bb_height", "conf")
        return mot[place] if place < len(mot) else f"column {place + 1}"


def form_of(path: str | os.PathLike[str]) -> TableForm:
    """How a table of boxes is written, from its first lines.

    Raises:
        InputError: It is no text, or its columns are not those of boxes; names those it has.
    """
    encoding = _encoding(path)
    if encoding != "utf-16":
        _files.check_width(path, "a header with frame,x1,y1,x2,y2")
    head = _files.beginning(path) if encoding != "utf-16" else _head_utf16(path)
    # The last line may be cut off.
    lines = head.splitlines()
    lines = lines[:-1] if len(lines) > 1 and len(head) >= 60_000 else lines
    first = next((i for i, line in enumerate(lines) if line.strip() and not _comment(line)), None)
    if first is None:
        raise InputError(f"{path}: holds no table; expected a header with frame,x1,y1,x2,y2")
    rows = [line for line in lines[first : first + _LOOKED_AT_LINES] if line.strip()]
    separator = _separator(rows)
    cells = _split(rows[0], separator)
    if _is_header(cells):
        return _named(path, first + 1, cells, rows[1:], separator, encoding)
    decimal = _decimal(rows, separator)
    told = _comment_header(lines[:first], separator, len(cells))
    if told:
        return _named(path, first, told, rows, separator, encoding)
    return _headless(path, first, rows, separator, decimal, encoding)


def _encoding(path: str | os.PathLike[str]) -> str:
    with _files.existing(path).open("rb") as file:
        mark = file.read(2)
    return "utf-16" if mark in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"


def _head_utf16(path: str | os.PathLike[str]) -> str:
    try:
        with _files.existing(path).open(encoding="utf-16") as file:
            return file.read(65536)
    except UnicodeError as error:
        raise InputError(f"{path}: is not text in UTF-16, as its first bytes say") from error


def _comment(line: str) -> bool:
    return line.lstrip().startswith(("#", "%", "//"))


def _separator(rows: Sequence[str]) -> str:
    """What stands between the cells of all rows: the first of the usual ones that is in each."""
    words = [row.split() for row in rows[:50]]
    if all(len(row) >= 6 and all(map(_PLAIN_NUMBER.match, row)) for row in words):
        return r"\s+"
    for candidate in ("\t", ";", "|", ","):
        counts = {len(_split(row, candidate)) for row in rows[:50]}
        # A decimal comma is in every row as well, so the commas come last.
        if min(counts) >= 4:
            return candidate
    if all(len(row) >= 4 for row in words):
        return r"\s+"
    return ","


def _split(row: str, separator: str) -> list[str]:
    if separator == r"\s+":
        return row.split()
    cells, quoted, cell = [], False, ""
    for character in row:
        if character == '"':
            quoted = not quoted
        elif character == separator and not quoted:
            cells.append(cell.strip())
            cell = ""
        else:
            cell += character
    return [*cells, cell.strip()]


def _decimal(rows: Sequence[str], separator: str) -> str:
    if separator == ",":
        return "."
    text = " ".join(rows)
    comma = re.search(r"(^|[\s;|])-?\d+,\d+([\s;|]|$)", text)
    return "," if comma and not re.search(r"\d\.\d", text) else "."


def _number(cell: str) -> bool:
    try:
        float(cell.replace(",", ".").removesuffix("%"))
    except ValueError:
        return cell.lower() in ("", "none", "null", "na", "n/a", "<na>")
    return True


def _is_header(cells: Sequence[str]) -> bool:
    """Whether a first row names columns: nothing in it but words, or a name of a column."""
    if all(_number(cell) for cell in cells):
        return False
    roles = {_role_of(cell) for cell in cells}
    return not any(cell and _number(cell) for cell in cells) or len(roles - {None}) >= 3


def _comment_header(lines: Sequence[str], separator: str, count: int) -> list[str]:
    """The cells of a header that is written as a comment; empty where there is none."""
    for line in reversed(lines):
        cells = _split(line.lstrip().lstrip("#%/ "), separator)
        roles = {_role_of(cell) for cell in cells} - {None}
        if len(cells) == count and len(roles) >= 4:
            return cells
    return []


def _plain(name: str) -> str:
    text = re.sub(r"[\s\-./]+", "_", name.strip().strip("\"'#").strip().lower())
    return _UNIT.sub("", text) or text


def _stem(name: str) -> str:
    return _PREFIX.sub("", _plain(name))


def _role_of(name: str) -> str | None:
    for text in (_plain(name), _stem(name)):
        for role, names in _NAMES.items():
            if text in names:
                return role
    return None


def _places(names: Sequence[str]) -> dict[str, int]:
    """The column of each role; of several names of one role the first of `_NAMES`."""
    plain, stems = [_plain(name) for name in names], [_stem(name) for name in names]
    places: dict[str, int] = {}
    for role, known in _NAMES.items():
        for name in known:
            found = next((i for i, text in enumerate(plain) if text == name), None)
            if found is None:
                found = next((i for i, text in enumerate(stems) if text == name), None)
            if found is not None:
                places[role] = found
                break
    if {"x0", "y0", "x1", "y1"} <= set(stems):
        # Corners that count from 0.
        places |= {
            "left": stems.index("x0"),
            "top": stems.index("y0"),
            "right": stems.index("x1"),
            "bottom": stems.index("y1"),
        }
    if {"x", "y", "width", "height"} <= places.keys() and "detection_id" in plain:
        # Roboflow: its x and y are the centre.
        places.setdefault("centre_x", places["x"])
        places.setdefault("centre_y", places["y"])
    elif {"x", "y", "width", "height"} <= places.keys():
        places.setdefault("left", places["x"])
        places.setdefault("top", places["y"])
    return places


def _named(
    path: str | os.PathLike[str],
    skipped_lines: int,
    names: list[str],
    rows: Sequence[str],
    separator: str,
    encoding: str,
) -> TableForm:
    widest = max((len(_split(row, separator)) for row in rows), default=0)
    beyond = [cell for row in rows for cell in _split(row, separator)[len(names) :]]
    if any(beyond):
        raise InputError(f"{path}: its rows have more cells than its header has names")
    names = [*names, *[""] * (widest - len(names))]
    places = _places(names)
    extent = _extent(places)
    if extent is None:
        raise _no_boxes(path, names, places)
    if "frame" not in places and "time_utc" not in places:
        hint = ""
        if {"x_min", "tracker_id"} <= {_plain(name) for name in names}:
            hint = '; supervision writes it with custom_data={"frame": NUMBER}'
        raise InputError(
            f"{path}: lacks the column frame (or time_utc); found "
            f"{_files.shortened(', '.join(filter(None, names)), 300)}{hint}"
        )
    stems = {_plain(name) for name in names}
    mot = bool({"bb_left", "bb_width"} & stems) or str(path).lower().endswith(".txt")
    form = TableForm(
        separator,
        _decimal(rows, separator),
        encoding,
        skipped_lines,
        len(names),
        tuple(name.strip().strip('"') for name in names),
        places,
        extent,
        mot,
    )
    used = {*form.geometry, "frame", "time_utc", "confidence", "annotator", "track_id"}
    used |= {"label", "target", "visibility"}
    taken = {place for role, place in places.items() if role in used}
    others = [name for i, name in enumerate(form.names) if i not in taken]
    return TableForm(**{**vars(form), "unused": _unused(path, others)})


def _extent(places: Iterable[str]) -> Extent | None:
    roles = set(places)
    if {"left", "top", "right", "bottom"} <= roles:
        return "corners"
    if {"centre_x", "centre_y", "width", "height"} <= roles:
        return "centre"
    if {"left", "top", "width", "height"} <= roles:
        return "size"
    return None


def _no_boxes(
    path: str | os.PathLike[str], names: Sequence[str], places: dict[str, int]
) -> InputError:
    roles = ("left", "top", "right", "bottom")
    missing = [name for name, role in zip(CORNERS, roles, strict=True) if role not in places]
    return InputError(
        f"{path}: lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)}; found "
        f"{_files.shortened(', '.join(filter(None, names)), 300)} (a box may also be "
        "left,top,width,height or cx,cy,width,height)"
    )


def _unused(path: str | os.PathLike[str], names: Sequence[str]) -> tuple[str, ...]:
    """Names that say nothing here; one that is almost a known one is refused."""
    every = {text for known in _NAMES.values() for text in known}
    unused = []
    for name in names:
        text = _plain(name)
        if text in _PASSED_OVER or _stem(name) in _PASSED_OVER:
            continue
        if text not in every and difflib.get_close_matches(text, KNOWN, cutoff=_ALMOST):
            raise InputError(
                f"{path}: unknown column {_files.shortened(name)!r}; known are {', '.join(KNOWN)}"
            )
        unused.append(name)
    return tuple(unused)


def _are_labels(cells: Sequence[Sequence[str]]) -> bool:
    """Whether rows are class, centre and size in shares of the picture, as YOLO labels are."""
    try:
        rows = [[float(cell) for cell in row[:5]] for row in cells if any(row)]
    except ValueError:
        return False
    return all(row[0] % 1.0 == 0.0 and all(0.0 <= v <= 1.0 for v in row[1:]) for row in rows)


def _headless(
    path: str | os.PathLike[str],
    skipped_lines: int,
    rows: Sequence[str],
    separator: str,
    decimal: str,
    encoding: str,
) -> TableForm:
    cells = [_split(row, separator) for row in rows]
    # A separator at the end of each row makes a cell that is never filled.
    filled = (i + 1 for row in cells for i, cell in enumerate(row) if cell)
    widest = max(filled, default=0)
    if widest < 6:
        raise InputError(
            f"{path}: has {widest} columns; a MOTChallenge file has at least six: "
            "frame,id,bb_left,bb_top,bb_width,bb_height"
            + (_LABELS_OF_YOLO if widest == 5 and _are_labels(cells) else "")
        )
    places = {role: i for i, role in enumerate(MOT_COLUMNS[:widest])}
    if widest >= 8 and any(not _number(row[7]) for row in cells if len(row) > 7):
        places["label"] = 7
    elif widest == 9:
        places["class_id"], places["visibility"] = 7, 8
    known = places.get("label")
    words = [c for row in cells for i, c in enumerate(row) if i != known and not _number(c)]
    if words:
        raise InputError(
            f"{path}, line {skipped_lines + 1}: has no header, and {_files.shortened(words[0])!r} "
            "in a column that a MOTChallenge file has numbers in; write a header, as "
            "frame,x1,y1,x2,y2"
        )
    columns = max(len(row) for row in cells)
    return TableForm(
        separator, decimal, encoding, skipped_lines, columns, (), places, "size", mot=True
    )
