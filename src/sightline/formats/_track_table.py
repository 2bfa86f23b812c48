"""Tracks as one table: what all formats of tracks write and read."""

from __future__ import annotations

import os
from collections.abc import Iterable
from datetime import date
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from sightline.errors import InputError
from sightline.formats import _files
from sightline.geodesy import LocalPlane
from sightline.text import encodable_text
from sightline.types import (
    LARGEST_MMSI,
    BoolArray,
    FloatArray,
    FusedTrack,
    PointKind,
    Track,
    ellipses,
    from_datetime64,
)

KINDS = tuple(kind.name.lower() for kind in PointKind)
"""The word for each `PointKind`, by its value."""

MOVING, MOORED, UNTOLD = "moving", "moored", "untold"
"""Whether a target stays in its place at a point of its track, or nobody knows."""

REQUIRED = ("track_id", "time_utc", "latitude_deg", "longitude_deg")
"""Columns without which a table holds no tracks."""

_MEASURES = ("latitude_deg", "longitude_deg", "speed_mps", "course_deg")
_COVARIANCE = ("var_east_m2", "cov_east_north_m2", "var_north_m2")
_VELOCITY_COVARIANCE = (
    "var_velocity_east_m2ps2",
    "cov_velocity_east_north_m2ps2",
    "var_velocity_north_m2ps2",
)
_ELLIPSE = ("semi_major_m", "semi_minor_m", "ellipse_bearing_deg")
_PROBABILITY = 0.95
_PLAIN = (str, int, float, date, np.generic, type(None), type(pd.NaT))

COLUMNS = (
    *("track_id", "time_utc", *_MEASURES, "kind", "label"),
    *(*_COVARIANCE, *_VELOCITY_COVARIANCE, *_ELLIPSE),
    "state",
)
"""The columns of a table of tracks, in their order."""

FUSED = ("cameras", "mmsi", "name")
"""The columns that a table of fused tracks has besides."""

KNOWN = (*COLUMNS, *FUSED)
"""All columns that are read."""


def columns(track: Track) -> dict[str, NDArray[Any]]:
    """The columns of a track's table that a point has of its own, but for its time.

    Degrees are rounded to nine places (0.1 mm). ``kind`` is a word of `KINDS`, ``state`` `MOORED`,
    `MOVING` or `UNTOLD`; the ellipse holds the true position with 95 %.
    """
    ellipse = ellipses(track.covariance_m2, _PROBABILITY)
    latitude, longitude = track.plane.to_geographic(track.east_m, track.north_m)
    places: dict[str, NDArray[Any]] = {
        "latitude_deg": np.round(latitude, 9),
        "longitude_deg": np.round(longitude, 9),
        "speed_mps": np.round(track.speed_mps, 6),
        "course_deg": np.round(track.course_deg, 6),
        "kind": np.array(KINDS)[track.kind],
        "state": np.where(np.asarray(track.moored), MOORED, UNTOLD if track.untold else MOVING),
    }
    places |= dict(zip(_COVARIANCE, _triangle(track.covariance_m2), strict=True))
    places |= dict(
        zip(_VELOCITY_COVARIANCE, _triangle(track.velocity_covariance_m2ps2), strict=True)
    )
    axes = (ellipse.semi_major_m, ellipse.semi_minor_m, ellipse.bearing_deg)
    return places | {name: np.round(axis, 6) for name, axis in zip(_ELLIPSE, axes, strict=True)}


def fused_columns(track: Track) -> pd.DataFrame:
    """What `FUSED` adds to a table: which cameras saw the target at each point, and who it is."""
    n = len(track)
    cameras = track.cameras if isinstance(track, FusedTrack) else None
    return pd.DataFrame(
        {
            "cameras": pd.array(np.full(n, "") if cameras is None else cameras, dtype="str"),
            "mmsi": pd.array([pd.NA if track.mmsi is None else track.mmsi] * n, dtype="Int64"),
            "name": pd.array([encodable_text(track.name)] * n, dtype="str"),
        }
    )


def table(track: Track, *, fused: bool = False) -> pd.DataFrame:
    """A track as a table, a row a point: `COLUMNS`, its times in milliseconds.

    Args:
        track: The track.
        fused: Whether it has the columns of `FUSED` too.
    """
    times = pd.DatetimeIndex(_files.milliseconds(track.time_utc_s), tz="UTC")
    content: dict[str, object] = {
        "track_id": np.full(len(track), track.track_id, dtype=np.int64),
        "time_utc": times,
        "label": pd.array([encodable_text(track.label)] * len(track), dtype="str"),
        **columns(track),
    }
    rows = pd.DataFrame({name: content[name] for name in COLUMNS})
    return pd.concat([rows, fused_columns(track)], axis=1) if fused else rows


