"""`sightline track`."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from sightline import signals
from sightline.cli.common import check_model_is_there, progress, say, say_aside, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_TRAJECTORY
from sightline.cli.options import (
    AreaOption,
    BudgetOption,
    ClassesOption,
    ClockOption,
    DetectorOption,
    EnlargeOption,
    IntervalOption,
    JsonOption,
    MaskOption,
    OverwriteOption,
    StartOption,
    ThresholdOption,
    TrajectoryOption,
    ViewsOption,
    WaterLevelOption,
    detector_options,
    tiles_in_turn,
)
from sightline.cli.outputs import Attempts, Outputs, keep_apart
from sightline.cli.parsing import parse_time, parse_water_level
from sightline.cli.replacing import check_holds_tracks, keep_others
from sightline.errors import BrokenOffError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from sightline.clock_offset import ClockOffset
    from sightline.types import Track

_FURTHER = "sightline.further"


class TrackCommand(TyperCommand):
    """Takes what follows ``-o FILE``, behind the source, as further files for the tracks.

    What stands anywhere else is a second source. So a pattern of a shell's that matches several
    tables (``*.csv``) names no output.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put ``-o`` before each further file."""
        ctx.meta[_FURTHER] = []
        with_value = {
            name
            for parameter in self.get_params(ctx)
            if not getattr(parameter, "is_flag", True)
            for name in parameter.opts
        }
        out: list[str] = []
        source = after_output = False
        waiting = iter(args)
        for word in waiting:
            if word == "--":
                out += [word, *waiting]
            elif word.startswith("-") and word != "-":
                name = word.partition("=")[0] if word.startswith("--") else word[:2]
                after_output = name in ("-o", "--output")
                out.append(word)
                if word in with_value:
                    out += [value for value in [next(waiting, None)] if value is not None]
            elif source and after_output:
                ctx.meta[_FURTHER].append(Path(word))
                out += ["-o", word]
            else:
                source, after_output = True, False
                out.append(word)
        rest: list[str] = super().parse_args(ctx, out)
        return rest


def track(
    context: typer.Context,
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
        typer.Argument(
            metavar="[FILE]...",
            help="Further files for the tracks, after SOURCE and -o FILE; one that exists is "
            "replaced only if it holds tracks.",
        ),
    ] = None,
    start_utc: StartOption = None,
    clock: ClockOption = None,
    clock_offset_s: Annotated[
        float | None,
        typer.Option(
            "--clock-offset",
            metavar="SECONDS",
            help="How far the camera's clock is ahead of the true time; it is taken off.",
        ),
    ] = None,
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
    water_level: WaterLevelOption = None,
    area: AreaOption = None,
    mask: MaskOption = None,
    detector: DetectorOption = DEFAULT_DETECTOR,
    classes: ClassesOption = None,
    threshold: ThresholdOption = None,
    views: ViewsOption = None,
    enlarge: EnlargeOption = None,
    budget: BudgetOption = None,
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
    moving_only: Annotated[
        bool, typer.Option("--moving-only", help="Leave out tracks of what never moves.")
    ] = False,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Make smooth tracks of everything in a video, a stream or a table of boxes.

    Ctrl-C ends the source, and what was tracked until then is written; a second one breaks off.
    """
    if more:
        raise InputError(
            f"{more[0]}: is a second source; give one at a time, and further files for its tracks "
            "after -o FILE"
        )
    ahead = [] if forecast_s is None else [_forecast_path(path) for path in output]
    water = parse_water_level(water_level)
    table = water if isinstance(water, Path) else None
    inputs: list[Path | str | None] = [source, model, clock, platform, horizon, table, detector]
    inputs += [*(area or []), mask]
    keep_apart([*output, *ahead, json], inputs)
    for path in context.meta[_FURTHER]:
        check_holds_tracks(path)
    tracked = [(path, "tracks") for path in (*output, *ahead)]
    keep_others([*tracked, (json, "result")], overwrite=overwrite)
    check_model_is_there(model)
    with signals.stoppable() as stop:
        from sightline import formats
        from sightline.detection import DetectorOptions
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.sources import is_stream, is_table, make_detector
        from sightline.pipeline.track import TrackSettings, iter_tracks
        from sightline.tally import Tally

        fitted = load_model(model)
        if "://" not in source and not os.path.exists(source):
            raise InputError(f"{source}: there is no such video, folder or table")
        settings = TrackSettings(
            trajectory=trajectory,
            interval_s=interval_s,
            compensate_rotation=compensate_rotation,
            clock_offset_s=clock_offset_s or 0.0,
            area=formats.read_area(area) if area else None,
            tally=Tally(source),
        )
        if forecast_s is not None:
            settings = replace(settings, forecast_s=forecast_s)
        looking = detector_options(
            None, classes, threshold, None, views, enlarge=enlarge, budget=budget
        )
        table_of_boxes = is_table(source)
        if table_of_boxes and looking != DetectorOptions():
            raise InputError(
                f"{source}: is a table of boxes, and nothing is detected; leave --classes, "
                "--threshold, --views, --enlarge and --budget out"
            )
        looks = detector if table_of_boxes else make_detector(detector, fitted, looking)
        times = formats.read_clock(clock) if clock is not None else None
        horizons = None
        if horizon is not None:
            if times is None:
                raise InputError(
                    f"{horizon}: names frames, and nothing tells their times; give a clock "
                    "(--clock)"
                )
            horizons = formats.read_horizons_csv(horizon, times)
        attempts = Attempts()
        with (
            Outputs(formats.track_writer, attempts) as tracks,
            Outputs(formats.track_writer, attempts) as forecasts,
            progress() as tell,
        ):
            tracks.open(output)
            forecasts.open(ahead)
            found = iter_tracks(
                source,
                fitted,
                detector=looks,
                clock=times,
                start_utc_s=parse_time("--start-utc", start_utc),
                platform=platform,
                horizons=horizons,
                water_levels=water,
                mask=mask,
                settings=settings,
                progress=tell,
                forecasts=_add_to(forecasts, moving_only=moving_only) if ahead else None,
                stop=stop,
            )
            summary = _write(found, tracks, is_stream(source), moving_only=moving_only)
            tracks.finish()
            forecasts.finish()
    if stop.is_set():
        say_aside("stopped:", f"{source}: what was tracked until then is written", "yellow")
    elif summary.broken is not None:
        attempts.failed.append(summary.broken)
    elif is_stream(source):
        say_aside("note:", f"{source}: has ended; what was tracked until then is written", "yellow")
    result: dict[str, object] = {
        "tracks": summary.tracks,
        "points": summary.points,
        "moving": summary.tracks - summary.moored - summary.untold,
        "moored": summary.moored,
        "untold": summary.untold,
        "files": [str(path) for path in tracks.written],
        "complete": summary.broken is None and not stop.is_set(),
    }
    if ahead:
        result["forecasts"] = [str(path) for path in forecasts.written]
    left_out: dict[str, int] = {}
    if settings.tally is not None:
        left_out = {reason: left.count for reason, left in settings.tally.left_out.items()}
    if area or mask is not None:
        result["left_out"] = left_out
    if clock_offset_s:
        result["clock_offset_s"] = clock_offset_s
    with attempts.one():
        write_result(json, result)
    say(f"{summary.tracks} tracks, {summary.points} points{_of_which(summary)}")
    for line in [] if isinstance(looks, str) else tiles_in_turn(looks):
        say(line)
    if left_out:
        say(f"left out: {', '.join(f'{count} {reason}' for reason, count in left_out.items())}")
    for note in _clock_notes(clock_offset_s, fitted.report.clocks):
        say(f"note: {note}")
    for path in tracks.written:
        say(f"tracks: {path}")
    for path in forecasts.written:
        say(f"forecasts: {path}")
    attempts.check()


