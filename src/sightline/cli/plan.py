"""`sightline plan`."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.cli.common import check_model_is_there, progress, say, write_result
from sightline.cli.options import JsonOption, OverwriteOption, SeedOption
from sightline.cli.outputs import Attempts, keep_apart
from sightline.cli.parsing import parse_names, parse_pair, parse_size_px
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.pipeline.plan import Plan
    from sightline.planning import Hull, Mounting

_KINDS = {".geojson": "contours", ".png": "figure", ".html": "page"}


def plan(
    height_m: Annotated[
        float | None,
        typer.Option("--height", metavar="METRES", help="Of the lens above the water."),
    ] = None,
    field_of_view_deg: Annotated[
        float | None,
        typer.Option(
            "--field-of-view", metavar="DEGREES", help="Between the sides of the picture."
        ),
    ] = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Width and height of the picture, px.")
    ] = "1920x1080",
    place: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON", help="Where the camera is to stand, decimal degrees."),
    ] = None,
    heading_deg: Annotated[
        float | None,
        typer.Option("--heading", metavar="DEGREES", help="Clockwise from north, 0 to 360."),
    ] = None,
    pitch_deg: Annotated[
        float | None,
        typer.Option(
            "--pitch",
            metavar="DEGREES",
            help="Below the horizontal; absent: the horizon a third below the upper edge.",
        ),
    ] = None,
    roll_deg: Annotated[
        float,
        typer.Option(
            "--roll", metavar="DEGREES", help="Positive: the right end of the horizon is lower."
        ),
    ] = 0.0,
    distortion: Annotated[
        str,
        typer.Option(
            metavar="K1,K2", help="Of the lens, as OpenCV has it; a barrel has a negative K1."
        ),
    ] = "0,0",
    model: Annotated[
        Path | None,
        typer.Option(
            metavar="MODEL", help="A fitted model, to be mapped as it is, in place of these."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Who makes the boxes that a model places; absent: whose it knows best.",
        ),
    ] = None,
    boat: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LENGTH[xBEAM]",
            help="A boat of interest, metres; the first is the one that drives, and whose ellipses "
            "are mapped. May be given several times; absent: 5.",
        ),
    ] = None,
    least_px: Annotated[
        float, typer.Option("--least-px", metavar="PX", help="Width at which a boat is found.")
    ] = 8.0,
    tide: Annotated[
        str | None,
        typer.Option(
            metavar="LOW,HIGH", help="Of the water about the level that the height is over, metres."
        ),
    ] = None,
    drive: Annotated[
        str,
        typer.Option(
            metavar="NAME|LOG",
            help="What the camera is learned from: out-and-back, across, zigzag, a boat's log, or "
            "none: it is known exactly.",
        ),
    ] = "zigzag",
    mmsi: Annotated[int | None, typer.Option(help="Which vessel of an AIS log drives.")] = None,
    speed_mps: Annotated[
        float, typer.Option("--speed", metavar="M/S", help="Of a boat that drives a pattern.")
    ] = 4.0,
    every_s: Annotated[
        float, typer.Option("--every", metavar="SECONDS", help="Between two boxes of the drive.")
    ] = 2.0,
    box_px: Annotated[
        float, typer.Option("--box-px", metavar="PX", help="How far off an edge of a box is.")
    ] = 1.0,
    log_m: Annotated[
        float, typer.Option("--log-m", metavar="METRES", help="How far off the log is.")
    ] = 1.5,
    state: Annotated[
        str,
        typer.Option(
            metavar="KEY,...",
            help="Keys of [camera] that the scene is to state: height_m, heading_deg, ...",
        ),
    ] = "",
    reach_m: Annotated[
        float | None,
        typer.Option("--reach", metavar="METRES", help="Of the map; absent: all there is to see."),
    ] = None,
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="A page (.html), the map (.png), contours (.geojson). May be given several times.",
        ),
    ] = None,
    seed: SeedOption = 0,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Say how well a camera would know the water, before it is mounted, or as it was fitted."""
    outputs = output or []
    kinds = [(path, _kind(path)) for path in outputs]
    keep_apart([*outputs, json], [model, drive if os.path.exists(drive) else None])
    keep_others([*kinds, (json, "result")], overwrite=overwrite)
    _check_positive(
        ("--least-px", least_px),
        ("--speed", speed_mps),
        ("--every", every_s),
        ("--box-px", box_px),
        ("--log-m", log_m),
        ("--reach", reach_m),
    )
    size_px = parse_size_px("--size", size)
    levels = _tide(tide)
    lens = parse_pair("--distortion", distortion, ",")
    planned = {
        "--height": height_m,
        "--field-of-view": field_of_view_deg,
        "--place": place,
        "--heading": heading_deg,
    }
    if model is not None:
        given = [
            name for name, value in {**planned, "--pitch": pitch_deg}.items() if value is not None
        ]
        if given or state:
            raise InputError(
                f"{given[0] if given else '--state'}: the model {model} has a camera; give one or "
                "the other"
            )
        check_model_is_there(model)
    else:
        if source is not None:
            raise InputError("--source: is for a fitted model; give --model as well")
        missing = [name for name, value in planned.items() if value is None]
        if missing:
            raise InputError(f"{', '.join(missing)}: missing; a plan needs them, or --model MODEL")
        _check_angles(field_of_view_deg, heading_deg, pitch_deg, roll_deg)
        _check_positive(("--height", height_m))
    where = _place(place)
    with progress() as tell:
        from sightline.geodesy import LocalPlane
        from sightline.pipeline.plan import PlanSettings, plan_of_model
        from sightline.pipeline.plan import plan as plan_camera
        from sightline.planning import DriveNoise

        settings = PlanSettings(
            boats=_boats(boat or ["5"]),
            least_px=least_px,
            tide_m=levels,
            reach_m=reach_m,
            speed_mps=speed_mps,
            interval_s=every_s,
            noise=DriveNoise(box_px, log_m),
            stated=parse_names(state),
            seed=seed,
        )
        if model is not None:
            from sightline.georeferencing.georeferencer import load_model

            made = plan_of_model(
                load_model(model), name=str(model), source=source, settings=settings
            )
        else:
            assert height_m is not None
            assert field_of_view_deg is not None
            assert heading_deg is not None
            mounting = _mounting(
                (height_m, field_of_view_deg, heading_deg), size_px, pitch_deg, roll_deg, lens
            )
            made = plan_camera(
                mounting,
                LocalPlane(*where),
                drive=drive,
                settings=settings,
                mmsi=mmsi,
                progress=tell,
            )
        attempts = Attempts()
        for path, kind in kinds:
            with attempts.one():
                _write(made, path, kind)
        with attempts.one():
            write_result(json, {**made.to_dict(), "files": [str(path) for path in outputs]})
    for line in _said(made):
        say(line)
    for path, kind in kinds:
        say(f"{'map' if kind == 'figure' else kind}: {path}")
    attempts.check()


