"""NMEA 0183: a sentence ``TLL`` a target, as radars send their targets to chart plotters."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from functools import reduce

import numpy as np

from sightline.addresses import Address
from sightline.live.feeds.names import display_name
from sightline.live.feeds.queued import QueuedFeed
from sightline.live.feeds.transports import TcpServerTransport, UdpTransport
from sightline.moment import Moment, TargetState
from sightline.types import to_datetime64

_PORTS = {"tcp": 10110, "udp": 10110}
_EVERY_S = 1.0
_MOST_NAME = 20
# What plotters keep apart; the numbers of targets that are never reused grow for ever.
_NUMBERS = 10_000
_RESERVED = frozenset("$!*,\\^~")
_MINUTE_PARTS = 100_000


def open_nmea(url: str, camera: str) -> QueuedFeed:  # noqa: ARG001
    """A feed of ``TLL`` sentences, at a TCP port that plotters connect to or by UDP.

    Raises:
        InputError: The URL is of another form, or the port cannot be had.
    """
    address = Address.parse(url, _PORTS, feed="nmea")
    transport: TcpServerTransport | UdpTransport
    if address.scheme == "tcp":
        transport = TcpServerTransport(address.host, address.port, feed=f"nmea {url}")
    else:
        transport = UdpTransport(address.host, address.port, packed=True)
    return QueuedFeed(f"nmea {url}", TllEncoder(), transport, every_s=_EVERY_S)


class TllEncoder:
    """Makes the sentences of moments, and says of targets that have gone that they are lost."""

    def __init__(self) -> None:
        self._before: dict[int, TargetState] = {}

    def __call__(self, moment: Moment) -> Sequence[bytes]:
        """The sentences of a moment, each with its checksum and line end."""
        shown = {target.id: target for target in moment.targets if _placed(target)}
        gone = [target for number, target in self._before.items() if number not in shown]
        self._before = shown
        sentences = [tll(target, moment.time_utc_s, "T") for target in shown.values()]
        return sentences + [tll(target, moment.time_utc_s, "L") for target in gone]


def tll(target: TargetState, time_utc_s: float, status: str) -> bytes:
    """A target as a ``TLL`` sentence.

    Args:
        target: The target.
        time_utc_s: Time of its position, seconds since the epoch.
        status: ``T`` of one that is tracked, ``L`` of one that is lost.
    """
    time = str(np.datetime_as_string(to_datetime64(time_utc_s + 0.005), "ms"))
    fields = (
        "RATLL",
        f"{target.id % _NUMBERS:02d}",
        _degrees(target.latitude_deg, 2, "NS"),
        _degrees(target.longitude_deg, 3, "EW"),
        name_field(display_name(target)),
        time[11:].replace(":", "")[:9],
        status,
        "",
    )
    body = ",".join(fields).encode("ascii")
    checksum = reduce(lambda one, other: one ^ other, body, 0)
    return b"$%b*%02X\r\n" % (body, checksum)


def name_field(name: str) -> str:
    """A name as a field: ASCII of at most 20 characters, those that are reserved escaped."""
    plain = unicodedata.normalize("NFKD", name)
    field = ""
    for character in plain:
        if unicodedata.combining(character):
            continue
        known = character if " " <= character <= "~" else "?"
        written = f"^{ord(known):02X}" if known in _RESERVED else known
        # An escape is never cut in two.
        if len(field) + len(written) > _MOST_NAME:
            break
        field += written
    return field


def _degrees(value_deg: float, digits: int, signs: str) -> str:
    """Degrees and minutes, with a field for the hemisphere."""
    parts = round(abs(value_deg) * 60 * _MINUTE_PARTS)
    degrees, minutes = divmod(parts, 60 * _MINUTE_PARTS)
    whole, rest = divmod(minutes, _MINUTE_PARTS)
    return f"{degrees:0{digits}d}{whole:02d}.{rest:05d},{signs[value_deg < 0.0]}"


def _placed(target: TargetState) -> bool:
    return math.isfinite(target.latitude_deg) and math.isfinite(target.longitude_deg)
