"""Latitudes and longitudes as people and programs write them."""

from __future__ import annotations

import os
import re

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
from sightline.formats._log_rows import NO_PLACE, UNREAD_PLACE
from sightline.tally import Tally
from sightline.types import FloatArray

_NOTHING = frozenset(("", "nan", "null", "none", "n/a", "na", "-", "--", "---", "nil", "undefined"))
_NUMBER = r"\d+(?:[.,]\d*)?|[.,]\d+"
_TEXT = re.compile(
    rf"(?P<before>[NSEWnsew])?\s*(?P<sign>[+\-\N{{MINUS SIGN}}])?\s*(?P<degrees>{_NUMBER})"
    rf"(?:\s*[°ºd:\s]\s*(?:(?P<minutes>{_NUMBER})\s*(?:['′’`m:\s]\s*"
    rf"(?:(?P<seconds>{_NUMBER})\s*(?:[\"″”s]|''|′′)?)?)?)?)?"
    r"\s*(?P<after>[NSEWnsew])?"
)
_MOST_TEXT = 60
# Degrees of two digits, or of three, and the two of the minutes.
_PADDED = (r"(?<![\d.])\d{4}(?:\.\d+)?(?!\d)", r"(?<![\d.])\d{5}(?:\.\d+)?(?!\d)")
_MOST = 0.5
_SIDES = ("NS", "EW")
_LIMITS_DEG = (90.0, 180.0)
_ROUND_DEG = 360.0

# Degrees times 10^7; what else whole numbers are written in is degrees times 10^6, thousandths of
# an arc second, and ten-thousandths of a minute.
_WHOLE = {"degrees × 10^7": 1e7, "degrees × 10^6": 1e6, "0.001 arc seconds": 3.6e6}
_WHOLE |= {"0.0001 minutes": 6e5}
_LEAST_WHOLE = 1e4


def read_degrees(
    path: str | os.PathLike[str],
    columns: tuple[pd.Series, pd.Series],
    names: tuple[str, str],
    *,
    tally: Tally,
    row: str = "line",
) -> tuple[FloatArray, FloatArray, str]:
    """Latitude and longitude of texts, NaN where there is none.

    Understood are decimal degrees with a point or a comma, degrees and minutes, degrees, minutes
    and seconds, each with a sign or a letter, ``ddmm.mmmm`` with letters, and whole numbers of
    10^-7 degrees.

    Args:
        path: The file, for messages.
        columns: Text; the index is the line.
        names: What the file calls them.
        tally: Takes the rows that have no place, or none that can be read.
        row: What the index counts.

    Returns:
        Two (N,) float64 arrays, and what was assumed, or ``""``.

    Raises:
        InputError: Half of the texts are no angles, or of the other axis; or whole numbers may be
            of several units.
    """
    axes = [_axis(columns[i].tolist(), i) for i in (0, 1)]
    unread = np.isinf(axes[0]) | np.isinf(axes[1])
    _leave_out(path, columns, names, axes, tally, row)
    latitude, longitude = (np.where(unread, np.nan, axis) for axis in axes)
    if _packed(columns, latitude, longitude, names):
        latitude, longitude = _unpacked(latitude), _unpacked(longitude)
        return latitude, longitude, "its places are taken for degrees and minutes (ddmm.mmmm)"
    scale, said = _scale(path, columns[0].index, latitude, longitude, names)
    latitude, longitude = latitude / scale, longitude / scale
    known = longitude[np.abs(longitude) <= _ROUND_DEG]
    if known.size and known.min() >= 0.0 and known.max() > 180.0:
        said = "its longitudes run from 0° to 360°"
        longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
    return latitude, longitude, said


def _axis(texts: list[str], axis: int) -> FloatArray:
    """(N,) degrees, NaN where there are none, infinite where a text is no angle."""
    try:
        return np.array([text or "nan" for text in texts], dtype=np.float64)
    except (ValueError, OverflowError):
        values = (angle(text, axis) for text in texts)
        return np.array([float("inf") if value is None else value for value in values])


def _leave_out(
    path: str | os.PathLike[str],
    columns: tuple[pd.Series, pd.Series],
    names: tuple[str, str],
    axes: list[FloatArray],
    tally: Tally,
    row: str,
) -> None:
    unread = np.isinf(axes[0]) | np.isinf(axes[1])
    missing = ~unread & (np.isnan(axes[0]) | np.isnan(axes[1]))
    if unread.any() and 2 * unread.sum() >= (~missing).sum():
        i = int(np.argmax(unread))
        axis = 0 if np.isinf(axes[0][i]) else 1
        raise InputError(
            f"{path}, {row} {columns[0].index[i]}: {_files.shortened(columns[axis].iloc[i])} is no "
            f"number ({names[axis].strip()}); expected decimal degrees"
        )
    for which, reason in ((unread, UNREAD_PLACE), (missing, NO_PLACE)):
        if which.any():
            i = int(np.argmax(which))
            text = f"{columns[0].iloc[i]}, {columns[1].iloc[i]}"
            where = f"{row} {columns[0].index[i]}"
            tally.leave_out(reason, int(which.sum()), row=where, text=text)


