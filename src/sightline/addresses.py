"""Addresses of servers and receivers: ``HOST:PORT``, and URLs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from sightline.errors import InputError

_MAX_PORT = 65535


@dataclass(frozen=True)
class Address:
    """Where a receiver is.

    Attributes:
        url: As it was given.
        scheme: How it is reached, in lower case.
        host: Name or number.
        port: Its port.
        path: Without the first ``/``; empty where there is none.
        query: Without the ``?``.
    """

    url: str
    scheme: str
    host: str
    port: int
    path: str = ""
    query: str = ""

    @classmethod
    def parse(
        cls,
        url: str,
        ports: Mapping[str, int | None],
        *,
        feed: str,
        with_path: bool = False,
        or_else: str = "",
    ) -> Address:
        """Read a URL.

        Args:
            url: The URL.
            ports: The schemes that are known, and the usual port of each; None: it is to be given.
            feed: Name of the option, which begins what is said of a wrong one.
            with_path: Whether a path and a query are allowed.
            or_else: What is expected besides URLs, for messages.

        Raises:
            InputError: It cannot be used; says why.
        """
        known = " or ".join(f"{scheme}://HOST:PORT" for scheme in ports)
        known = f"{or_else}, {known}" if or_else else known
        if any(not character.isprintable() or character.isspace() for character in url):
            raise InputError(
                f"{feed}: the URL has a space or a control character; expected {known}"
            )
        try:
            parts = urlsplit(url)
            port = parts.port
        except ValueError as error:
            raise InputError(f"{feed} {_shown(url)}: {error}; expected {known}") from error
        # What is secret must neither be printed nor stand in a list of processes.
        if parts.username is not None or parts.password is not None:
            raise InputError(
                f"{feed}: the URL holds a user or a password, which others can read; "
                "give them in the environment"
            )
        scheme = parts.scheme.lower()
        if scheme not in ports:
            raise InputError(f"{feed} {_shown(url)}: unknown scheme; expected {known}")
        if not parts.hostname:
            raise InputError(f"{feed} {_shown(url)}: names no host; expected {known}")
        if "#" in url:
            raise InputError(f"{feed} {_shown(url)}: has a #, which ends a URL; expected {known}")
        if not with_path and (parts.path not in ("", "/") or parts.query):
            raise InputError(f"{feed} {_shown(url)}: ends in more than a port; expected {known}")
        chosen = ports[scheme] if port is None else port
        if chosen is None:
            raise InputError(f"{feed} {_shown(url)}: names no port; expected {known}")
        return cls(url, scheme, parts.hostname, chosen, parts.path.lstrip("/"), parts.query)


def parse_address(address: str) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``.

    Raises:
        InputError: It is of another form.
    """
    host, colon, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not colon or not host or not port.isascii() or not port.isdigit() or int(port) > _MAX_PORT:
        raise InputError(
            f"cannot serve at {address!r}: expected HOST:PORT, for example 127.0.0.1:8080"
        )
    return host, int(port)


def _shown(url: str) -> str:
    """A URL without what stands before an @: it may be a password that was written wrongly."""
    return url.rpartition("@")[2] if "@" in url else url
