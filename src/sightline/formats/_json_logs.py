"""Logs as JSON: gpsd, Signal K, lines of any program, and GeoJSON with times."""

from __future__ import annotations

import itertools
import json
import os
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._log_names import of_place_and_time
from sightline.formats._log_table import LogTable
from sightline.formats._receivers import Source, of_one_receiver
from sightline.formats._times import NotUnderstoodError, read_times
from sightline.tally import Tally
from sightline.text import encodable_text

_MOST_BYTES = 512 * 2**20
_GEOJSON = re.compile(r'"type"\s*:\s*"(?:FeatureCollection|Feature|(?:Multi)?LineString|Point)"')
_COCO = re.compile(r'"(?:bbox|annotations|image_id|segmentation)"\s*:')
_GPSD_CLASSES = ("VERSION", "DEVICES", "DEVICE", "WATCH", "TPV", "SKY", "PPS", "TOFF")
_GPSD = re.compile(rf'"class"\s*:\s*"(?:{"|".join(_GPSD_CLASSES)})"')
_LINE = re.compile(r"^\s*\{.*\},?\s*$", re.MULTILINE)
_FIX_MODES = (2, 3)
_NO_FIX = "without a fix"
_DEEPEST = 20


def is_json(head: str) -> bool:
    """Whether a text begins as JSON does."""
    return head.lstrip("\ufeff \t\r\n").startswith(("{", "["))


def coco_refusal(path: str | os.PathLike[str]) -> InputError:
    """What is said of COCO's boxes, wherever they are given."""
    return InputError(
        f"{path}: is JSON of boxes, as COCO has it, which names pictures and no frames; write a "
        "table with the header frame,left,top,width,height,confidence (the four numbers of bbox)"
    )


def is_coco(head: str) -> bool:
    """Whether a text begins as COCO's JSON of boxes does."""
    return is_json(head) and bool(_COCO.search(head)) and not _GEOJSON.search(head)


@dataclass
class _Rows:
    """Texts of fixes, and where each stands.

    Attributes:
        row: Number of the line or of the point, from 1.
        time: As it stands.
        latitude: As it stands.
        longitude: As it stands.
        source: Of which receiver, or ``""``.
    """

    row: list[int] = field(default_factory=list)
    time: list[str] = field(default_factory=list)
    latitude: list[str] = field(default_factory=list)
    longitude: list[str] = field(default_factory=list)
    source: list[str] = field(default_factory=list)

    def add(self, row: int, time: Any, place: tuple[Any, Any], source: Any = "") -> None:
        self.row.append(row)
        self.time.append(_text(time))
        self.latitude.append(_text(place[0]))
        self.longitude.append(_text(place[1]))
        self.source.append(encodable_text(source) if isinstance(source, str) else "")


def _text(value: Any) -> str:
    if isinstance(value, bool | dict | list) or value is None:
        return ""
    return encodable_text(_files.cell(value))


def read_json_log(path: str | os.PathLike[str], tally: Tally) -> tuple[LogTable, str]:
    """The time and the place of each fix of a log in JSON, and what its rows are counted as.

    Args:
        path: The file.
        tally: Takes what was read and left out.

    Raises:
        InputError: It is JSON of another kind, which the line names, or none.
    """
    head = _files.beginning(path)
    if is_coco(head):
        raise coco_refusal(path)
    if _GEOJSON.search(head) and not _GPSD.search(head):
        rows, counted = _of_geojson(path, tally), "point"
    else:
        rows, counted = _of_objects(path, tally)
    if not rows.row:
        raise InputError(
            f"{path}: is JSON, and holds no fix that is known; expected gpsd (TPV), Signal K "
            "(navigation.position), or objects with a time, a latitude and a longitude"
        )
    tally.count("rows", len(rows.row))
    kept = _of_one_receiver(rows, tally)
    index = pd.Index(np.array(rows.row)[kept])

    def column(name: str) -> pd.Series:
        return pd.Series(np.array(getattr(rows, name), dtype=object)[kept], index=index, name=name)

    table = LogTable(
        time=column("time"),
        latitude=column("latitude"),
        longitude=column("longitude"),
        places=("latitude", "longitude"),
        cut_short=(),
    )
    return table, counted


