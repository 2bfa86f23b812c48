"""`sightline show`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import signals
from sightline.cli.common import check_model_is_there, progress, say, say_aside, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR
from sightline.cli.options import (
    ClockOption,
    DetectorOption,
    JsonOption,
    MaskOption,
    OverwriteOption,
    StartOption,
    WaterLevelOption,
)
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_time, parse_water_level
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.water import WaterLevels

_KINDS = {".mp4": "video", ".png": "figure"}


def show(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A video, or a folder of frames.")
    ],
    model: Annotated[Path, typer.Option(metavar="MODEL", help="The fitted model.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Where it goes: .mp4, or .png for the one frame that --at names.",
        ),
    ],
    tracks: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="What track wrote; absent: it is tracked first."),
    ] = None,
    boxes: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="A table of boxes to draw, as detect writes it."),
    ] = None,
    fixes: Annotated[
        Path | None,
        typer.Option(metavar="LOG", help="A vessel's log, drawn where it says that she was."),
    ] = None,
    fixes_sigma_m: Annotated[
        float | None,
        typer.Option(
            "--fixes-sigma",
            metavar="METRES",
            help="How far off the log is; absent: as the model knows it.",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="TIME|FRAME", help="For a picture: the moment, or a frame's number."),
    ] = None,
    start_utc: StartOption = None,
    clock: ClockOption = None,
    clock_offset_s: Annotated[
        float,
        typer.Option(
            "--clock-offset",
            metavar="SECONDS",
            help="How far the camera's clock is ahead of the true time; it is taken off.",
        ),
    ] = 0.0,
    water_level: WaterLevelOption = None,
    mask: MaskOption = None,
    detector: DetectorOption = DEFAULT_DETECTOR,
    trail_s: Annotated[
        float,
        typer.Option("--trail", min=0.0, metavar="SECONDS", help="Of the way behind a target."),
    ] = 60.0,
    rings: Annotated[
        bool, typer.Option("--rings", help="Draw circles about the camera on the water.")
    ] = False,
    grid: Annotated[
        bool, typer.Option("--grid", help="Draw lines of equal east and north on the water.")
    ] = False,
    horizon: Annotated[bool, typer.Option(help="Draw the horizon.")] = True,
    inset: Annotated[bool, typer.Option("--map/--no-map", help="Draw a map in the corner.")] = True,
    labels: Annotated[bool, typer.Option(help="Write names, positions and the time.")] = True,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Write a video, or a picture, with what was found drawn into it.

    Ctrl-C ends the video, and what was drawn until then is written; a second one breaks off.
    """
    kind = _kind(output, at)
    water = parse_water_level(water_level)
    table = water if isinstance(water, Path) else None
    inputs: list[Path | str | None] = [
        source,
        model,
        tracks,
        boxes,
        fixes,
        clock,
        table,
        mask,
        detector,
    ]
    keep_apart([output, json], inputs)
    keep_others([(output, kind), (json, "result")], overwrite=overwrite)
    moment = _moment(at)
    begin = parse_time("--start-utc", start_utc)
    _check_numbers(fixes_sigma_m, clock_offset_s)
    check_model_is_there(model)
    if "://" not in source and not os.path.exists(source):
        raise InputError(f"{source}: there is no such video or folder")
    attempts = Attempts()
    with signals.stoppable() as stop, progress() as tell:
        from sightline import formats
        from sightline.georeferencing.georeferencer import load_model
        from sightline.overlay import Found, OverlaySettings, still_camera
        from sightline.pipeline.show import Footage, show_picture, show_video, tracks_of
        from sightline.pipeline.sources import make_detector
        from sightline.pipeline.track import TrackSettings
        from sightline.tally import Tally
        from sightline.types import check_inside
        from sightline.video.mask import read_mask

        fitted = load_model(model)
        still_camera(fitted)
        footage = Footage(source, formats.read_clock(clock) if clock is not None else None, begin)
        levels = _levels(water)
        fitted.check_water(levels is not None)
        masked = read_mask(mask) if mask is not None else None
        if masked is not None:
            masked.check_size(fitted.image_size_px, "the model")
        log = formats.read_fixes(fixes) if fixes is not None else None
        drawn = None
        if boxes is not None:
            size_px = fitted.image_size_px
            drawn = formats.read_boxes(boxes, skip_empty=True, image_size_px=size_px)
            check_inside(drawn, size_px, f"{boxes}: ")
        if tracks is not None:
            made = list(formats.read_tracks(tracks, plane=fitted.plane))
        else:
            made, seen = tracks_of(
                footage,
                fitted,
                make_detector(detector, fitted),
                settings=TrackSettings(clock_offset_s=clock_offset_s),
                progress=tell,
                stop=stop,
                water=levels,
                mask=masked,
            )
            drawn = seen if drawn is None else drawn
        found = Found(made, drawn, log, levels, masked)
        settings = OverlaySettings(
            trail_s=trail_s,
            rings=rings,
            grid=grid,
            horizon=horizon,
            inset=inset,
            labels=labels,
            fixes_sigma_m=fixes_sigma_m,
            clock_offset_s=clock_offset_s,
        )
        tally = Tally(source)
        if moment is None:
            shown = show_video(
                *(footage, fitted, found, output),
                settings=settings,
                progress=tell,
                stop=stop,
                tally=tally,
            )
        else:
            shown = show_picture(
                footage, fitted, found, output, at=moment, settings=settings, stop=stop
            )
    for note in tally.notes:
        say_aside("note:", f"{source}: {note}", "yellow")
    if stop.is_set():
        say_aside("stopped:", f"{source}: what was drawn until then is written", "yellow")
    elif shown.broken is not None:
        attempts.failed.append(shown.broken)
    with attempts.one():
        write_result(
            json,
            {
                "frames": shown.frames,
                "tracks": len(made),
                "sound": shown.sound,
                "file": str(output),
                "complete": shown.broken is None and not stop.is_set(),
            },
        )
    say(f"{shown.frames} frames, {len(made)} tracks{', with sound' if shown.sound else ''}")
    say(f"{'video' if kind == 'video' else 'picture'}: {output}")
    attempts.check()


