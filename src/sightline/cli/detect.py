"""`sightline detect`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sightline.cli.common import check_model_is_there, keep_apart, progress, say, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR
from sightline.cli.options import (
    ClassesOption,
    ClockOption,
    DecoderOption,
    DetectorOption,
    HorizonModelOption,
    JsonOption,
    ProviderOption,
    StartOption,
    ThresholdOption,
    ViewsOption,
    detector_options,
)
from sightline.cli.parsing import parse_time
from sightline.errors import InputError


def detect(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A video, a folder of frames, or a stream.")
    ],
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
    model: HorizonModelOption = None,
    start_utc: StartOption = None,
    clock: ClockOption = None,
    json: JsonOption = None,
) -> None:
    """Find boxes in a video, a folder of frames or a stream."""
    keep_apart([output, json], [source, model, clock])
    if "://" not in source and not os.path.exists(source):
        raise InputError(f"{source}: there is no such video or folder")
    check_model_is_there(model)
    from sightline import formats, video
    from sightline.detection import detect as detected
    from sightline.detection.run import same_size
    from sightline.georeferencing.georeferencer import load_model
    from sightline.pipeline.sources import is_table, make_detector
    from sightline.video.reader import frame_count

    if is_table(source):
        raise InputError(f"{source}: is a table; boxes are found in a video, frames or a stream")
    options = detector_options(decoder, classes, threshold, provider, views)
    fitted = load_model(model) if model is not None else None
    found = make_detector(detector, fitted, options)
    times = formats.read_clock(clock) if clock is not None else None
    frames = video.frames(source, clock=times, start_utc_s=parse_time("--start-utc", start_utc))
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