def _of_one_receiver(rows: _Rows, tally: Tally) -> np.ndarray:
    """(N,) bool, the rows of the receiver with most of them; see `of_one_receiver`."""
    names = np.array(rows.source)
    if np.unique(names).size < 2:
        return np.ones(names.size, dtype=bool)
    try:
        time_s = read_times(rows.time, strict=False).time_utc_s
    except NotUnderstoodError:
        return np.ones(names.size, dtype=bool)
    places = (_files.floats(pd.Series(texts)) for texts in (rows.latitude, rows.longitude))
    kept = of_one_receiver(names, Source(time_s, *places))
    for name, count in Counter(names[~kept].tolist()).items():
        first = int(np.argmax(~kept & (names == name)))
        reason = f"of another receiver ({_files.shortened(name) or 'unnamed'})"
        tally.leave_out(reason, count, row=f"line {rows.row[first]}")
    return kept


def _of_objects(path: str | os.PathLike[str], tally: Tally) -> tuple[_Rows, str]:
    """Fixes of a log with an object a line, or of a document that has them in lists."""
    tally.format = "JSON lines"
    taken = _Objects(tally, "line")
    if not _is_of_lines(path):
        try:
            document = json.loads(_files.whole_text(path, _MOST_BYTES))
        except (ValueError, RecursionError) as error:
            if not _LINE.search(_files.beginning(path)):
                raise InputError(
                    f"{path}: is no JSON, is damaged, or is cut short ({error})"
                ) from error
        else:
            tally.format = "JSON"
            taken.counted = "object"
            for number, found in enumerate(_objects(document), start=1):
                taken.take(number, found)
            return taken.rows, taken.counted
    for number, line in _files.log_lines(path):
        # A list of an object a line that was cut short, or grows.
        text = line.strip().removesuffix(",")
        if text in ("", "[", "]"):
            continue
        try:
            found = json.loads(text)
        except (ValueError, RecursionError):
            tally.leave_out("lines that are no JSON", row=f"line {number}", text=text)
            continue
        if isinstance(found, dict):
            taken.take(number, found)
    return taken.rows, taken.counted


def _is_of_lines(path: str | os.PathLike[str]) -> bool:
    """Whether a file has more than a line, and the first is a value of its own."""
    lines = (line.strip() for _, line in _files.log_lines(path))
    filled = list(itertools.islice((line for line in lines if line), 2))
    if len(filled) < 2:
        return False
    try:
        json.loads(filled[0])
    except (ValueError, RecursionError):
        return False
    return True


def _objects(document: Any, depth: int = 0) -> Iterator[dict[str, Any]]:
    """The objects of a document that may be fixes, in their order."""
    if depth > _DEEPEST:
        return
    if isinstance(document, dict):
        if _is_message(document) or _fix_of(document) is not None:
            yield document
            return
        document = list(document.values())
    if isinstance(document, list):
        for one in document:
            if isinstance(one, dict | list):
                yield from _objects(one, depth + 1)


def _is_message(found: dict[str, Any]) -> bool:
    return "class" in found or "updates" in found


def _fix_of(found: dict[str, Any]) -> tuple[Any, tuple[Any, Any]] | None:
    """Time and place of an object, whatever its program calls them; None: it has not both.

    The place may be an object of its own within, as ``{"position": {"lat": ...}}``.
    """
    names = of_place_and_time(found)
    if "time" not in names:
        return None
    if {"latitude", "longitude"} <= names.keys():
        return found[names["time"]], (found[names["latitude"]], found[names["longitude"]])
    for inner in found.values():
        if isinstance(inner, dict):
            place = of_place_and_time(inner)
            if {"latitude", "longitude"} <= place.keys():
                return found[names["time"]], (inner[place["latitude"]], inner[place["longitude"]])
    return None


