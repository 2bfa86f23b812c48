"""`sightline draw`."""

from __future__ import annotations

import getpass
import os
import sys
import webbrowser
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import signals
from sightline.cli.common import check_scene_is_there, say
from sightline.cli.options import BasemapOption, SceneArgument, detector_options

if TYPE_CHECKING:
    from sightline.detection import Detector

_ADDRESS = "127.0.0.1:8081"


def draw(
    scene: SceneArgument,
    recording: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Which; a scene with one recording needs none."),
    ] = None,
    annotator: Annotated[
        str | None, typer.Option(metavar="NAME", help="Who draws; absent: the user's name.")
    ] = None,
    serve: Annotated[
        str, typer.Option(metavar="HOST:PORT", help="Where the page is served.")
    ] = _ADDRESS,
    token_file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Token of the page; absent: SIGHTLINE_TOKEN in the environment."
        ),
    ] = None,
    detector: Annotated[
        str,
        typer.Option(
            metavar="NAME|none",
            help="Checks boxes that are followed, and finds those among which logged vessels are "
            "recognised: motion, harbour, FILE.onnx.",
        ),
    ] = "none",
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Model to hold against the pictures; absent: what fits the boxes so far.",
        ),
    ] = None,
    shore: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GeoJSON of the shore, which the page's map shows."),
    ] = None,
    basemap: BasemapOption = None,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Only print where the page is.")
    ] = False,
) -> None:
    """Draw boxes and control points in the browser, with a fit after each.

    What is accepted stands in the scene's tables at once. Ctrl-C ends it.
    """
    check_scene_is_there(scene)
    with signals.stoppable() as stop:
        # There is nothing to lose at any time.
        stop.begun = True
        from sightline.detection import DEFAULT_DETECTOR
        from sightline.formats.tiles import open_tiles
        from sightline.georeferencing.georeferencer import load_model
        from sightline.labelling.drawing import Drawing
        from sightline.live.config import page_token
        from sightline.web.draw_server import DrawServer
        from sightline.web.server import read_shore
        from sightline.web.workbench import Workbench

        server = DrawServer(serve, token=page_token(str(token_file) if token_file else None))
        land = None if shore is None else read_shore(shore)
        tiles = None if basemap is None else open_tiles(basemap)
        fitted = None if model is None else load_model(model)
        name = _user() if annotator is None else annotator
        checker = _checker(detector)
        with (
            closing(Drawing(scene, recording, annotator=name, detector=checker)) as own,
            closing(server),
        ):
            bench = Workbench(
                scene,
                own,
                shore=land,
                tiles=tiles,
                model=fitted,
                model_name="" if model is None else model.name,
                detector=DEFAULT_DETECTOR if detector == "none" else detector,
            )
            server.serve(bench)
            say(f"{name} draws in recording {own.recording}: {server.url}")
            say("what is accepted is kept at once; Ctrl-C ends it")
            if not no_browser and _has_screen():
                webbrowser.open(server.url)
            stop.wait()
            bench.whose.close()
            boxes = sum(box.accepted for box in own.boxes())
    say(f"{boxes} boxes in the table of recording {own.recording}")


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "hand"


def _checker(name: str) -> Detector | None:
    if name == "none":
        return None
    from sightline.pipeline.sources import make_detector

    made: Detector = make_detector(name, None, detector_options(None, None, None, None, None))
    return made


def _has_screen() -> bool:
    """Whether there is somewhere to show a browser; in a terminal it would take that over."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
