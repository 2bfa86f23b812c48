"""Zones of times, as columns of logs and their headers name them."""

from __future__ import annotations

import os
import re

from sightline.errors import InputError
from sightline.formats import _files

_UTC = re.compile(r"(?:utc|gmt|z|zulu)(?:\s*[+-]?\s*0{1,2}(?::?00)?)?", re.IGNORECASE)
_OFFSET = re.compile(
    r"(?:utc|gmt)?\s*([+-])\s*(\d{1,2})(?::?(\d{2}))?(?:\s*h(?:ours?)?)?", re.IGNORECASE
)
_OFFSET_WITHIN = re.compile(
    r"(?:utc|gmt)\s*[+-]\s*\d{1,2}(?::?\d{2})?|[+-]\d{2}:?\d{2}", re.IGNORECASE
)
# What a word in brackets or at the end of a name may be that is no zone's name is not known.
_NAMED = re.compile(
    r"[A-Z][A-Za-z]+/[A-Z][A-Za-z_]+|\b(?:[CEW]E[S]?T|BST|IST|MSK|JST|[ECMP][SD]T|A[EWC][SD]T|"
    r"NZ[SD]T|local(?: time)?)\b"
)
_LARGEST_S = 14.0 * 3600.0


def offset_s(text: str) -> float | None:
    """Seconds by which a zone is ahead of UTC, of ``UTC+2`` or ``+0200``; None: it is not told."""
    bare = text.strip()
    if _UTC.fullmatch(bare):
        return 0.0
    match = _OFFSET.fullmatch(bare)
    if match is None:
        return None
    seconds = 3600.0 * int(match[2]) + 60.0 * int(match[3] or 0)
    return None if seconds > _LARGEST_S else seconds * (1.0 if match[1] == "+" else -1.0)


def offset_in(path: str | os.PathLike[str], header: str) -> float | None:
    """Seconds by which times are ahead of UTC, as their header says; None: nothing.

    Args:
        path: The file.
        header: As it stands: ``Time (UTC+2)``.

    Raises:
        InputError: It names a zone that may be several.
    """
    offset = _OFFSET_WITHIN.search(header)
    named = offset or _NAMED.search(header)
    if named is None:
        return 0.0 if "utc" in header.lower() else None
    return told_offset_s(path, named[0], f"its times ({header})")


def told_offset_s(path: str | os.PathLike[str], text: str, where: str) -> float:
    """Seconds by which a zone is ahead of UTC.

    Args:
        path: The file.
        text: The zone as it stands.
        where: What names it, for the message.

    Raises:
        InputError: It is no number of hours from UTC.
    """
    seconds = offset_s(text)
    if seconds is None:
        raise InputError(
            f"{path}: by {where} the zone is {_files.shortened(text)}, which is not told as hours "
            "from UTC; write it as UTC+2 or +02:00, or add a column time_utc"
        )
    return seconds
