"""`sightline detect`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sightline import signals
from sightline.cli.common import check_model_is_there, progress, say, say_aside, write_result
from sightline.cli.defaults import DEFAULT_DETECTOR
from sightline.cli.options import (
    BudgetOption,
    ClassesOption,
    ClockOption,
    DecoderOption,
    DetectorOption,
    EnlargeOption,
    FrameWidthOption,
    HorizonModelOption,
    JsonOption,
    MaskOption,
    OverwriteOption,
    ProviderOption,
    StartOption,
    ThresholdOption,
    ViewsOption,
    detector_options,
    tiles_in_turn,
)
from sightline.cli.outputs import Attempts, Outputs, keep_apart
from sightline.cli.parsing import parse_time
from sightline.cli.replacing import keep_others
from sightline.errors import BrokenOffError, InputError


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
    enlarge: EnlargeOption = None,
    frame_width: FrameWidthOption = None,
    budget: BudgetOption = None,
    mask: MaskOption = None,
    model: HorizonModelOption = None,
    start_utc: StartOption = None,
    clock: ClockOption = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Find boxes in a video, a folder of frames or a stream.

    Ctrl-C ends the source, and the boxes until then are written; a second one breaks off.
    """
    keep_apart([output, json], [source, model, clock, detector, mask])
    keep_others([(output, "boxes"), (json, "result")], overwrite=overwrite)
    if "://" not in source and not os.path.exists(source):
        raise InputError(f"{source}: there is no such video or folder")
    check_model_is_there(model)
    with signals.stoppable() as stop:
        from sightline import formats, stopping, video
        from sightline.detection import detect as detected
        from sightline.detection.run import same_size
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.sources import Ending, is_stream, is_table, make_detector
        from sightline.video.mask import read_mask
        from sightline.video.reader import frame_count

        if is_table(source):
            raise InputError(
                f"{source}: is a table; boxes are found in a video, frames or a stream"
            )
        options = detector_options(
            *(decoder, classes, threshold, provider, views),
            enlarge=enlarge,
            frame_width=frame_width,
            budget=budget,
        )
        fitted = load_model(model) if model is not None else None
        found = make_detector(detector, fitted, options)
        times = formats.read_clock(clock) if clock is not None else None
        start_utc_s = parse_time("--start-utc", start_utc)
        ending = Ending(stop)
        frames = ending.frames(
            lambda: video.frames(source, clock=times, start_utc_s=start_utc_s), source
        )
        if fitted is not None:
            frames = same_size(frames, fitted.image_size_px, source)
        hidden = read_mask(mask) if mask is not None else None
        if hidden is not None:
            frames = hidden.painted(frames, source)
        count, boxes_found, masked = 0, 0, 0
        attempts = Attempts()
        with Outputs(formats.box_writer, attempts) as written, progress() as tell:
            written.open([output])
            known = stopping.call(lambda: frame_count(source), stop)
            for boxes in detected(frames, found, known, tell):
                kept = boxes if hidden is None else boxes[~hidden.hides(boxes)]
                masked += len(boxes) - len(kept)
                count, boxes_found = count + 1, boxes_found + len(kept)
                written.add(kept)
            written.finish()
    if stop.is_set():
        say_aside("stopped:", f"{source}: the boxes until then are written", "yellow")
    elif not ending.early and is_stream(source):
        say_aside("note:", f"{source}: has ended; the boxes until then are written", "yellow")
    try:
        ending.check()
    except BrokenOffError as error:
        attempts.failed.append(error)
    result: dict[str, object] = {"frames": count, "boxes": boxes_found, "file": str(output)}
    if hidden is not None:
        result["masked"] = masked
    with attempts.one():
        write_result(json, {**result, "complete": not ending.early})
    say(f"{boxes_found} boxes in {count} frames")
    if masked:
        say(f"left out: {masked} boxes in what is masked")
    for line in tiles_in_turn(found):
        say(line)
    for path in written.written:
        say(f"boxes: {path}")
    attempts.check()
