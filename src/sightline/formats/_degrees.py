"""Latitudes and longitudes as people and programs write them."""

from __future__ import annotations

import os
import re

import numpy as np
import pandas as pd

from sightline.errors import InputError
from sightline.formats import _files
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
_SIDES = ("NS", "EW")
_LIMITS_DEG = (90.0, 180.0)

# Degrees times 10^7; what else whole numbers are written in is degrees times 10^6, thousandths of
# an arc second, and ten-thousandths of a minute.
_WHOLE = {"degrees × 10^7": 1e7, "degrees × 10^6": 1e6, "0.001 arc seconds": 3.6e6}
_WHOLE |= {"0.0001 minutes": 6e5}
_LEAST_WHOLE = 1e4


def read_degrees(
    path: str | os.PathLike[str], columns: tuple[pd.Series, pd.Series], names: tuple[str, str]
) -> tuple[FloatArray, FloatArray, str]:
    """Latitude and longitude of texts, NaN where there is none.

    Understood are decimal degrees with a point or a comma, degrees and minutes, degrees, minutes
    and seconds, each with a sign or a letter, and whole numbers of 10^-7 degrees.

    Args:
        path: The file, for messages.
        columns: Text; the index is the line.
        names: What the file calls them.

    Returns:
        Two (N,) float64 arrays, and what was assumed, or ``""``.

    Raises:
        InputError: A text is no angle, or of the other axis; or whole numbers may be of several
            units.
    """
    latitude, longitude = (_axis(path, columns[i], names[i], i) for i in (0, 1))
    scale, said = _scale(path, columns[0].index, latitude, longitude, names)
    latitude, longitude = latitude / scale, longitude / scale
    known = longitude[np.isfinite(longitude)]
    if known.size and known.min() >= 0.0 and 180.0 < known.max() <= 360.0:
        said = "its longitudes run from 0° to 360°"
        longitude = np.where(longitude > 180.0, longitude - 360.0, longitude)
    return latitude, longitude, said


def _axis(path: str | os.PathLike[str], column: pd.Series, name: str, axis: int) -> FloatArray:
    texts = column.tolist()
    try:
        values = np.array([text or "nan" for text in texts], dtype=np.float64)
    except (ValueError, OverflowError):
        values = np.empty(len(texts))
        for i, text in enumerate(texts):
            value = _angle(text, axis)
            if value is None:
                raise InputError(
                    f"{path}, line {column.index[i]}: {_files.shortened(text)} is no number "
                    f"({name.strip()}); expected decimal degrees"
                ) from None
            values[i] = value
    _files.refuse(path, column.index, np.isinf(values), column, f"is no number ({name.strip()})")
    return values


def _angle(text: str, axis: int) -> float | None:
    """Degrees of a text; NaN for none, None for what is no angle."""
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