def empty(*, fused: bool = False) -> pd.DataFrame:
    """The table of a track without points: its columns and their types."""
    nothing = np.empty(0)
    no_covariance = np.empty((0, 2, 2))
    plane = LocalPlane(0.0, 0.0)
    return table(
        Track(0, *(nothing,) * 5, no_covariance, no_covariance, nothing.astype(np.int8), plane),
        fused=fused,
    )


def with_posix_times(path: str | os.PathLike[str], rows: pd.DataFrame) -> pd.DataFrame:
    """A table that has ``time_utc`` as time stamps or text, with ``time_utc_s``.

    Raises:
        InputError: A column is missing, a time or a track's number is none, or a cell holds
            something else than a text or a number.
    """
    missing = [name for name in REQUIRED if name not in rows]
    if missing:
        raise lacks(path, missing, map(str, rows.columns))
    rows = plain(path, rows)
    if pd.api.types.is_datetime64_any_dtype(rows["time_utc"]):
        stamps = pd.to_datetime(rows["time_utc"], utc=True).dt.tz_localize(None).to_numpy()
        near = (stamps > _files.FIRST_TIME) & (stamps < _files.LAST_TIME)
        reason = "is no time (time_utc)"
        _files.refuse(path, rows.index, ~near, rows["time_utc"], reason, row="row")
        time_utc_s = from_datetime64(stamps)
    else:
        time_utc_s = _files.times(path, rows["time_utc"], row="row")
    return rows.assign(
        time_utc_s=time_utc_s, track_id=_files.whole_numbers(path, rows["track_id"], row="row")
    )


def lacks(path: str | os.PathLike[str], missing: Iterable[str], found: Iterable[str]) -> InputError:
    """An `InputError` for columns that a table has not."""
    there = _files.shortened(", ".join(found), 300)
    return InputError(f"{path}: lacks {', '.join(missing)}; found {there}")


def plain(path: str | os.PathLike[str], rows: pd.DataFrame, row: str = "row") -> pd.DataFrame:
    """The table, whose cells are texts, numbers and times, and nothing else.

    Raises:
        InputError: There is something else, such as a list.
    """
    for name in rows.columns:
        if rows[name].dtype == object:
            bad = [not isinstance(cell, _PLAIN) for cell in rows[name]]
            reason = f"is no text and no number ({name})"
            _files.refuse(path, rows.index, np.array(bad, dtype=bool), rows[name], reason, row=row)
    return rows


def _with_numbers(path: str | os.PathLike[str], rows: pd.DataFrame) -> pd.DataFrame:
    """The table with numbers wherever numbers are meant; NaN where a cell is empty."""
    for name in (*_MEASURES, *_COVARIANCE, *_VELOCITY_COVARIANCE, *_ELLIPSE):
        if name in rows:
            column = _files.floats(rows[name])
            bad = ~np.isfinite(column) & rows[name].notna().to_numpy()
            what = f"is no number ({name})"
            _files.refuse(path, rows.index, bad, rows[name], what, row="row")
            rows = rows.assign(**{name: column})
    return rows


def _triangle(covariance: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    return covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]