def _said(made: Plan) -> list[str]:
    from sightline.reporting.plan_page import table_lines

    lengths = [boat.length_m for boat in made.settings.boats]
    out = []
    for level, rows in made.rows.items():
        if level:
            out.append(f"with the water {level:+g} m:")
        out += table_lines(rows, lengths)
    least = f"{made.settings.least_px:g} px"
    for length, range_m in made.sizes_m.items():
        where = "nowhere ahead just" if range_m is None else f"at {range_m:.0f} m"
        out.append(f"A boat of {length:g} m is {where} {least} wide.")
    if made.parameters and made.duration_s:
        out.append(
            f"The drive {made.drive} takes {made.duration_s:.0f} s and has {made.boxes} boxes."
        )
    if made.seldom:
        out.append(f"Determined or not by chance: {', '.join(made.seldom)}.")
    return [*out, *made.statements]


def _write(made: Plan, path: Path, kind: str) -> None:
    from sightline.reporting.plan_page import plan_figure, write_plan
    from sightline.reporting.plots import save_figure

    if kind == "contours":
        made.write_contours(path)
    elif kind == "figure":
        save_figure(plan_figure(made), path)
    else:
        write_plan(made, path)


def _kind(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _KINDS:
        raise InputError(
            f"{path}: no plan is written that ends in {suffix or 'nothing'!r}; known are "
            f"{', '.join(_KINDS)}"
        )
    return _KINDS[suffix]


def _mounting(
    told: tuple[float, float, float],
    size_px: tuple[int, int],
    pitch_deg: float | None,
    roll_deg: float,
    lens: tuple[float, float],
) -> Mounting:
    from sightline.planning import Mounting

    height_m, field_of_view_deg, heading_deg = told
    return Mounting(height_m, field_of_view_deg, size_px, heading_deg, pitch_deg, roll_deg, lens)


def _check_positive(*options: tuple[str, float | None]) -> None:
    for name, value in options:
        if value is not None and not 0.0 < value < math.inf:
            raise InputError(f"{name} {value:g}: must be more than 0")


def _check_angles(
    field_of_view_deg: float | None,
    heading_deg: float | None,
    pitch_deg: float | None,
    roll_deg: float,
) -> None:
    limits = (
        ("--field-of-view", field_of_view_deg, 1.0, 170.0),
        ("--heading", heading_deg, 0.0, 360.0),
        ("--pitch", pitch_deg, -45.0, 80.0),
        ("--roll", roll_deg, -45.0, 45.0),
    )
    for name, value, low, high in limits:
        if value is not None and not low <= value <= high:
            raise InputError(f"{name} {value:g}: must lie between {low:g} and {high:g} degrees")


def _place(text: str | None) -> tuple[float, float]:
    if text is None:
        return 0.0, 0.0
    latitude, longitude = parse_pair("--place", text, ",")
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise InputError(
            f"--place {text!r}: is not on the earth; give latitude, then longitude, decimal degrees"
        )
    return latitude, longitude


def _tide(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    low, high = parse_pair("--tide", text, ",")
    if not -math.inf < low < high < math.inf:
        raise InputError(f"--tide {text!r}: give low water, then high water, metres")
    return low, high


def _boats(texts: Sequence[str]) -> tuple[Hull, ...]:
    from sightline.planning import Hull

    hulls = []
    for text in texts:
        length, times, beam = text.lower().partition("x")
        try:
            hull = Hull(float(length), float(beam)) if times else Hull.of_length(float(length))
        except ValueError as error:
            raise InputError(
                f"--boat {text!r}: expected a length or LENGTHxBEAM in metres, for example 5x1.8"
            ) from error
        except InputError as error:
            raise InputError(f"--boat {text!r}: {error}") from error
        hulls.append(hull)
    return tuple(hulls)
