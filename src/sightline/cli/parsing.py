"""Parsers of option texts that hold more than one value."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

from sightline.errors import InputError, unknown_name

OptionValue = bool | int | float | str

_UNITS_S = {"": 1.0, "s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
_LONGEST_S = 366.0 * 86400.0
_SMALLEST_PX, _LARGEST_PX = 32, 8192


def parse_names(text: str) -> tuple[str, ...]:
    """Split names at commas."""
    return tuple(name for name in (part.strip() for part in text.split(",")) if name)


def parse_known_names(text: str, kind: str, known: Iterable[str]) -> tuple[str, ...]:
    """Split names at commas; each must be known.

    Args:
        text: The names.
        kind: What they are names of, for the message.
        known: The names there are.

    Raises:
        InputError: A name is not known.
    """
    names, known = parse_names(text), tuple(known)
    for name in names:
        if name not in known:
            raise unknown_name(kind, name, known)
    return names


def parse_distinct_names(option: str, text: str) -> tuple[str, ...]:
    """Split names at commas; at least one, and none twice.

    Args:
        option: Its name, for the message.
        text: What was given.

    Raises:
        InputError: There is none, or one comes twice.
    """
    names = parse_names(text)
    if not names:
        raise InputError(f"{option} {text!r}: names nothing; give one name or more")
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{option} {text!r}: names {name} twice")
    return names


def parse_pair(option: str, text: str, between: str) -> tuple[float, float]:
    """Parse two numbers with something between them.

    Args:
        option: Its name, for the message.
        text: What was given.
        between: What stands between the numbers.

    Raises:
        InputError: It is something else.
    """
    first, _, second = text.partition(between)
    try:
        return float(first), float(second)
    except ValueError as error:
        raise InputError(
            f"{option} {text!r}: expected two numbers with {between!r} between them"
        ) from error


def parse_size_px(option: str, text: str) -> tuple[int, int]:
    """Parse width and height in px, ``WxH``.

    Args:
        option: Its name, for the message.
        text: What was given.

    Raises:
        InputError: It is something else, or no size that a network could take.
    """
    width, _, height = text.lower().partition("x")
    try:
        size = int(width), int(height)
    except ValueError as error:
        raise InputError(
            f"{option} {text!r}: expected width and height in px, for example 640x384"
        ) from error
    if not _SMALLEST_PX <= min(size) <= max(size) <= _LARGEST_PX:
        raise InputError(
            f"{option} {text!r}: width and height must lie between {_SMALLEST_PX} and "
            f"{_LARGEST_PX} px"
        )
    return size


def parse_time(option: str, text: str | None) -> float | None:
    """Parse an ISO 8601 time to POSIX seconds; UTC without a zone; None where none is given.

    Args:
        option: Its name, for the message.
        text: What was given.

    Raises:
        InputError: It is none.
    """
    if text is None:
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError as error:
        raise InputError(
            f"{option} {text!r} is no time; expected for example 2020-09-30T19:36:24Z"
        ) from error
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def parse_duration_s(option: str, text: str) -> float:
    """Parse a time such as 30s, 15min, 1h or 1d to seconds; a number alone is seconds.

    Args:
        option: Its name, for the message.
        text: What was given.

    Raises:
        InputError: It is something else, shorter than a second, or longer than a year.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([a-z]*)\s*", text.lower())
    unit = _UNITS_S.get(found[2]) if found else None
    if found is None or unit is None:
        raise InputError(f"{option} {text!r}: is no time; expected for example 30s, 15min or 1h")
    duration_s = float(found[1]) * unit
    if not 1.0 <= duration_s <= _LONGEST_S:
        raise InputError(f"{option} {text!r}: give a time between a second and a year")
    return duration_s


def parse_architecture_options(texts: Iterable[str]) -> dict[str, OptionValue]:
    """Parse options of an architecture, each ``NAME=VALUE``.

    Raises:
        InputError: A text is something else.
    """
    options: dict[str, OptionValue] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.isidentifier():
            raise InputError(f"--option {text!r}: expected NAME=VALUE, for example width=1.5")
        options[name] = parse_value(value)
    return options


def parse_options_by_architecture(
    texts: Iterable[str], architectures: Sequence[str]
) -> dict[str, dict[str, OptionValue]]:
    """Parse options of several architectures, each ``ARCH.NAME=VALUE``.

    Args:
        texts: What was given.
        architectures: The names there are.

    Raises:
        InputError: A text is something else.
    """
    found: dict[str, dict[str, OptionValue]] = {}
    for text in texts:
        architecture, dot, rest = text.partition(".")
        if not dot or architecture not in architectures:
            raise InputError(
                f"--option {text!r}: expected ARCH.NAME=VALUE, and known are "
                f"{', '.join(architectures)}"
            )
        found.setdefault(architecture, {}).update(parse_architecture_options([rest]))
    return found


def parse_value(text: str) -> OptionValue:
    """Parse a truth value or a number where a text looks like one, or else keep the text."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def parse_water_level(text: str | None) -> float | Path | None:
    """Parse a level in metres, or the file of a table of levels.

    Args:
        text: What was given; None: nothing.

    Raises:
        InputError: It is a number that no level can have.
    """
    if text is None:
        return None
    try:
        level_m = float(text)
    except ValueError:
        return Path(text)
    if not math.isfinite(level_m):
        raise InputError(f"--water-level {text}: is no level; give metres, or a table")
    return level_m
