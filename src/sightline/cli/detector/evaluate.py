"""`sightline detector evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import _optional
from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    progress,
    say,
    write_result,
)
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_IOU
from sightline.cli.options import (
    ClassesOption,
    DecoderOption,
    DetectorOption,
    HorizonModelOption,
    JsonOption,
    OverwriteOption,
    ProviderOption,
    RecordingsOption,
    SceneArgument,
    ThresholdOption,
    ViewsOption,
    detector_options,
)
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_names
from sightline.cli.replacing import keep_others

if TYPE_CHECKING:
    from sightline.evaluation.detection import DetectionReport, JudgedFrame

_LOWEST = 0.001
"""Average precision is of boxes of any confidence; below this there is nothing but noise."""


def evaluate(
    scene: SceneArgument,
    detector: DetectorOption = DEFAULT_DETECTOR,
    recordings: RecordingsOption = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Boxes drawn by hand, RECORDING.csv, and empty.csv; absent: the scene's own.",
        ),
    ] = None,
    margin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="SOURCE=PX[+SHARE%]",
            help="Added on every side of the drawn boxes of an annotator, as in `detector train`. "
            "May be given several times.",
        ),
    ] = None,
    least_height: Annotated[
        float,
        typer.Option(
            metavar="PX",
            min=0.0,
            help="Drawn boxes that are lower, before margins, are neither to be found nor wrong "
            "to find.",
        ),
    ] = 0.0,
    others_false: Annotated[
        bool,
        typer.Option(
            "--others-false",
            help="To find another boat that was drawn is an error; otherwise it is neither right "
            "nor wrong.",
        ),
    ] = False,
    iou: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Overlap from which a box counts as found.")
    ] = DEFAULT_IOU,
    false_boxes: Annotated[
        float, typer.Option(min=0.0, help="How many false boxes a frame the recall may cost.")
    ] = 1.0,
    decoder: DecoderOption = None,
    classes: ClassesOption = None,
    threshold: ThresholdOption = None,
    provider: ProviderOption = None,
    views: ViewsOption = None,
    model: HorizonModelOption = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure a detector on the frames of a scene in which boxes were drawn."""
    keep_apart([json], [scene, labels, model, detector])
    check_scene_is_there(scene)
    check_model_is_there(model)
    # Before a detector has looked at all frames.
    _optional.module("pycocotools", "score")
    from sightline.detection import OnnxDetector
    from sightline.evaluation.detection import pooled, score_detections
    from sightline.formats.labels import parse_margins
    from sightline.georeferencing.georeferencer import load_model
    from sightline.pipeline.sources import make_detector
    from sightline.scene import Scene
    from sightline.scene.labelled_frames import detect_labelled, scene_labels

    loaded = Scene.load(scene)
    keep_apart([json], loaded.files)
    keep_others([(json, "result")], overwrite=overwrite)
    if recordings is not None:
        loaded = loaded.select(parse_names(recordings))
    margins = parse_margins(margin or [])
    known = {
        name: (one.without_others() if others_false else one)
        .without_specks(least_height)
        .widened(margins)
        for name, one in scene_labels(loaded, labels).items()
    }
    fitted = load_model(model) if model is not None else None
    found = make_detector(
        detector, fitted, detector_options(decoder, classes, threshold, provider, views)
    )
    usual = threshold if threshold is not None else 0.0
    if isinstance(found, OnnxDetector):
        usual, found.threshold = found.threshold, min(found.threshold, _LOWEST)
    with progress() as tell:
        judged = detect_labelled(loaded, known, found, tell)

    def report_of(frames: list[JudgedFrame]) -> DetectionReport:
        return score_detections(
            frames, least_iou=iou, threshold=usual, allowed_per_frame=false_boxes
        )

    whole = report_of(pooled(judged))
    parts = {name: report_of(frames) for name, frames in judged.items()}
    write_result(
        json,
        {
            "detector": detector,
            **whole.to_dict(),
            "recordings": {name: part.to_dict() for name, part in parts.items()},
        },
    )
    say(describe(whole, detector))
    for name, part in parts.items():
        say("  " + describe(part, name))


def describe(report: DetectionReport, what: str) -> str:
    """Summarise a report in a line."""
    from sightline.evaluation.comparison import number, percent

    return (
        f"{what}: {report.drawn} boxes in {report.frames} frames, mAP@0.5 "
        f"{number(report.map_50)}, mAP.5:.95 {number(report.map_50_95)}; at IoU "
        f"{report.iou:g} recall {percent(report.recall)}, precision {percent(report.precision)}, "
        f"{number(report.false_per_frame)} false boxes a frame; recall "
        f"{percent(report.recall_at_allowed)} at {report.allowed_per_frame:g} false boxes a frame"
    )
