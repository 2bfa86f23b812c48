"""Who may see the page: tokens, names of hosts, origins, and how often somebody may ask."""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import time
from collections import OrderedDict
from collections.abc import Mapping
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, quote, urlencode, urlsplit

from sightline.addresses import parse_address as parse_address

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_RATE_PER_S = 200.0
_BURST = 400.0
_ADDRESSES = 4096
_COOKIE_DAYS = 30
_MOST_BYTES = 64 * 1024
_READING = ("GET", "HEAD", "OPTIONS")

HEADERS = {
    # No script, style or picture but ours, and none within the page.
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; "
        "img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
}
"""Sent with every answer."""


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


class TokenBucket:
    """How often each address may ask.

    Args:
        rate_per_s: In the long run.
        burst: At once.
    """

    def __init__(self, rate_per_s: float = _RATE_PER_S, burst: float = _BURST) -> None:
        self._rate_per_s, self._burst = rate_per_s, burst
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, address: str, now_s: float) -> bool:
        """Whether this one may ask now."""
        left, before_s = self._left.pop(address, (self._burst, now_s))
        left = min(self._burst, left + self._rate_per_s * (now_s - before_s))
        allowed = left >= 1.0
        self._left[address] = (left - allowed, now_s)
        while len(self._left) > _ADDRESSES:
            self._left.popitem(last=False)
        return allowed


class Guard:
    """Lets requests through to an application, or answers them itself.

    Args:
        app: The application.
        token: What has to be shown; None: nothing, and only names of this machine are answered, so
            that no page from elsewhere can give itself our name.
        port: Tells the cookies of several servers of a machine apart.
    """

    def __init__(self, app: ASGIApp, token: str | None, port: int) -> None:
        self._app = app
        self._token = None if token is None else _digest(token)
        self._session = (
            ""
            if token is None
            else hmac.new(token.encode(), b"sightline page", hashlib.sha256).hexdigest()
        )
        self._cookie = f"sightline-{port}"
        self._bucket = TokenBucket()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {
            name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]
        }
        client = scope["client"]
        if not self._bucket.take(client[0] if client else "", time.monotonic()):
            await _refuse(scope, send, 429, "too many requests\n", {"retry-after": "1"})
            return
        if not self._host_is_ours(headers):
            await _refuse(scope, send, 421, "this server does not have that name\n")
            return
        changes = scope["type"] == "http" and scope["method"] not in _READING
        if (scope["type"] == "websocket" or changes) and not _same_origin(headers):
            await _refuse(scope, send, 403, "a page from elsewhere\n")
            return
        if self._token is not None and not self._shows_token(headers):
            query = parse_qsl(scope["query_string"].decode("latin-1"))
            given = dict(query).get("token")
            if scope["type"] == "http" and given is not None and self._is_token(given):
                await self._welcome(scope, send, query)
            else:
                await _refuse(
                    scope,
                    send,
                    401,
                    "a token is needed: open /?token=... once, or send Authorization: Bearer ...\n",
                    {"www-authenticate": "Bearer"},
                )
            return

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *_raw(HEADERS)]
            await send(message)

        if changes:
            kind = headers.get("content-type", "").partition(";")[0].strip().lower()
            if kind != "application/json":
                await _refuse(scope, send, 415, "expected application/json\n")
                return
            body = await _whole_body(receive)
            if body is None:
                await _refuse(scope, send, 413, f"expected at most {_MOST_BYTES} bytes\n")
                return
            receive = _replayed(body, receive)
        await self._app(scope, receive, send_with_headers)

    def _host_is_ours(self, headers: Mapping[str, str]) -> bool:
        if self._token is not None:
            return True
        try:
            name = urlsplit(f"//{headers.get('host', '')}").hostname
        except ValueError:
            return False
        return name is not None and is_loopback(name)

    def _is_token(self, given: str) -> bool:
        return self._token is not None and hmac.compare_digest(_digest(given), self._token)

    def _shows_token(self, headers: Mapping[str, str]) -> bool:
        scheme, _, given = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer" and self._is_token(given.strip()):
            return True
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return False
        value = "" if cookie is None else cookie.value
        return hmac.compare_digest(_digest(value), _digest(self._session))

    async def _welcome(self, scope: Scope, send: Send, query: list[tuple[str, str]]) -> None:
        """Give a cookie for the token, which then leaves the address line."""
        left = urlencode([pair for pair in query if pair[0] != "token"])
        # One slash: two would begin the name of another host.
        path = "/" + quote(scope["path"].lstrip("/"))
        cookie = (
            f"{self._cookie}={self._session}; Path=/; Max-Age={_COOKIE_DAYS * 86400}; "
            "HttpOnly; SameSite=Lax"
        )
        where = f"{path}?{left}" if left else path
        await _refuse(scope, send, 303, "", {"location": where, "set-cookie": cookie})


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


async def _whole_body(receive: Receive) -> bytes | None:
    """What a request brings; None where that is more than any of ours does."""
    parts: list[bytes] = []
    size = 0
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return b"".join(parts)
        parts.append(message.get("body", b""))
        size += len(parts[-1])
        if size > _MOST_BYTES:
            return None
        if not message.get("more_body", False):
            return b"".join(parts)


def _replayed(body: bytes, receive: Receive) -> Receive:
    """A request whose body has been read already."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def again() -> Message:
        return waiting.pop() if waiting else await receive()

    return again


def _same_origin(headers: Mapping[str, str]) -> bool:
    """Whether a WebSocket or a change is asked for by a page of ours, or by no browser."""
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return False
    origin = headers.get("origin")
    return origin is None or urlsplit(origin).netloc.lower() == headers.get("host", "").lower()


def _raw(headers: Mapping[str, str]) -> list[tuple[bytes, bytes]]:
    return [(name.encode("latin-1"), value.encode("latin-1")) for name, value in headers.items()]


async def _refuse(
    scope: Scope, send: Send, status: int, text: str, headers: Mapping[str, str] | None = None
) -> None:
    if scope["type"] == "websocket":
        # Before it is accepted: the answer is 403.
        await send({"type": "websocket.close", "code": 1008, "reason": text.strip()})
        return
    body = text.encode()
    every = {
        **HEADERS,
        "content-type": "text/plain; charset=utf-8",
        "content-length": str(len(body)),
        "cache-control": "no-store",
        **(headers or {}),
    }
    await send({"type": "http.response.start", "status": status, "headers": _raw(every)})
    await send({"type": "http.response.body", "body": body})
