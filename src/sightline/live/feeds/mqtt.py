"""MQTT: a message a moment, and a status that stays when the camera or the program goes."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING

from sightline import _optional
from sightline.addresses import Address
from sightline.errors import InputError
from sightline.live.feeds.queued import QueuedFeed
from sightline.moment import Moment

if TYPE_CHECKING:
    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

USER = "SIGHTLINE_MQTT_USER"
"""Environment variable with the user at the broker."""

PASSWORD = "SIGHTLINE_MQTT_PASSWORD"  # noqa: S105
"""Environment variable with the password at the broker."""

AUTHORITIES = "SIGHTLINE_MQTT_CA"
"""Environment variable with the file of certificates (PEM) that the broker's is signed by."""

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_ANSWER_S = 5.0
_SEND_S = 5.0
_POLL_S = 0.05
_KEEPALIVE_S = 20


def open_mqtt(url: str, camera: str) -> QueuedFeed:
    """A feed of the messages of moments, to ``TOPIC/moment``; ``TOPIC/status`` says online.

    Raises:
        InputError: The URL or its topic is of another form, or the library is not there.
    """
    address = Address.parse(url, _PORTS, feed="mqtt", with_path=True)
    topic = address.path.rstrip("/") or f"sightline/{_level(camera)}"
    if address.query or any(one in topic for one in "+#"):
        raise InputError(
            f"mqtt {url}: + and # stand for other topics, and ? for nothing; "
            "expected mqtt://HOST:PORT/TOPIC"
        )
    _optional.module("paho.mqtt.client", "live")
    transport = MqttTransport(address, topic)
    return QueuedFeed(f"mqtt {url}", _message, transport)


def _message(moment: Moment) -> Sequence[bytes]:
    return [moment.text.encode()]


def _level(camera: str) -> str:
    """A name as one level of a topic."""
    kept = "".join("-" if one in "+#/" or not one.isprintable() else one for one in camera)
    return kept.strip() or "camera"


class MqttTransport:
    """A connection to a broker, with a last will.

    Args:
        address: Of the broker.
        topic: Begins its topics.
    """

    def __init__(self, address: Address, topic: str) -> None:
        self._address = address
        self._moment, self._status = f"{topic}/moment", f"{topic}/status"
        self._client: Client | None = None
        self._gone = threading.Event()

    def open(self, stopping: threading.Event) -> None:
        """Connect, and say that we are online."""
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        # One that is lost is tried again by the feed, which counts and tells it.
        client = Client(CallbackAPIVersion.VERSION2, reconnect_on_failure=False)
        user = os.environ.get(USER)
        if user:
            client.username_pw_set(user, os.environ.get(PASSWORD))
        if self._address.scheme == "mqtts":
            client.tls_set(ca_certs=os.environ.get(AUTHORITIES))
        client.will_set(self._status, "offline", qos=1, retain=True)
        client.connect_timeout = _ANSWER_S
        answered = threading.Event()
        refused: list[str] = []
        gone = threading.Event()

        def on_connect(
            client: Client,  # noqa: ARG001
            data: object,  # noqa: ARG001
            flags: ConnectFlags,  # noqa: ARG001
            reason: ReasonCode,
            properties: Properties | None,  # noqa: ARG001
        ) -> None:
            if reason.is_failure:
                refused.append(str(reason))
            answered.set()

        def on_disconnect(
            client: Client,  # noqa: ARG001
            data: object,  # noqa: ARG001
            flags: DisconnectFlags,  # noqa: ARG001
            reason: ReasonCode,  # noqa: ARG001
            properties: Properties | None,  # noqa: ARG001
        ) -> None:
            gone.set()

        client.on_connect = on_connect
        client.on_disconnect = on_disconnect
        self._client, self._gone = client, gone
        client.connect(self._address.host, self._address.port, keepalive=_KEEPALIVE_S)
        client.loop_start()
        _wait(answered, _ANSWER_S, (stopping, gone), "the broker does not answer")
        if refused:
            raise ConnectionRefusedError(f"{refused[0]}; are {USER} and {PASSWORD} right?")
        client.publish(self._status, "online", qos=1, retain=True)

    def send(self, messages: Sequence[bytes]) -> None:
        """Send messages, and wait until they are on their way: a queue of ours would only grow."""
        client = self._client
        if client is None or self._gone.is_set():
            raise ConnectionError("the broker has gone")
        for message in messages:
            sent = client.publish(self._moment, message, qos=0)
            deadline = time.monotonic() + _SEND_S
            while True:
                try:
                    sent.wait_for_publish(_POLL_S)
                    done = sent.is_published()
                except (RuntimeError, ValueError) as error:
                    raise ConnectionError(str(error)) from error
                if done:
                    break
                if self._gone.is_set() or self._client is None:
                    raise ConnectionError("the broker has gone")
                if time.monotonic() > deadline:
                    raise TimeoutError("the broker takes nothing")

    def close(self) -> None:
        """Say that we are offline, and let go of the connection."""
        client, self._client = self._client, None
        if client is None:
            return
        with contextlib.suppress(Exception):
            if client.is_connected():
                client.publish(self._status, "offline", qos=1, retain=True).wait_for_publish(0.1)
            # The broker forgets the last will of one that takes its leave.
            client.disconnect()
        client.loop_stop()


def _wait(
    event: threading.Event,
    for_s: float,
    instead: Sequence[threading.Event],
    reason: str,
) -> None:
    """Wait for an event; raises `OSError` where another comes first or none does."""
    deadline = time.monotonic() + for_s
    while not event.wait(_POLL_S):
        if time.monotonic() > deadline or any(other.is_set() for other in instead):
            raise TimeoutError(reason)
