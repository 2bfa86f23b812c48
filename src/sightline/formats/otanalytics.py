"""Sections and flows of OTAnalytics (``.otflow``), and its table of counted flows.

The forms are those of OpenTrafficCam/OTAnalytics: ``domain/section.py``, ``domain/flow.py`` and the
CSV of ``plugin_parser/export.py``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sightline.atomic import atomic_path
from sightline.errors import InputError
from sightline.formats import _files
from sightline.text import cell_text, encodable_text
from sightline.types import FloatArray

FLOW_COLUMNS = (
    *("start time", "end time", "classification", "flow", "from section", "to section"),
    "count",
)
"""The columns of OTAnalytics' table of counts."""

_MOST_BYTES = 2**26
_MOST_CORNERS = 1000
_FOOT = (0.5, 1.0)


@dataclass(frozen=True, eq=False)
class PixelSections:
    """Sections of an ``.otflow`` file, in pixels of the picture, and the flows between them.

    Attributes:
        lines: By name, (K, 2) x and y.
        areas: By name, (K, 2) x and y, not closed.
        flows: Name, first and last section of each.
        offsets: Of the sections that are not meant for the middle of a box's lower edge, the point
            of a box that crosses them: shares of its width and height from its upper left corner.
    """

    lines: Mapping[str, FloatArray] = field(default_factory=dict)
    areas: Mapping[str, FloatArray] = field(default_factory=dict)
    flows: tuple[tuple[str, str, str], ...] = ()
    offsets: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def is_otflow(path: str | os.PathLike[str]) -> bool:
    """Whether a file is one of OTAnalytics, by its ending."""
    return Path(path).suffix.lower() in (".otflow", ".otconfig")


def read_otflow(path: str | os.PathLike[str]) -> PixelSections:
    """Sections and flows of OTAnalytics, from an ``.otflow`` or ``.otconfig`` file.

    Raises:
        InputError: It is neither, a section or flow is incomplete, two have the same name, or a
            flow names a section that is not there.
    """
    try:
        content = json.loads(_files.whole_text(path, _MOST_BYTES))
        sections, flows = content["sections"], content.get("flows") or []
    except (ValueError, RecursionError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{path}: is no file of OTAnalytics; it has no sections") from error
    if not isinstance(sections, list) or not isinstance(flows, list):
        raise InputError(f"{path}: is no file of OTAnalytics; its sections are no list")
    lines: dict[str, FloatArray] = {}
    areas: dict[str, FloatArray] = {}
    offsets: dict[str, tuple[float, float]] = {}
    names: dict[str, str] = {}
    for number, one in enumerate(sections, start=1):
        where = f"{path}: section {number}"
        try:
            name = encodable_text(str(one.get("name") or one["id"]).strip())
            corners, kind = _corners(one), one["type"]
            offset = one.get("relative_offset_coordinates", {}).get("section-enter", {})
            point = float(offset.get("x", _FOOT[0])), float(offset.get("y", _FOOT[1]))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise InputError(
                f"{where} is incomplete; expected id, type (line or area) and coordinates x, y"
            ) from error
        if name in names.values():
            raise InputError(f"{where} has the name {_files.shortened(name)}, as another has")
        if kind not in ("line", "area"):
            raise InputError(f"{where} is a {str(kind)[:40]}; known are line and area")
        names[str(one["id"])] = name
        (lines if kind == "line" else areas)[name] = corners
        if point != _FOOT:
            offsets[name] = point
    return PixelSections(lines, areas, tuple(_flows(path, flows, names)), offsets)


def _corners(section: Mapping[str, Any]) -> FloatArray:
    # Lines of before 2023 have a start and an end.
    given = section.get("coordinates") or [section["start"], section["end"]]
    corners = np.array([[float(one["x"]), float(one["y"])] for one in given])
    if section["type"] == "area" and len(corners) > 1 and (corners[0] == corners[-1]).all():
        corners = corners[:-1]
    least = 2 if section["type"] == "line" else 3
    if not least <= len(corners) <= _MOST_CORNERS or not np.isfinite(corners).all():
        raise ValueError("too few corners, or too many")
    return corners


def _flows(
    path: str | os.PathLike[str], flows: list[Any], names: Mapping[str, str]
) -> Iterable[tuple[str, str, str]]:
    known: set[str] = set()
    for number, one in enumerate(flows, start=1):
        where = f"{path}: flow {number}"
        try:
            name = encodable_text(str(one.get("name") or one["id"]).strip())
            ends = names[str(one["start"])], names[str(one["end"])]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(
                f"{where} is incomplete; expected id, and the sections' ids as start and end"
            ) from error
        if name in known:
            raise InputError(f"{where} has the name {_files.shortened(name)}, as another has")
        known.add(name)
        yield name, *ends


def write_flow_counts(
    rows: Iterable[Mapping[str, str | int | float | None]], path: str | os.PathLike[str]
) -> None:
    """Write counted flows as OTAnalytics does, so that what reads its tables reads these.

    Args:
        rows: With ``begin_utc``, ``end_utc``, ``class``, ``name``, ``origin``, ``destination`` and
            ``count``.
        path: A CSV file.

    Raises:
        InputError: It cannot be written.
    """
    table = [
        (
            _time(row["begin_utc"]),
            _time(row["end_utc"]),
            *(cell_text(str(row[key])) for key in ("class", "name", "origin", "destination")),
            row["count"],
        )
        for row in rows
    ]
    with atomic_path(path) as temporary:
        pd.DataFrame(table, columns=list(FLOW_COLUMNS)).to_csv(temporary, index=False)


def _time(rfc3339: object) -> str:
    return datetime.fromisoformat(str(rfc3339)).strftime("%Y-%m-%d %H:%M:%S")
