"""`sightline detect`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sightline import formats, video
from sightline.cli.common import (
    DetectorOption,
    JsonOption,
    keep_apart,
    parse_time,
    progress,
    say,
    write_result,
)
from sightline.detection import DEFAULT_DETECTOR, VIEWS, DetectorOptions, ViewSettings, frame_count
from sightline.detection import detect as detected
from sightline.detection.decoders import DECODERS
from sightline.detection.looking import same_size
from sightline.detection.onnx import PROVIDERS
from sightline.errors import InputError, unknown_name
from sightline.inference.model_file import load_model
from sightline.pipeline.boxes import is_table, make_detector

DecoderOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"What the ONNX file's outputs mean; absent: seen from them. {', '.join(DECODERS)}.",
    ),
]
ClassesOption = Annotated[
    str | None, typer.Option(metavar="NAME,...", help="Only boxes of these classes.")
]
ThresholdOption = Annotated[
    float | None,
    typer.Option(min=0.0, max=1.0, help="Least confidence of a box; absent: the detector's own."),
]
ProviderOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"What the network runs on: {', '.join(PROVIDERS)}; absent: a GPU where there is one.",
    ),
]
ViewsOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=f"Which parts of a frame are looked at: {', '.join(VIEWS)}; absent: the detector's "
        "own choice.",
    ),
]


def options_of(
    decoder: str | None,
    classes: str | None,
    threshold: float | None,
    provider: str | None,
    views: str | None,
) -> DetectorOptions:
    """The options of a detector as the command line gives them.

    Raises:
        InputError: A name is not known.
    """
    if views is not None and views not in VIEWS:
        raise unknown_name("kind of views", views, VIEWS)
    names = None
    if classes is not None:
        names = tuple(name.strip() for name in classes.split(",") if name.strip())
    return DetectorOptions(
        decoder=decoder,
        classes=names,
        threshold=threshold,
        provider=provider,
        views=ViewSettings(kind=views) if views is not None else None,
    )


def detect(
    source: Annotated[str, typer.Argument(help="A video, a folder of frames, or a stream.")],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            dir_okay=False,
            help="Where the boxes go: .csv, or .txt for MOTChallenge.",
        ),
    ],
    detector: DetectorOption = DEFAULT_DETECTOR,
    decoder: DecoderOption = None,
    classes: ClassesOption = None,
    threshold: ThresholdOption = None,
    provider: ProviderOption = None,
    views: ViewsOption = None,
    model: Annotated[
        Path | None,
        typer.Option(metavar="MODEL", help="A fitted model, which knows where the horizon lies."),
    ] = None,
    start_utc: Annotated[
        str | None, typer.Option(metavar="TIME", help="When a video begins, ISO 8601.")
    ] = None,
    clock: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A table frame,utc that tells the times.")
    ] = None,
    json: JsonOption = None,
) -> None:
    """Find boxes in a video, a folder of frames or a stream."""
    keep_apart([output, json], [source, model, clock])
    if is_table(source):
        raise InputError(f"{source}: is a table; boxes are found in a video, frames or a stream")
    if "://" not in source and not Path(source).exists():
        raise InputError(f"{source}: there is no such video or folder")
    options = options_of(decoder, classes, threshold, provider, views)
    fitted = load_model(model) if model is not None else None
    found = make_detector(detector, fitted, options)
    times = formats.read_clock(clock) if clock is not None else None
    frames = video.frames(source, clock=times, start_utc_s=parse_time(start_utc))
    if fitted is not None:
        frames = same_size(frames, fitted.image_size_px, source)
    count, boxes_found = 0, 0
    with formats.box_writer(output) as writer, progress() as tell:
        for boxes in detected(frames, found, frame_count(source), tell):
            count, boxes_found = count + 1, boxes_found + len(boxes)
            writer.add(boxes)
    write_result(json, {"frames": count, "boxes": boxes_found, "file": str(output)})
    say(f"{boxes_found} boxes in {count} frames")
    say(f"boxes: {output}")
