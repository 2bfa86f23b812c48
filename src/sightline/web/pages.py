"""What applications of pages share: their files, and answers; needs the extra ``live``."""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from fastapi import FastAPI, Request, Response
from fastapi import Path as InPath

from sightline.errors import InputError
from sightline.formats.tiles import LARGEST_ZOOM, RASTER, Tiles
from sightline.text import encodable_text

STATIC = Path(__file__).parent / "static"
"""The files of the pages."""

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
# A picture of one transparent pixel, for where the file has none.
_NO_TILE = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c4890000000a494441"
    "54081d63000100000500018a6dbc200000000049454e44ae426082"
)
_KEPT_A_WHILE = {"cache-control": "private, max-age=600"}
_Zoom = Annotated[int, InPath(ge=0, le=LARGEST_ZOOM)]
_Cell = Annotated[int, InPath(ge=0, lt=2**LARGEST_ZOOM)]

NO_STORE = {"cache-control": "no-store"}
"""For what is another thing the next time."""


@dataclass(frozen=True)
class _File:
    media_type: str
    plain: bytes
    packed: bytes
    tag: str

    @classmethod
    def read(cls, path: Path) -> _File:
        plain = path.read_bytes()
        tag = f'"{hashlib.sha256(plain).hexdigest()[:32]}"'
        return cls(_TYPES[path.suffix], plain, gzip.compress(plain, 6, mtime=0), tag)


def new_app(front: str) -> FastAPI:
    """An application that serves the files of the pages.

    Args:
        front: The page at ``/``.
    """
    # Its own pages of documentation would fetch scripts from elsewhere.
    app = FastAPI(title="sightline", docs_url=None, redoc_url=None, openapi_url=None)
    files = {path.name: path for path in STATIC.iterdir() if path.suffix in _TYPES}
    read: dict[str, _File] = {}

    def answer(name: str, request: Request) -> Response:
        if name not in files:
            return Response("there is no such page\n", 404, media_type="text/plain")
        if name not in read:
            read[name] = _File.read(files[name])
        file = read[name]
        headers = {"etag": file.tag, "cache-control": "no-cache", "vary": "accept-encoding"}
        if request.headers.get("if-none-match") == file.tag:
            return Response(None, 304, headers)
        if "gzip" in request.headers.get("accept-encoding", ""):
            headers["content-encoding"] = "gzip"
            return Response(file.packed, 200, headers, file.media_type)
        return Response(file.plain, 200, headers, file.media_type)

    @app.get("/")
    def page(request: Request) -> Response:
        return answer(front, request)

    @app.get("/static/{name}")
    def static(name: str, request: Request) -> Response:
        return answer(name, request)

    return app


def json_answer(value: object, status: int = 200) -> Response:
    """An answer in JSON, written in ASCII: names may hold what no encoding does."""
    return Response(json.dumps(value, allow_nan=False), status, NO_STORE, "application/json")


def about_tiles(tiles: Tiles | None) -> dict[str, object] | None:
    """What a page has to know of a basemap; None where there is none."""
    if tiles is None:
        return None
    about = tiles.about
    return {
        "kind": about.kind,
        "zooms": list(about.zooms),
        "bounds_deg": list(about.bounds_deg),
        "attribution": encodable_text(about.attribution),
        "layers": [encodable_text(name) for name in about.layers],
    }


def add_basemap(app: FastAPI, tiles: Callable[[], Tiles | None]) -> None:
    """Serve the tiles of a basemap.

    Args:
        app: The application.
        tiles: Gives them; None where there is no basemap.
    """

    @app.get("/basemap/{zoom}/{x}/{y}")
    def tile(zoom: _Zoom, x: _Cell, y: _Cell) -> Response:
        own = tiles()
        if own is None:
            return json_answer({"reason": "no basemap was given"}, 404)
        try:
            found = own.tile(zoom, x, y)
        except InputError as error:
            return json_answer({"reason": str(error)}, 422)
        if found is None:
            # A map asks for what lies around as well, which is no mistake.
            nothing = (_NO_TILE, "image/png") if own.about.kind == RASTER else (b"", "")
            return Response(nothing[0], 200, _KEPT_A_WHILE, nothing[1] or None)
        return Response(found[0], 200, _KEPT_A_WHILE, found[1])