def _kind(output: Path, at: str | None) -> str:
    """What a file is to hold, by its ending."""
    suffix = output.suffix.lower()
    if suffix not in _KINDS:
        raise InputError(
            f"{output}: no video or picture that show writes ends in {suffix or 'nothing'!r}; "
            f"known are {', '.join(_KINDS)}"
        )
    if suffix == ".png" and at is None:
        raise InputError(
            f"{output}: a picture shows one moment, and nothing says which; give --at TIME or "
            "--at FRAME"
        )
    if suffix == ".mp4" and at is not None:
        raise InputError(f"--at {at}: is for a picture; give -o a name that ends in .png")
    return _KINDS[suffix]


def _moment(at: str | None) -> int | float | None:
    """The number of a frame, or POSIX seconds."""
    if at is None:
        return None
    return int(at) if at.isdecimal() and at.isascii() else parse_time("--at", at)


def _check_numbers(fixes_sigma_m: float | None, clock_offset_s: float) -> None:
    if fixes_sigma_m is not None and not 0.0 < fixes_sigma_m < float("inf"):
        raise InputError(f"--fixes-sigma {fixes_sigma_m:g}: is no error of a log; give metres")
    if not abs(clock_offset_s) < float("inf"):
        raise InputError(f"--clock-offset {clock_offset_s}: is not a number; give seconds")


def _levels(water: float | Path | None) -> WaterLevels | None:
    from sightline import formats
    from sightline.water import WaterLevels

    if isinstance(water, Path):
        return formats.read_water_levels(water)
    return None if water is None else WaterLevels.constant(water)
