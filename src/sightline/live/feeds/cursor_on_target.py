"""Cursor on Target: an event a target, as TAK shows them (ATAK, WinTAK, iTAK)."""

from __future__ import annotations

import math
import os
import ssl
from collections.abc import Sequence
from xml.etree import ElementTree

import numpy as np

from sightline.addresses import Address
from sightline.errors import InputError
from sightline.live.feeds.names import display_name
from sightline.live.feeds.queued import QueuedFeed, Transport
from sightline.live.feeds.transports import TcpTransport, UdpTransport
from sightline.moment import Moment, TargetState
from sightline.text import xml_text
from sightline.types import ellipses, to_datetime64

AUTHORITIES = "SIGHTLINE_TAK_CA"
"""Environment variable with the file of certificates (PEM) that the server's is signed by."""

CERTIFICATE = "SIGHTLINE_TAK_CERT"
"""Environment variable with the file of our certificate (PEM)."""

KEY = "SIGHTLINE_TAK_KEY"
"""Environment variable with the file of our key (PEM), where it is not with the certificate."""

_PORTS = {"udp": 6969, "tcp": 8087, "tls": 8089}
_EVERY_S = 1.0
_STALE_S = 10.0
# What the format has for a height that is not known.
_UNKNOWN = "9999999.0"


def open_cursor_on_target(url: str, camera: str) -> QueuedFeed:
    """A feed of Cursor on Target events.

    Raises:
        InputError: The URL is of another form, or a certificate cannot be read.
    """
    address = Address.parse(url, _PORTS, feed="cot")
    transport: Transport
    if address.scheme == "udp":
        transport = UdpTransport(address.host, address.port)
    else:
        context = _context() if address.scheme == "tls" else None
        transport = TcpTransport(address.host, address.port, context)
    return QueuedFeed(f"cot {url}", EventEncoder(camera), transport, every_s=_EVERY_S)


class EventEncoder:
    """Makes the events of moments, an XML document a target.

    Args:
        camera: Its name, which begins the name of an event.
    """

    def __init__(self, camera: str) -> None:
        self._camera = camera

    def __call__(self, moment: Moment) -> Sequence[bytes]:
        """The events of a moment."""
        targets = [target for target in moment.targets if _placed(target)]
        if not targets:
            return []
        shapes = ellipses(np.stack([np.asarray(one.covariance_m2, float) for one in targets]))
        times = _time(moment.time_utc_s), _time(moment.time_utc_s + _STALE_S)
        return [
            self._event(target, times, (float(major), float(minor), float(bearing)))
            for target, major, minor, bearing in zip(
                targets, shapes.semi_major_m, shapes.semi_minor_m, shapes.bearing_deg, strict=True
            )
        ]

    def _event(
        self, target: TargetState, times: tuple[str, str], ellipse: tuple[float, float, float]
    ) -> bytes:
        time, stale = times
        major, minor, bearing = (f"{value:.2f}" for value in ellipse)
        event = ElementTree.Element(
            "event",
            version="2.0",
            uid=xml_text(f"sightline.{self._camera}.{target.id}"),
            # Affiliation unknown, on the water; measured by a machine that was not told.
            type="a-u-S",
            how="m-r",
            time=time,
            start=time,
            stale=stale,
        )
        ElementTree.SubElement(
            event,
            "point",
            lat=f"{target.latitude_deg:.7f}",
            lon=f"{target.longitude_deg:.7f}",
            hae=_UNKNOWN,
            ce=major,
            le=_UNKNOWN,
        )
        detail = ElementTree.SubElement(event, "detail")
        called = xml_text(display_name(target))
        ElementTree.SubElement(detail, "contact", callsign=called)
        if target.speed_mps is not None and target.course_deg is not None:
            speed, course = f"{target.speed_mps:.2f}", f"{target.course_deg:.1f}"
            ElementTree.SubElement(detail, "track", speed=speed, course=course)
        shape = ElementTree.SubElement(detail, "shape")
        ElementTree.SubElement(shape, "ellipse", major=major, minor=minor, angle=bearing)
        remarks = ElementTree.SubElement(detail, "remarks")
        remarks.text = xml_text(_remarks(target, self._camera))
        document: bytes = ElementTree.tostring(event, encoding="utf-8", xml_declaration=True)
        return document + b"\n"


def _remarks(target: TargetState, camera: str) -> str:
    parts = [f"seen by {camera}", target.state]
    if target.mmsi is not None:
        parts.append(f"MMSI {target.mmsi:09d}")
    if target.match is not None:
        parts.append(f"match {target.match:.2f}")
    return ", ".join(parts)


def _time(time_utc_s: float) -> str:
    return f"{np.datetime_as_string(to_datetime64(time_utc_s + 0.0005), 'ms')}Z"


def _placed(target: TargetState) -> bool:
    covariance = np.asarray(target.covariance_m2, dtype=float)
    place = target.latitude_deg, target.longitude_deg
    return all(map(math.isfinite, place)) and bool(np.isfinite(covariance).all())


def _context() -> ssl.SSLContext:
    """What TLS trusts and shows, from the files that the environment names."""
    authorities, certificate = os.environ.get(AUTHORITIES), os.environ.get(CERTIFICATE)
    try:
        context = ssl.create_default_context(cafile=authorities)
        if certificate:
            # A password would be asked for at the terminal; a key with one is refused.
            context.load_cert_chain(certificate, os.environ.get(KEY), password=lambda: "")
    except (OSError, ssl.SSLError) as error:
        raise InputError(
            f"cot: the certificates that {AUTHORITIES}, {CERTIFICATE} and {KEY} name "
            f"cannot be used ({error}); expected files in PEM format, keys without a password"
        ) from error
    return context
