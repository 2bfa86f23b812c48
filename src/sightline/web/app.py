"""The endpoints of the live page; imported only where the extra ``live`` is installed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
from collections.abc import Callable
from typing import Annotated

from fastapi import FastAPI, Query, Response, WebSocket, WebSocketDisconnect

from sightline.errors import InputError
from sightline.web.hub import Hub, Kept, Listener, message
from sightline.web.pages import NO_STORE, about_tiles, add_basemap, json_answer, new_app

_MOST_LISTENERS = 128
_SEND_S = 10.0
_MOST_READERS = 2
_MOST_REPLAYED, _MOST_REPLAYED_S = 120, 86_400.0
_LAST_UTC_S = 4e9


def build_app(hub: Hub) -> FastAPI:
    """The application.

    Args:
        hub: What it shows.
    """
    app = new_app("index.html")
    _add_data(app, hub)
    _add_kept(app, hub)
    add_basemap(app, lambda: hub.tiles)

    @app.websocket("/ws")
    async def stream(socket: WebSocket) -> None:
        await _stream(hub, socket)

    return app


def _add_data(app: FastAPI, hub: Hub) -> None:
    @app.get("/api/moment")
    async def moment() -> Response:
        text = None if hub.newest is None else message(hub.newest)
        if text is None:
            return json_answer({"reason": "no moment yet"}, 503)
        return Response(text, 200, NO_STORE, "application/json")

    @app.get("/api/about")
    async def about() -> Response:
        newest = hub.newest
        size = None if newest is None else newest.frame_size_px
        told = {
            "camera": None if newest is None else newest.camera,
            "frame_size_px": size,
            "picture": hub.picture is not None,
            "shore": hub.shore is not None,
            "basemap": about_tiles(hub.tiles),
            "on_the_map": hub.on_the_map is not None and hub.on_the_map.possible,
            "boundaries": hub.boundaries is not None,
            "kept": hub.kept is not None,
        }
        return json_answer(told)

    # What asks others, and what takes long, runs beside the loop.
    @app.get("/healthz")
    def healthz() -> Response:
        health = hub.health()
        return json_answer(health, 200 if health.get("state") == "ok" else 503)

    @app.get("/metrics")
    def metrics() -> Response:
        kind = "text/plain; version=0.0.4; charset=utf-8"
        return Response(hub.metrics(), 200, {**NO_STORE, "content-type": kind})

    @app.get("/tracks.geojson")
    def tracks(minutes: Annotated[float, Query(gt=0.0, le=1440.0)] = 30.0) -> Response:
        return Response(hub.memory.geojson(minutes), 200, NO_STORE, "application/geo+json")

    @app.get("/shore.geojson")
    async def shore() -> Response:
        if hub.shore is None:
            return json_answer({"reason": "no shore was given"}, 404)
        return Response(hub.shore, 200, NO_STORE, "application/geo+json")

    @app.get("/boundaries.geojson")
    async def boundaries() -> Response:
        if hub.boundaries is None:
            return json_answer({"reason": "no lines and no zones were given"}, 404)
        return Response(json.dumps(hub.boundaries), 200, NO_STORE, "application/geo+json")

    @app.get("/picture.jpg")
    def picture() -> Response:
        newest = hub.newest
        taken = None if hub.picture is None else hub.picture()
        if taken is None:
            return json_answer({"reason": "no picture"}, 404)
        headers = dict(NO_STORE)
        if newest is not None and newest.frame_size_px is not None:
            # Boxes are in the pixels of the frame, and the picture may be smaller.
            headers["x-frame-size"] = "{}x{}".format(*newest.frame_size_px)
        return Response(taken, 200, headers, "image/jpeg")

    @app.get("/api/rectified")
    def rectified() -> Response:
        told = None if hub.on_the_map is None else hub.on_the_map.about()
        if told is None:
            return json_answer({"reason": "no picture lies on the map"}, 404)
        return json_answer(told)

    @app.get("/rectified.webp")
    def rectified_picture() -> Response:
        made = None if hub.on_the_map is None else hub.on_the_map.picture()
        if made is None:
            return json_answer({"reason": "no picture lies on the map"}, 404)
        return Response(made, 200, NO_STORE, "image/webp")


def _add_kept(app: FastAPI, hub: Hub) -> None:
    """What was published before: read alone, some at a time, and of some visitors at once."""
    reading = threading.BoundedSemaphore(_MOST_READERS)

    def read(answer: Callable[[Kept], object]) -> Response:
        if hub.kept is None:
            return json_answer({"reason": "nothing is kept"}, 404)
        if not reading.acquire(blocking=False):
            return json_answer({"reason": "others are being answered; ask again"}, 503)
        try:
            return json_answer(answer(hub.kept))
        except (InputError, ValueError) as error:
            return json_answer({"reason": str(error)}, 503)
        finally:
            reading.release()

    def extent(kept: Kept) -> object:
        found = kept.extent_utc_s()
        first, last = (None, None) if found is None else found
        return {"from_utc_s": first, "to_utc_s": last}

    @app.get("/api/kept")
    def kept() -> Response:
        return read(extent)

    @app.get("/api/replay")
    def replay(
        at: Annotated[float, Query(ge=0.0, le=_LAST_UTC_S)],
        seconds: Annotated[float, Query(gt=0.0, le=_MOST_REPLAYED_S)] = 60.0,
    ) -> Response:
        step_s = max(1.0, seconds / _MOST_REPLAYED)
        return read(
            lambda kept: {
                "step_s": step_s,
                "moments": [one.to_message() for one in kept.moments(at, seconds, step_s)],
            }
        )


async def _stream(hub: Hub, socket: WebSocket) -> None:
    """Send moments until either side has enough."""
    if len(hub.listeners) >= _MOST_LISTENERS:
        await socket.close(1013, "too many listen")
        return
    await socket.accept()
    listener = Listener()
    if hub.newest is not None:
        listener.offer(hub.newest)
    hub.listeners.add(listener)
    reader = asyncio.create_task(_read(socket, listener))
    try:
        while (moment := await listener.next()) is not None:
            text = message(moment)
            if text is not None:
                await asyncio.wait_for(socket.send_text(text), _SEND_S)
        await socket.close(1001)
    except (WebSocketDisconnect, TimeoutError, RuntimeError, OSError):
        # It has gone, or it takes nothing: it may come again.
        pass
    finally:
        hub.listeners.discard(listener)
        reader.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            await reader


async def _read(socket: WebSocket, listener: Listener) -> None:
    """Wait until it goes; what it says is of no interest."""
    try:
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass
    finally:
        listener.close()
