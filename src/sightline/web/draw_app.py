"""The endpoints of the page on which boxes are drawn; needs the extra ``live``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import cv2
from fastapi import FastAPI, Query, Request, Response
from fastapi import Path as InPath
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ConfigDict, Field

from sightline.errors import InputError, SightlineError
from sightline.labelling.control_points import parse_position
from sightline.text import xml_text
from sightline.web.pages import NO_STORE, add_basemap, json_answer, new_app
from sightline.web.workbench import Workbench

_JPEG_QUALITY = 92
_LARGEST_CROP_PX = 640
_LARGEST_FRAME = 2**31 - 1

_FrameNumber = Annotated[int, Field(ge=0, le=_LARGEST_FRAME)]
_FrameInPath = Annotated[int, InPath(ge=0, le=_LARGEST_FRAME)]
_Offset = Annotated[int, Query(ge=0, le=100_000)]
_Size = Annotated[int, Query(ge=1, le=_LARGEST_CROP_PX)]
_Pixel = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]

# A clock of another date is off by more, and mended in the scene's start_utc.
_MOST_SECONDS = 2 * 86400
_Seconds = Annotated[float, Field(ge=-_MOST_SECONDS, le=_MOST_SECONDS, allow_inf_nan=False)]
_SecondsInQuery = Annotated[
    float | None, Query(ge=-_MOST_SECONDS, le=_MOST_SECONDS, allow_inf_nan=False)
]


_ReachInQuery = Annotated[float | None, Query(ge=1.0, le=20_000.0, allow_inf_nan=False)]


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _FrameRequest(_Request):
    frame: _FrameNumber


class _BoxRequest(_FrameRequest):
    box_px: Annotated[list[_Pixel], Field(min_length=4, max_length=4)]


class _FollowRequest(_FrameRequest):
    forward: bool = True
    backward: bool = True
    count: Annotated[int, Field(ge=1, le=200)] = 40


class _PlaceRequest(_Request):
    place: Annotated[str, Field(max_length=2000)]


class _PointRequest(_PlaceRequest):
    pixel_px: Annotated[list[_Pixel], Field(min_length=2, max_length=2)]
    name: Annotated[str, Field(max_length=100)] = ""


class _PointNumber(_Request):
    number: Annotated[int, Field(ge=1, le=100_000)]


class _CandidateRequest(_Request):
    number: Annotated[int, Field(ge=0, le=10_000)]


class _ClockRequest(_Request):
    clock_offset_s: _Seconds | None


class _MovedPoint(_PointNumber, _PlaceRequest):
    pixel_px: Annotated[list[_Pixel], Field(min_length=2, max_length=2)]


def build_draw_app(bench: Workbench) -> FastAPI:
    """The application.

    Args:
        bench: What it shows and changes.
    """
    app = new_app("draw.html")

    @app.exception_handler(SightlineError)
    def refused(_request: Request, error: SightlineError) -> Response:
        return json_answer({"reason": str(error)}, 422)

    @app.exception_handler(RequestValidationError)
    def invalid(_request: Request, error: RequestValidationError) -> Response:
        first = error.errors()[0]
        # What was sent is not said again: it may be of any size.
        where = ".".join(str(part) for part in first["loc"])
        return json_answer({"reason": f"{where}: {first['msg']}"[:500]}, 422)

    _add_shown(app, bench)
    _add_pictures(app, bench)
    _add_boxes(app, bench)
    _add_points(app, bench)
    _add_fit(app, bench)
    _add_whose(app, bench)
    add_basemap(app, lambda: bench.tiles)
    return app


def _add_shown(app: FastAPI, bench: Workbench) -> None:
    @app.get("/api/scene")
    def scene() -> Response:
        return json_answer(bench.about())

    @app.get("/api/frames")
    def frames() -> Response:
        return json_answer(bench.frames())

    @app.get("/api/state")
    def state() -> Response:
        return json_answer(bench.state())

    @app.get("/api/expected/{frame}")
    def expected(frame: _FrameInPath) -> Response:
        return json_answer(bench.expected(frame))

    @app.get("/shore.geojson")
    def shore() -> Response:
        if bench.shore is None:
            return json_answer({"reason": "no shore was given"}, 404)
        return Response(bench.shore, 200, NO_STORE, "application/geo+json")


def _add_pictures(app: FastAPI, bench: Workbench) -> None:
    @app.get("/frames/{frame}.jpg")
    def picture(frame: _FrameInPath) -> Response:
        options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        coded = cv2.imencode(".jpg", bench.picture(frame), options)[1].tobytes()
        return Response(coded, 200, NO_STORE, "image/jpeg")

    @app.get("/frames/{frame}.png")
    def crop(frame: _FrameInPath, x: _Offset, y: _Offset, width: _Size, height: _Size) -> Response:
        part = bench.picture(frame)[y : y + height, x : x + width]
        if not part.size:
            return json_answer({"reason": "lies outside of the picture"}, 404)
        # The eye judges an edge by these pixels: nothing may be lost of them.
        return Response(cv2.imencode(".png", part)[1].tobytes(), 200, NO_STORE, "image/png")


def _add_boxes(app: FastAPI, bench: Workbench) -> None:
    def change(action: Callable[[], object]) -> Response:
        return json_answer(bench.change(action))

    drawing = bench.drawing

    @app.put("/api/boxes")
    def accept(asked: _BoxRequest) -> Response:
        x1, y1, x2, y2 = asked.box_px
        return change(lambda: drawing.accept(asked.frame, (x1, y1, x2, y2)))

    @app.delete("/api/boxes")
    def remove(asked: _FrameRequest) -> Response:
        return change(lambda: drawing.remove(asked.frame))

    @app.post("/api/follow")
    def follow(asked: _FollowRequest) -> Response:
        return change(
            lambda: drawing.follow(
                asked.frame, forward=asked.forward, backward=asked.backward, count=asked.count
            )
        )

    @app.post("/api/undo")
    def undo() -> Response:
        return change(drawing.undo)

    @app.post("/api/redo")
    def redo() -> Response:
        return change(drawing.redo)


def _add_points(app: FastAPI, bench: Workbench) -> None:
    own = bench.points

    def shown(count: int = 1) -> Response:
        return json_answer({**own.shown(), "count": count})

    @app.get("/api/points")
    def points() -> Response:
        return shown()

    @app.get("/api/points/fit")
    def fitted(left_out: bool = True) -> Response:
        return json_answer(own.fit(left_out=left_out))

    @app.post("/api/place")
    def place(asked: _PlaceRequest) -> Response:
        try:
            latitude, longitude = parse_position(asked.place)
        except InputError as error:
            # Whoever is typing has not come to its end yet, which is no wrong request.
            return json_answer({"reason": str(error)})
        return json_answer({"latitude_deg": latitude, "longitude_deg": longitude, "reason": ""})

    @app.post("/api/points")
    def add(asked: _PointRequest) -> Response:
        own.add((asked.pixel_px[0], asked.pixel_px[1]), asked.place, xml_text(asked.name))
        return shown()

    @app.put("/api/points")
    def move(asked: _MovedPoint) -> Response:
        own.move(asked.number, (asked.pixel_px[0], asked.pixel_px[1]), asked.place)
        return shown()

    @app.delete("/api/points")
    def remove(asked: _PointNumber) -> Response:
        own.remove(asked.number)
        return shown()

    @app.post("/api/points/undo")
    def undo() -> Response:
        return shown(int(own.undo()))

    @app.post("/api/points/redo")
    def redo() -> Response:
        return shown(int(own.redo()))


def _add_fit(app: FastAPI, bench: Workbench) -> None:
    own = bench.fit

    @app.get("/api/fit")
    def about() -> Response:
        return json_answer(own.about())

    @app.get("/api/fit/{frame}/water")
    def water(frame: _FrameInPath) -> Response:
        return json_answer(own.water(frame))

    @app.get("/api/fit/{frame}/log")
    def log(frame: _FrameInPath, clock_offset_s: _SecondsInQuery = None) -> Response:
        return json_answer(own.log(frame, clock_offset_s))

    @app.get("/api/fit/{frame}/map")
    def on_the_map(frame: _FrameInPath, reach_m: _ReachInQuery = None) -> Response:
        return json_answer(own.on_the_map(frame, reach_m))

    @app.get("/rectified/{frame}.webp")
    def rectified(frame: _FrameInPath, reach_m: _ReachInQuery = None) -> Response:
        return Response(own.rectified(frame, reach_m), 200, NO_STORE, "image/webp")

    @app.put("/api/clock")
    def clock(asked: _ClockRequest) -> Response:
        return json_answer(own.state_clock(asked.clock_offset_s))


def _add_whose(app: FastAPI, bench: Workbench) -> None:
    own = bench.whose

    @app.get("/api/candidates")
    def shown() -> Response:
        return json_answer(own.shown())

    @app.post("/api/candidates")
    def weigh() -> Response:
        own.weigh()
        return json_answer(own.shown())

    @app.post("/api/candidates/confirm")
    def confirm(asked: _CandidateRequest) -> Response:
        count = own.confirm(asked.number)
        return json_answer({**bench.state(), "count": count})