@dataclass
class _Summary:
    """What was written of a source, and what ended it too early."""

    tracks: int = 0
    points: int = 0
    moored: int = 0
    untold: int = 0
    broken: Exception | None = None


def _of_which(summary: _Summary) -> str:
    """How many tracks move, where some do not."""
    still = summary.moored + summary.untold
    if not still:
        return ""
    return (
        f"; of the tracks {summary.tracks - still} moving, {summary.moored} moored, "
        f"{summary.untold} not told"
    )


def _add_to(outputs: Outputs[Track], *, moving_only: bool) -> Callable[[Track], None]:
    """What writes forecasts, if need be without those of what never moves."""

    def add(forecast: Track) -> None:
        if not (moving_only and forecast.never_moves):
            outputs.add(forecast)

    return add


def _write(
    found: Iterator[Track], tracks: Outputs[Track], stream: bool, *, moving_only: bool
) -> _Summary:
    """Write tracks to the end of their source; of a stream whatever ends it."""
    summary = _Summary()
    try:
        for made in found:
            if moving_only and made.never_moves:
                continue
            tracks.add(made)
            summary.tracks += 1
            summary.points += len(made)
            summary.moored += made.never_moves
            summary.untold += made.untold
    except BrokenOffError as error:
        summary.broken = error
    except Exception as error:
        # Nobody can send it again.
        if not (stream and summary.tracks and tracks.any_open):
            raise
        summary.broken = error
    return summary


def _clock_notes(stated_s: float | None, clocks: Mapping[str, ClockOffset]) -> list[str]:
    """Sentences on the time that the tracks are in."""
    if stated_s:
        which = "ahead" if stated_s > 0.0 else "behind"
        return [
            (
                f"{abs(stated_s):g} s were {'taken off' if stated_s > 0.0 else 'added to'} the "
                f"camera's times, whose clock is {which}; the tracks are in the log's time"
            )
        ]
    off = {name: clock for name, clock in clocks.items() if clock.used_s}
    if stated_s is not None or not off:
        return []
    name, clock = next(iter(off.items()))
    return [
        (
            f"the tracks are in the camera's time; in recording {name}, from which the model "
            f"learned, its clock was {clock.words}: if it still is, give --clock-offset "
            f"{clock.used_s:.1f}"
        )
    ]


def _forecast_path(path: Path) -> Path:
    """File for the forecasts of the tracks in a file, as a layer of its own on a map."""
    return path.with_name(f"{path.stem}-forecast{path.suffix}")