def angle(text: str, axis: int) -> float | None:
    """Degrees of a text; NaN for none, None for what is no angle of an axis (0: latitude)."""
    if text.lower() in _NOTHING:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        pass
    match = _TEXT.fullmatch(text) if len(text) <= _MOST_TEXT else None
    if match is None:
        return None
    parts = [
        float(match[key].replace(",", ".")) if match[key] else 0.0
        for key in ("degrees", "minutes", "seconds")
    ]
    letter = (match["before"] or match["after"] or "").upper()
    both = match["before"] and match["after"]
    if both or (letter and letter not in _SIDES[axis]) or (letter and match["sign"]):
        return None
    finer = [key for key in ("minutes", "seconds") if match[key]]
    coarse = parts[: len(finer)]
    if parts[1] >= 60.0 or parts[2] >= 60.0 or any(part % 1.0 for part in coarse):
        return None
    negative = letter in ("S", "W") or (match["sign"] or "+") != "+"
    degrees = parts[0] + parts[1] / 60.0 + parts[2] / 3600.0
    return -degrees if negative else degrees


def _packed(
    columns: tuple[pd.Series, pd.Series],
    latitude: FloatArray,
    longitude: FloatArray,
    names: tuple[str, str],
) -> bool:
    """Whether numbers are degrees and minutes without a mark between, as NMEA 0183 has them.

    A name or the letters of the hemispheres have to say so, since metres look the same.
    """
    known = np.isfinite(latitude) & np.isfinite(longitude)
    if not known.any():
        return False
    texts = [column[known] for column in columns]
    told = all(re.search("dd?mm|nmea", name.lower()) for name in names)
    lettered = all(text.str.contains("[NSEWnsew]").mean() > _MOST for text in texts)
    if not (told or lettered):
        return False
    places = np.abs(np.stack([latitude[known], longitude[known]]))
    fits = (places % 100.0 < 60.0).all(axis=0) & (places[0] <= 9000.0) & (places[1] <= 18000.0)
    padded = texts[0].str.contains(_PADDED[0]) & texts[1].str.contains(_PADDED[1])
    large = (places[0] > _LIMITS_DEG[0]) | (places[1] > _LIMITS_DEG[1]) | padded.to_numpy(bool)
    return bool((fits & (large | told)).mean() > _MOST)


def _unpacked(values: FloatArray) -> FloatArray:
    """Degrees of ``dddmm.mmmm``; what has no such minutes is on no earth."""
    size = np.abs(values)
    minutes = size % 100.0
    degrees = (size - minutes) / 100.0 + minutes / 60.0
    return np.asarray(np.copysign(np.where(minutes < 60.0, degrees, size * 1e3), values))


def _scale(
    path: str | os.PathLike[str],
    lines: pd.Index,
    latitude: FloatArray,
    longitude: FloatArray,
    names: tuple[str, str],
) -> tuple[float, str]:
    """What whole numbers are divided by to be degrees, and the words for it."""
    for power in (7, 6):
        if all(re.search(rf"[eE]_?{power}\b", name.strip()) for name in names):
            return 10.0**power, ""
    known = (
        np.isfinite(latitude) & np.isfinite(longitude) & ((latitude != 0.0) | (longitude != 0.0))
    )
    places = np.stack([latitude[known], longitude[known]])
    if not places.size or (places % 1.0).any() or np.abs(places).max(axis=1).min() < _LEAST_WHOLE:
        return 1.0, ""
    possible = [
        unit
        for unit, scale in _WHOLE.items()
        if all(np.abs(places[i]).max() <= _LIMITS_DEG[i] * scale for i in (0, 1))
    ]
    if len(possible) == 1:
        return _WHOLE[possible[0]], f"its places are taken for {possible[0]}"
    if possible:
        where = lines[np.flatnonzero(known)[0]]
        raise InputError(
            f"{path}, line {where}: {places[0, 0]:.0f}, {places[1, 0]:.0f} may be in "
            f"{' or '.join(possible)}; write degrees, or name the columns latitude_e7 and "
            "longitude_e7"
        )
    return 1.0, ""
