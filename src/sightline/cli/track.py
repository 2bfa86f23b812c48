"""`sightline track`."""

from __future__ import annotations

import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.common import check_model_is_there, keep_apart, progress, say, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_TRAJECTORY
from sightline.cli.options import (
    ClockOption,
    DetectorOption,
    IntervalOption,
    JsonOption,
    StartOption,
    TrajectoryOption,
)
from sightline.cli.parsing import parse_time, parse_water_level
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.types import Track


def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="A video, a folder of frames, a stream, or a table of boxes."
        ),
    ],
    model: Annotated[Path, typer.Option(metavar="MODEL", help="The fitted model.")],
    output: Annotated[
        list[Path],
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            dir_okay=False,
            help="Where the tracks go, as often as you like: .geojson, .gpx, .kml, .csv, .parquet "
            "or .gpkg.",
        ),
    ],
    more: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="Further files for the tracks, after -o FILE."),
    ] = None,
    start_utc: StartOption = None,
    clock: ClockOption = None,
    platform: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="Where the camera's own vessel was, if it moves."),
    ] = None,
    horizon: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="For a table of boxes: frame,left_y_px,right_y_px of the horizon."
        ),
    ] = None,
    water_level: Annotated[
        str | None,
        typer.Option(
            metavar="METRES|FILE",
            help="How high the water stands above the datum of the model's scene; or a table, "
            "time_utc,water_level_m.",
        ),
    ] = None,
    detector: DetectorOption = DEFAULT_DETECTOR,
    trajectory: TrajectoryOption = DEFAULT_TRAJECTORY,
    interval_s: IntervalOption = None,
    forecast_s: Annotated[
        float | None,
        typer.Option(
            "--forecast",
            metavar="SECONDS",
            help="Say where each target will be for so long after it was last seen: in files of "
            "their own beside each FILE, NAME-forecast.",
        ),
    ] = None,
    compensate_rotation: Annotated[
        bool,
        typer.Option(
            "--compensate-rotation/--no-compensate-rotation",
            "--correct-turns/--no-correct-turns",
            help="Compensate camera rotation seen in the video.",
        ),
    ] = True,
    json: JsonOption = None,
) -> None:
    """Make smooth tracks of everything in a video, a stream or a table of boxes."""
    output = [*output, *(more or [])]
    ahead = [] if forecast_s is None else [_forecast_path(path) for path in output]
    water = parse_water_level(water_level)
    table = water if isinstance(water, Path) else None
    keep_apart([*output, *ahead, json], [source, model, clock, platform, horizon, table])
    check_model_is_there(model)
    from sightline import formats
    from sightline.georeferencing.georeferencer import load_model
    from sightline.pipeline.track import TrackSettings, iter_tracks

    fitted = load_model(model)
    if "://" not in source and not os.path.exists(source):
        raise InputError(f"{source}: there is no such video, folder or table")
    settings = TrackSettings(
        trajectory=trajectory, interval_s=interval_s, compensate_rotation=compensate_rotation
    )
    if forecast_s is not None:
        settings = replace(settings, forecast_s=forecast_s)
    times = formats.read_clock(clock) if clock is not None else None
    horizons = None
    if horizon is not None:
        if times is None:
            raise InputError(
                f"{horizon}: names frames, and nothing tells their times; give a clock (--clock)"
            )
        horizons = formats.read_horizons_csv(horizon, times)
    count, points = 0, 0
    with ExitStack() as stack, progress() as tell:
        writers = [stack.enter_context(formats.track_writer(path)) for path in output]
        forecast_writers = [stack.enter_context(formats.track_writer(path)) for path in ahead]

        def write_forecast(forecast: Track) -> None:
            for writer in forecast_writers:
                writer.add(forecast)

        for made in iter_tracks(
            source,
            fitted,
            detector=detector,
            clock=times,
            start_utc_s=parse_time("--start-utc", start_utc),
            platform=platform,
            horizons=horizons,
            water_levels=water,
            settings=settings,
            progress=tell,
            forecasts=write_forecast if forecast_writers else None,
        ):
            count, points = count + 1, points + len(made)
            for writer in writers:
                writer.add(made)
    written = [str(path) for path in output]
    result: dict[str, object] = {"tracks": count, "points": points, "files": written}
    if ahead:
        result["forecasts"] = [str(path) for path in ahead]
    write_result(json, result)
    say(f"{count} tracks, {points} points")
    for path in output:
        say(f"tracks: {path}")
    for path in ahead:
        say(f"forecasts: {path}")


def _forecast_path(path: Path) -> Path:
    """Where the forecasts of the tracks in a file go: they are a layer of their own on a map."""
    return path.with_name(f"{path.stem}-forecast{path.suffix}")