def tracks(
    path: str | os.PathLike[str], rows: pd.DataFrame, plane: LocalPlane | None
) -> tuple[Track, ...]:
    """The tracks of a table, in the order in which they first appear.

    Args:
        path: Where the table is from, for messages.
        rows: Columns track_id, latitude_deg, longitude_deg and time_utc_s; optionally those of
            `table`. Without speed and course, velocities are differences of places; without
            covariances, they come from the ellipse or are NaN; without a kind, points are measured;
            without a state, they are moving.
        plane: The plane of the tracks; None: one at the first point.

    Raises:
        InputError: There is no row, a place is not on the earth, the times of a track do not
            increase, a kind is unknown, or there is something else where a number belongs.
    """
    if rows.empty:
        raise InputError(f"{path}: holds no point of a track")
    rows = _with_numbers(path, rows)
    latitude = rows["latitude_deg"].to_numpy(dtype=float)
    longitude = rows["longitude_deg"].to_numpy(dtype=float)
    # Times are looked at track by track.
    _files.check_places(path, rows.index, latitude, longitude, row="row")
    if plane is None:
        plane = LocalPlane(float(latitude[0]), float(longitude[0]))
    try:
        return tuple(_track(part, plane) for _, part in rows.groupby("track_id", sort=False))
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _track(rows: pd.DataFrame, plane: LocalPlane) -> Track:
    time_s = rows["time_utc_s"].to_numpy(dtype=float)
    east, north = plane.to_plane(rows["latitude_deg"], rows["longitude_deg"])
    if {"speed_mps", "course_deg"} <= set(rows.columns) and rows["speed_mps"].notna().all():
        speed = rows["speed_mps"].to_numpy(dtype=float)
        course = np.radians(rows["course_deg"].to_numpy(dtype=float))
        velocity_east, velocity_north = speed * np.sin(course), speed * np.cos(course)
    else:
        velocity_east, velocity_north = _slope(east, time_s), _slope(north, time_s)
    return Track(
        track_id=int(rows["track_id"].iloc[0]),
        time_utc_s=time_s,
        east_m=east,
        north_m=north,
        velocity_east_mps=velocity_east,
        velocity_north_mps=velocity_north,
        covariance_m2=_covariance(rows),
        velocity_covariance_m2ps2=_symmetric(rows, _VELOCITY_COVARIANCE),
        kind=_kinds(rows),
        plane=plane,
        label=_text(rows, "label"),
        moored=_in_state(rows, MOORED),
        untold=bool(_in_state(rows, UNTOLD).any()),
        mmsi=_mmsi(rows),
        name=_text(rows, "name"),
    )


def _mmsi(rows: pd.DataFrame) -> int | None:
    """Of the vessel; None where none is told, or what is told is none."""
    if "mmsi" not in rows:
        return None
    told = pd.to_numeric(rows["mmsi"], errors="coerce").dropna()
    numbers = told[(told >= 1) & (told <= LARGEST_MMSI) & (told % 1 == 0)]
    return None if numbers.empty else int(numbers.iloc[0])


def _slope(values: FloatArray, time_s: FloatArray) -> FloatArray:
    """Velocities from places; of times that do not increase `Track` will complain."""
    if values.size < 2 or (np.diff(time_s) <= 0.0).any():
        return np.zeros(values.size)
    return np.asarray(np.gradient(values, time_s))


def _symmetric(rows: pd.DataFrame, names: tuple[str, str, str]) -> FloatArray:
    if not set(names) <= set(rows.columns):
        return np.full((len(rows), 2, 2), np.nan)
    first, mixed, second = (rows[name].to_numpy(dtype=float) for name in names)
    return np.stack([first, mixed, mixed, second], axis=1).reshape(-1, 2, 2)


def _covariance(rows: pd.DataFrame) -> FloatArray:
    if set(_COVARIANCE) <= set(rows.columns) or not set(_ELLIPSE) <= set(rows.columns):
        return _symmetric(rows, _COVARIANCE)
    major, minor, bearing = (rows[name].to_numpy(dtype=float) for name in _ELLIPSE)
    scale = -2.0 * np.log1p(-_PROBABILITY)
    east, north = np.sin(np.radians(bearing)), np.cos(np.radians(bearing))
    along, across = major**2 / scale, minor**2 / scale
    mixed = (along - across) * east * north
    return np.stack(
        [
            along * east**2 + across * north**2,
            mixed,
            mixed,
            along * north**2 + across * east**2,
        ],
        axis=1,
    ).reshape(-1, 2, 2)


def _kinds(rows: pd.DataFrame) -> np.ndarray:
    if "kind" not in rows:
        return np.full(len(rows), PointKind.MEASURED, dtype=np.int8)
    code = {word: value for value, word in enumerate(KINDS)}
    kinds = rows["kind"].astype(str).map(code)
    if kinds.isna().any():
        unknown = _files.shortened(str(rows["kind"][kinds.isna()].iloc[0]))
        raise InputError(f"unknown kind {unknown!r}; known are {', '.join(KINDS)}")
    return kinds.to_numpy(dtype=np.int8)


def _in_state(rows: pd.DataFrame, state: str) -> BoolArray:
    """Where a target is in a state; other programs may have any words in such a column."""
    if "state" not in rows:
        return np.zeros(len(rows), dtype=bool)
    return np.array([word == state for word in rows["state"]], dtype=bool)


def _text(rows: pd.DataFrame, name: str) -> str:
    if name not in rows:
        return ""
    text = rows[name].iloc[0]
    return "" if pd.isna(text) else encodable_text(str(text))
