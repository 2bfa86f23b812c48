"""What applications of pages share: their files, and answers; needs the extra ``live``."""

from __future__ import annotations

import gzip
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from fastapi import FastAPI, Request, Response

STATIC = Path(__file__).parent / "static"
"""The files of the pages."""

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
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
