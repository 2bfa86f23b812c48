"""Feeds: where moments go besides the page. Each takes what it can, and none holds up another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from sightline.errors import unknown_name
from sightline.live.feeds.cursor_on_target import open_cursor_on_target
from sightline.live.feeds.mqtt import open_mqtt
from sightline.live.feeds.nmea import open_nmea
from sightline.live.feeds.queued import QueuedFeed
from sightline.live.feeds.signalk import open_signalk
from sightline.live.feeds.webhook import WebhookFeed, open_webhook

_KINDS: dict[str, Callable[[str, str], QueuedFeed | WebhookFeed]] = {
    "nmea": open_nmea,
    "signalk": open_signalk,
    "cot": open_cursor_on_target,
    "mqtt": open_mqtt,
    "webhook": open_webhook,
}


def open_feed(
    url: str, *, kind: Literal["nmea", "signalk", "cot", "mqtt", "webhook"], camera: str
) -> QueuedFeed | WebhookFeed:
    """A feed that publishes to an address, from a thread of its own.

    A receiver that is not there yet is tried again until it is.

    Args:
        url: For ``nmea`` ``tcp://HOST:PORT`` (an address to listen at) or ``udp://HOST:PORT``; for
            ``signalk`` ``ws://``, ``wss://``, ``tcp://`` or ``udp://``; for ``cot`` ``udp://``
            (a multicast group too), ``tcp://`` or ``tls://``; for ``mqtt``
            ``mqtt://HOST:PORT/TOPIC`` or ``mqtts://``; for ``webhook`` ``http://`` or ``https://``,
            and only alerts are sent. A port that is left out is the usual one.
        kind: Of its messages.
        camera: Name of the camera.

    Raises:
        InputError: The URL is none of these, or the address to listen at cannot be had.
    """
    if kind not in _KINDS:
        raise unknown_name("kind of feed", kind, list(_KINDS))
    return _KINDS[kind](url, camera)
