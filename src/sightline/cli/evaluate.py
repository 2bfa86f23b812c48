"""`sightline evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    describe,
    describe_forecast,
    say,
)
from sightline.cli.defaults import DEFAULT_TRAJECTORY
from sightline.cli.options import JsonOption, OverwriteOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.replacing import keep_others
from sightline.errors import InputError


def evaluate(
    what: Annotated[
        Path, typer.Argument(metavar="TRACKS|SCENE", help="Tracks in a file, or a scene (.toml).")
    ],
    fixes: Annotated[
        Path | None, typer.Option(metavar="LOG", help="The log that tracks are scored against.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL",
            help="The fitted model that a scene's boxes are scored with; for tracks, tells where "
            "the camera stands.",
        ),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Score the trajectories made of a scene's boxes.")
    ] = False,
    trajectory: Annotated[
        str, typer.Option(help="How --smooth makes them: rts or paper.")
    ] = DEFAULT_TRAJECTORY,
    track_id: Annotated[
        int | None, typer.Option(help="Which track is the target; absent: the nearest to the log.")
    ] = None,
    mmsi: Annotated[int | None, typer.Option(help="Which vessel of an AIS log.")] = None,
    delta_s: Annotated[
        float, typer.Option("--delta", help="Time of the relative error, seconds.", min=1e-3)
    ] = 1.0,
    forecast: Annotated[
        bool,
        typer.Option("--forecast", help="Score forecasts over 5, 10, 30 and 60 s, too."),
    ] = False,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Score tracks against a log, or a fitted model against a scene's boxes and logs."""
    keep_apart([json], [what, fixes, model])
    if what.suffix.lower() == ".toml":
        if model is None:
            raise InputError("a scene is scored with a fitted model; give --model MODEL")
        if fixes is not None:
            raise InputError("a scene names its own logs; give --fixes with tracks only")
        check_scene_is_there(what)
        check_model_is_there(model)
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.evaluate import evaluate as evaluate_any
        from sightline.scene import Scene

        scene = Scene.load(what)
        keep_apart([json], scene.files)
        keep_others([(json, "result")], overwrite=overwrite)
        report = evaluate_any(
            scene,
            model=load_model(model),
            smooth=smooth,
            trajectory=trajectory,
            delta_s=delta_s,
        )
    else:
        if forecast:
            raise InputError(
                "forecasts are scored from a scene's boxes, since tracks are smoothed with what "
                "came after; give the scene and --model MODEL"
            )
        if fixes is None:
            raise InputError("tracks are scored against a log; give --fixes LOG")
        check_model_is_there(model)
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.evaluate import evaluate as evaluate_any
        from sightline.tracks import Tracks

        plane = load_model(model).plane if model is not None else None
        keep_others([(json, "result")], overwrite=overwrite)
        tracks = Tracks.read(what, plane=plane)
        report = evaluate_any(tracks, fixes=fixes, track_id=track_id, mmsi=mmsi, delta_s=delta_s)
        if plane is None:
            report = report.without_camera()
    attempts = Attempts()
    if json is not None:
        with attempts.one():
            report.write(json)
    if report.tracks is not None:
        say(describe(report, "tracks"))
        used = ", ".join(str(number) for number in report.tracks.used)
        say(f"track {used}, chosen by {report.tracks.chosen_by}")
    else:
        say(describe(report, "trajectories" if smooth else "single boxes"))
    if forecast and report.forecast is not None:
        for ahead, error in report.forecast.items():
            say(describe_forecast(error, f"forecast over {ahead} s"))
    for name, part in report.recordings.items():
        say("  " + describe(part, name))
    from sightline.pipeline.evaluate import clock_notes

    for note in clock_notes({name: part.clock for name, part in report.recordings.items()}):
        say(f"note: {note}")
    attempts.check()
