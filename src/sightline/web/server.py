"""Servers of pages, each in a thread of its own."""

from __future__ import annotations

import contextlib
import json
import logging
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from sightline import _optional
from sightline.errors import InputError
from sightline.formats.tiles import open_tiles
from sightline.moment import Moment
from sightline.web.access import Guard, is_loopback, parse_address
from sightline.web.hub import Hub

if TYPE_CHECKING:
    import asyncio

    import uvicorn
    from starlette.types import ASGIApp

_START_S = 20.0
_CLOSE_S = 1.5
_MOST_SHORE_BYTES = 20_000_000


class _NotCutOff(logging.Filter):
    """Says nothing of answers that the end of the server has cut off."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether to say it."""
        import asyncio

        if str(record.msg).startswith("Cancel "):
            return False
        kind = record.exc_info[0] if record.exc_info else None
        return kind is None or not issubclass(kind, asyncio.CancelledError)


_NOT_CUT_OFF = _NotCutOff()


class PageServer:
    """Serves an application of pages at an address, behind a `Guard`."""

    def __init__(self, address: str, *, token: str | None = None, shows: str) -> None:
        """Check what was asked for; `start` begins to serve.

        Args:
            address: ``HOST:PORT``; port 0 takes a free one.
            token: What visitors have to show; needed where others than this machine reach the
                address.
            shows: What the network would be shown without one, for the message.

        Raises:
            InputError: The address is none or needs a token, or the libraries are not installed.
        """
        self._host, self._port = parse_address(address)
        if not token and not is_loopback(self._host):
            raise InputError(
                f"serving at {address} shows {shows} to the network; "
                "give a token, or serve at 127.0.0.1"
            )
        for name in ("fastapi", "uvicorn", "websockets"):
            _optional.module(name, "live")
        self._token = token or None
        self._server: uvicorn.Server | None = None
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        """Where the page is, once it is served."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        return f"http://{host}:{self._port}/"

    def start(self) -> None:
        """Begin to serve; returns when the page can be opened.

        Raises:
            InputError: The address cannot be had.
        """
        import uvicorn

        try:
            family, *_ = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)[0]
            self._socket = socket.create_server((self._host, self._port), family=family)
        except OSError as error:
            raise InputError(
                f"cannot serve at {self._host}:{self._port} ({error.strerror or error}); "
                "expected a free port of this machine"
            ) from error
        self._port = self._socket.getsockname()[1]
        config = uvicorn.Config(
            Guard(self._build_app(), self._token, self._port),
            # Each request in a log would have the token in it that is in its URL.
            access_log=False,
            log_config=None,
            lifespan="off",
            server_header=False,
            proxy_headers=False,
            limit_concurrency=512,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=1,
            ws_max_size=4096,
            ws_per_message_deflate=False,
        )
        logging.getLogger("uvicorn.error").addFilter(_NOT_CUT_OFF)
        server = uvicorn.Server(config)
        started = threading.Event()
        self._server = server
        self._thread = threading.Thread(
            target=self._run, args=(server, started), name="web", daemon=True
        )
        self._thread.start()
        if not started.wait(_START_S):
            self.close()
            raise InputError(f"cannot serve at {self._host}:{self._port}: it does not start")

    def close(self) -> None:
        """Say goodbye to all that listen, and let go of the port and the thread."""
        server, thread = self._server, self._thread
        self._server = self._thread = None
        if server is not None:
            server.should_exit = True
        if thread is not None:
            thread.join(_CLOSE_S)
            if thread.is_alive() and server is not None:
                server.force_exit = True
                thread.join(_CLOSE_S)
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _build_app(self) -> ASGIApp:
        """The application that is served."""
        raise NotImplementedError

    def _attach(self, loop: asyncio.AbstractEventLoop | None) -> None:
        """Told in which loop it is served; None: in none any more."""

    def _let_go(self) -> None:
        """Told in the loop that it ends."""

    def _run(self, server: uvicorn.Server, started: threading.Event) -> None:
        import asyncio

        made = self._socket

        async def serve() -> None:
            self._attach(asyncio.get_running_loop())
            serving = asyncio.create_task(server.serve(sockets=[made] if made else None))
            try:
                while not serving.done() and not server.should_exit:
                    if server.started:
                        started.set()
                    await asyncio.sleep(0.02 if not started.is_set() else 0.1)
                self._let_go()
                await serving
            finally:
                self._attach(None)

        with contextlib.suppress(asyncio.CancelledError):
            asyncio.run(serve())


class LiveServer(PageServer):
    """Shows moments to browsers, and answers with JSON, GeoJSON and metrics.

    Examples:
        >>> from sightline.web.server import LiveServer
        >>> LiveServer("0.0.0.0:8080")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        sightline.errors.InputError: serving at 0.0.0.0:8080 shows the camera to the network...
    """

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        health: Callable[[], dict[str, object]] | None = None,
        picture: Callable[[], bytes | None] | None = None,
        store: Path | None = None,
        shore: Path | None = None,
        basemap: Path | None = None,
    ) -> None:
        """Check what was asked for; `start` begins to serve.

        Args:
            address: ``HOST:PORT``; port 0 takes a free one.
            token: What visitors have to show; needed where others than this machine reach the
                address.
            health: Numbers, and a ``state`` that is ``ok`` or else has a ``reason``.
            picture: The newest picture as JPEG; None where there is none.
            store: The file of what is kept, whose size is told.
            shore: A GeoJSON file, which the map shows.
            basemap: An MBTiles or PMTiles file, which it shows as well.

        Raises:
            InputError: The address is none or needs a token, a file is none of its kind, or the
                libraries are not installed.
        """
        super().__init__(address, token=token, shows="the camera")
        land = None if shore is None else read_shore(shore)
        tiles = None if basemap is None else open_tiles(basemap)
        self.hub = Hub(health=health, picture=picture, store=store, shore=land, tiles=tiles)

    def publish(self, moment: Moment) -> None:
        """Show a moment; returns at once, and one that is slow loses the oldest."""
        self.hub.publish(moment)

    def _build_app(self) -> ASGIApp:
        from sightline.web.app import build_app

        return build_app(self.hub)

    def _attach(self, loop: asyncio.AbstractEventLoop | None) -> None:
        self.hub.attach(loop)

    def _let_go(self) -> None:
        self.hub.close_listeners()


def read_shore(path: Path) -> bytes:
    """A GeoJSON file, as it is sent to the map.

    Raises:
        InputError: It cannot be read, is too large, or is none.
    """
    try:
        if path.stat().st_size > _MOST_SHORE_BYTES:
            raise InputError(
                f"{path}: is larger than {_MOST_SHORE_BYTES // 1_000_000} MB, "
                "which no browser draws; simplify it"
            )
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({error}); expected GeoJSON") from error
    if not isinstance(document, dict) or document.get("type") not in _GEOJSON:
        raise InputError(f"{path}: is no GeoJSON; expected a FeatureCollection of the shore")
    try:
        return json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    except ValueError as error:
        raise InputError(f"{path}: has a number that is none; expected GeoJSON") from error


_GEOJSON = {
    "FeatureCollection",
    "Feature",
    "GeometryCollection",
    "LineString",
    "MultiLineString",
    "Polygon",
    "MultiPolygon",
}