@dataclass
class _Objects:
    """Takes fixes out of objects.

    Attributes:
        tally: Takes what is left out.
        counted: What the numbers of objects count: lines, or objects.
        rows: What was found.
        own: Whose deltas of Signal K are those of the vessel itself, or ``""``.
    """

    tally: Tally
    counted: str
    rows: _Rows = field(default_factory=_Rows)
    own: str = ""

    def take(self, number: int, found: dict[str, Any]) -> None:
        """Take the fixes of an object, if it has any."""
        where = f"{self.counted} {number}"
        if "class" in found and "lat" not in found and found.get("class") != "TPV":
            if found["class"] in _GPSD_CLASSES:
                self.tally.format = "gpsd"
        elif found.get("class") == "TPV":
            self.tally.format = "gpsd"
            if found.get("mode") not in _FIX_MODES:
                self.tally.leave_out(_NO_FIX, row=where)
            else:
                place = (found.get("lat"), found.get("lon"))
                self.rows.add(number, found.get("time"), place, found.get("device"))
        elif "updates" in found:
            self.tally.format = "Signal K"
            if found.get("context") in (None, self.own, "vessels.self"):
                _add_delta(self.rows, number, found["updates"])
            else:
                self.tally.leave_out("deltas of other vessels (context)", row=where)
        elif isinstance(found.get("self"), str):
            # The server's greeting says whose deltas these are.
            own = found["self"]
            self.own = own if own.startswith("vessels.") else f"vessels.{own}"
        else:
            self._take_fix(number, found)

    def _take_fix(self, number: int, found: dict[str, Any]) -> None:
        fix = _fix_of(found)
        if fix is None:
            return
        time, place = fix
        columns = (time, *place)
        if all(isinstance(column, list) for column in columns):
            # A list for each column.
            if len({len(column) for column in columns}) == 1:
                for i, (when, *where) in enumerate(zip(*columns, strict=True), start=1):
                    self.rows.add(i, when, (where[0], where[1]))
            return
        self.rows.add(number, time, place)


def _add_delta(rows: _Rows, number: int, updates: Any) -> None:
    for update in updates if isinstance(updates, list) else []:
        values = update.get("values") if isinstance(update, dict) else None
        for value in values if isinstance(values, list) else []:
            if isinstance(value, dict) and value.get("path") == "navigation.position":
                place = value.get("value")
                if isinstance(place, dict):
                    where = (place.get("latitude"), place.get("longitude"))
                    rows.add(number, update.get("timestamp"), where, update.get("$source"))


def _of_geojson(path: str | os.PathLike[str], tally: Tally) -> _Rows:
    """Points of GeoJSON tracks whose times stand beside them."""
    tally.format = "GeoJSON"
    try:
        document = json.loads(_files.whole_text(path, _MOST_BYTES))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON, is damaged, or is cut short ({error})") from error
    rows = _Rows()
    points = 0
    for positions, times in _lines_of(document):
        points += len(positions)
        if len(times) != len(positions):
            continue
        for position, time in zip(positions, times, strict=True):
            place = position if isinstance(position, list) and len(position) >= 2 else (None, None)
            rows.add(len(rows.row) + 1, time, (place[1], place[0]))
    if not rows.row:
        raise InputError(
            f"{path}: is GeoJSON, and {'its points have no' if points else 'holds no point with'} "
            "times; expected a property coordTimes with a time for each point of a LineString, or "
            "a property time of each Point; or export the log as GPX"
        )
    return rows


def _lines_of(document: Any) -> Iterator[tuple[list[Any], list[Any]]]:
    """Positions of each line or point of GeoJSON, and their times."""
    features = document.get("features") if isinstance(document, dict) else None
    for feature in features if isinstance(features, list) else [document]:
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        properties = feature.get("properties") if isinstance(feature, dict) else None
        told = properties if isinstance(properties, dict) else {}
        if isinstance(feature, dict) and isinstance(feature.get("temporalGeometry"), dict):
            # OGC Moving Features JSON.
            told = {"coordTimes": feature["temporalGeometry"].get("datetimes")}
            geometry = {"type": "LineString"} | {
                "coordinates": feature["temporalGeometry"].get("coordinates")
            }
        if not isinstance(geometry, dict):
            continue
        inner = told.get("coordinateProperties")
        times = told.get("coordTimes") or (inner.get("times") if isinstance(inner, dict) else None)
        positions = geometry.get("coordinates")
        if not isinstance(positions, list):
            continue
        if geometry.get("type") == "Point":
            yield [positions], [told.get(of_place_and_time(told).get("time", "time"))]
        elif geometry.get("type") == "LineString":
            yield positions, times if isinstance(times, list) else []
        elif geometry.get("type") == "MultiLineString":
            every = times if isinstance(times, list) else []
            nested = len(every) == len(positions) and all(isinstance(one, list) for one in every)
            for i, line in enumerate(positions):
                if isinstance(line, list):
                    yield line, every[i] if nested else []
