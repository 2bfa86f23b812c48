"""AIS as tables: a row a report, with the MMSI of its vessel (MarineCadastre, Danish AIS)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files, _log_rows
from sightline.formats._degrees import read_degrees
from sightline.formats._log_names import mps_of_unit
from sightline.formats._log_table import read_log_table, zone_s
from sightline.tally import Tally
from sightline.types import FloatArray

# What stands for a place, a speed and a course that are not available.
_NO_LATITUDE_DEG, _NO_LONGITUDE_DEG = 91.0, 181.0
_NO_SPEED_KN, _FULL_TURN_DEG = 102.25, 360.0
_KNOT_MPS = 1852.0 / 3600.0
NO_PLACE = "position reports without a place"


@dataclass(frozen=True, slots=True)
class Report:
    """A position that a vessel broadcast.

    Attributes:
        line: Where it stands, from 1.
        mmsi: Of the vessel.
        time_utc_s: POSIX seconds.
        latitude_deg: Degrees north.
        longitude_deg: Degrees east.
        velocity_mps: East and north; NaN where it tells none.
        rough: Whether its place is told to a tenth of a minute only, as for satellites.
    """

    line: int
    mmsi: int
    time_utc_s: float
    latitude_deg: float
    longitude_deg: float
    velocity_mps: tuple[float, float]
    rough: bool = False


def read_table_reports(path: str | os.PathLike[str], tally: Tally) -> Iterator[Report]:
    """The reports of a table whose rows tell the MMSI.

    Args:
        path: The table.
        tally: Takes what was read, left out and assumed.

    Raises:
        InputError: The table cannot be understood, or no row is of use.
    """
    table = read_log_table(path, vessel=True)
    assert table.mmsi is not None, "such a table has the column"
    tally.format = "AIS (CSV)"
    tally.count("position reports", len(table.time) + len(table.cut_short))
    if table.cut_short:
        tally.leave_out("cut short", len(table.cut_short), row=f"line {table.cut_short[0]}")
    numbers = _files.floats(table.mmsi)
    kept = (numbers % 1.0 == 0.0) & (numbers > 0.0) & (numbers < 1e10)
    if not kept.all():
        i = int(np.argmin(kept))
        row, text = f"line {table.mmsi.index[i]}", str(table.mmsi.iloc[i])
        tally.leave_out("without an MMSI", int((~kept).sum()), row=row, text=text)
    places = (table.latitude[kept], table.longitude[kept])
    latitude, longitude, said = read_degrees(path, places, table.places, tally=tally)
    if said:
        tally.note(said)
    none = (np.abs(latitude) == _NO_LATITUDE_DEG) | (np.abs(longitude) == _NO_LONGITUDE_DEG)
    none |= (latitude == 0.0) & (longitude == 0.0)
    off = np.isfinite(latitude + longitude) & ~none & ~_log_rows.on_the_earth(latitude, longitude)
    lines = places[0].index.to_numpy()
    for which, reason in ((none, NO_PLACE), (off, _log_rows.OFF_THE_EARTH)):
        if which.any():
            i = int(np.argmax(which))
            text = f"{latitude[i]:g}, {longitude[i]:g}"
            tally.leave_out(reason, int(which.sum()), row=f"line {lines[i]}", text=text)
    placed = np.isfinite(latitude + longitude) & ~none & ~off
    if not placed.any():
        said = f"; left out: {tally.reasons()}" if tally.left_out else ""
        raise InputError(f"{path}: holds no position of a vessel{said}")
    rows = lines[placed]
    when = table.time[rows]
    title = str(table.time.name)
    time_s = _log_rows.row_times(
        path,
        rows,
        when.tolist(),
        tally,
        title=title,
        zone_s=zone_s(path, table, when),
        day_first=table.day_first,
    )
    velocity = _velocity_mps(table.speed, table.course, rows, tally)
    columns = (rows, numbers[kept][placed], time_s, latitude[placed], longitude[placed])
    for line, mmsi, at_s, north, east, way in zip(*columns, velocity, strict=True):
        if np.isfinite(at_s):
            yield Report(
                int(line),
                int(mmsi),
                float(at_s),
                float(north),
                float(east),
                (float(way[0]), float(way[1])),
            )


def _velocity_mps(
    speed: pd.Series | None,
    course: pd.Series | None,
    rows: np.ndarray,
    tally: Tally,
) -> FloatArray:
    """(N, 2) east and north; NaN where speed and course are not both told."""
    nothing = np.full((rows.size, 2), np.nan)
    if speed is None or course is None:
        return nothing
    unit_mps = mps_of_unit(str(speed.name))
    if unit_mps is None:
        tally.note(
            f"the unit of its column {_files.shortened(str(speed.name))} is not told, so it is not "
            "used; call it speed_kn, speed_mps or speed_kmh"
        )
        return nothing
    speed_mps = _files.floats(speed[rows]) * unit_mps
    course_deg = _files.floats(course[rows])
    told = (speed_mps >= 0.0) & (speed_mps < _NO_SPEED_KN * _KNOT_MPS)
    told &= (course_deg >= 0.0) & (course_deg < _FULL_TURN_DEG)
    ahead = np.radians(course_deg)
    velocity = speed_mps[:, None] * np.stack([np.sin(ahead), np.cos(ahead)], axis=1)
    return np.asarray(np.where(told[:, None], velocity, np.nan))
