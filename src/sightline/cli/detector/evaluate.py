"""`sightline detector evaluate`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline import _optional
from sightline.cli.common import (
    check_model_is_there,
    check_scene_is_there,
    progress,
    say,
    warn,
    write_result,
)
from sightline.cli.defaults import DEFAULT_DETECTOR, DEFAULT_IOU
from sightline.cli.options import (
    BudgetOption,
    ClassesOption,
    DecoderOption,
    DetectorOption,
    EnlargeOption,
    FrameWidthOption,
    HorizonModelOption,
    JsonOption,
    OverwriteOption,
    ProviderOption,
    RecordingsOption,
    ThresholdOption,
    ViewsOption,
    detector_options,
)
from sightline.cli.outputs import keep_apart
from sightline.cli.parsing import parse_distinct_names, parse_names
from sightline.cli.replacing import keep_others
from sightline.errors import InputError

if TYPE_CHECKING:
    from sightline.detection import Detector, DetectorOptions
    from sightline.evaluation.detection import DetectionReport, JudgedFrame
    from sightline.progress import Progress
    from sightline.scene import Scene
    from sightline.scene.labelled_pictures import LabelledPictures

_FIGURES = (".png", ".svg", ".pdf")
_LOWEST = 0.001
"""Average precision is of boxes of any confidence; below this there is nothing but noise."""


def evaluate(
    scene: Annotated[
        Path,
        typer.Argument(
            metavar="SCENE|FOLDER|COCO.json",
            help="The scene file; or a folder of pictures with labels as YOLO or COCO has them, or "
            "a COCO file.",
        ),
    ],
    detector: DetectorOption = DEFAULT_DETECTOR,
    recordings: RecordingsOption = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER|FILE.json",
            help="Boxes drawn by hand: of a scene RECORDING.csv, and empty.csv; of pictures "
            "NAME.txt, or a COCO file. Absent: the scene's own, or what lies with the pictures.",
        ),
    ] = None,
    label_classes: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Names of the classes of YOLO's labels, from 0 on; absent: from classes.txt or "
            "data.yaml.",
        ),
    ] = None,
    targets: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Classes of the pictures' labels that are to be found, others are neither right "
            "nor wrong; absent: those that the detector looks for by the same name, or all.",
        ),
    ] = None,
    group_by_prefix: Annotated[
        bool,
        typer.Option(
            "--group-by-prefix",
            help="Also measure by itself each folder of pictures, or what has the same name up to "
            "the first hyphen or underscore; and the mean of these.",
        ),
    ] = False,
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
    enlarge: EnlargeOption = None,
    frame_width: FrameWidthOption = None,
    budget: BudgetOption = None,
    model: HorizonModelOption = None,
    reliability: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            dir_okay=False,
            help="Draw how often boxes are right by their confidence; or .svg, .pdf.",
        ),
    ] = None,
    json: JsonOption = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Measure a detector on the frames of a scene, or on pictures, in which boxes were drawn."""
    keep_apart([json, reliability], [scene, labels, model, detector])
    _check_figure(reliability, overwrite)
    pictures = _holds_pictures(scene)
    of_others: dict[str, object] = {
        "--recordings": recordings,
        "--margin": margin,
        "--budget": budget,
    }
    if not pictures:
        of_others = {
            "--label-classes": label_classes,
            "--targets": targets,
            "--group-by-prefix": group_by_prefix,
        }
        check_scene_is_there(scene)
    if pictures and detector == "motion":
        raise InputError(
            f"{scene}: 'motion' finds what moves from frame to frame, and these are pictures; give "
            "another detector"
        )
    for option, given in of_others.items():
        if given:
            which = (
                "a scene, and these are pictures" if pictures else "pictures, and this is a scene"
            )
            raise InputError(f"{scene}: {option} is for {which}; leave it out")
    check_model_is_there(model)
    # Before a detector has looked at all frames.
    _optional.module("pycocotools", "score")
    from sightline.evaluation.detection import pooled, score_detections

    options = detector_options(
        *(decoder, classes, threshold, provider, views),
        enlarge=enlarge,
        frame_width=frame_width,
        budget=budget,
    )
    shown = _Shown(detector, options, model, least_height, others_false)
    with progress() as tell:
        if pictures:
            named = (
                parse_distinct_names("--label-classes", label_classes) if label_classes else None
            )
            sought = parse_distinct_names("--targets", targets) if targets else None
            drawn = _pictures(scene, labels, named, (json, overwrite))
            judged, usual = _judge_pictures(drawn, shown, sought, group_by_prefix, tell)
        else:
            loaded = _scene(scene, recordings, (json, overwrite))
            judged, usual = _judge_scene(loaded, shown, labels, margin or [], tell)

    def report_of(frames: list[JudgedFrame]) -> DetectionReport:
        return score_detections(
            frames, least_iou=iou, threshold=usual, allowed_per_frame=false_boxes
        )

    whole = report_of(pooled(judged))
    parts = {name: report_of(frames) for name, frames in judged.items()}
    told: dict[str, object] = {"detector": detector, **whole.to_dict()}
    if not pictures:
        told["recordings"] = {name: part.to_dict() for name, part in parts.items()}
    elif group_by_prefix:
        told["groups"] = {name: part.to_dict() for name, part in parts.items()}
        told["mean_of_groups"] = _mean(list(parts.values()))
    write_result(json, told)
    if reliability is not None:
        _draw_reliability(pooled(judged), whole, reliability)
    say(describe(whole, detector))
    say(
        f"expected calibration error {100.0 * whole.calibration_error:.1f} % of boxes from "
        f"confidence {usual:g} on, at IoU {iou:g}"
    )
    if group_by_prefix or not pictures:
        for name, part in parts.items():
            say("  " + describe(part, name))
    if group_by_prefix:
        say("  " + _describe_mean(list(parts.values())))
    if reliability is not None:
        say(f"reliability: {reliability}")


def _check_figure(path: Path | None, overwrite: bool) -> None:
    """Refuse a figure that could not be written, before a detector has looked at all frames."""
    if path is not None and path.suffix.lower() not in _FIGURES:
        raise InputError(f"{path}: a figure ends in {', '.join(_FIGURES)}")
    keep_others([(path, "figure")], overwrite=overwrite)


def _draw_reliability(frames: list[JudgedFrame], whole: DetectionReport, path: Path) -> None:
    """Draw how often boxes are right, by their confidence."""
    from sightline.evaluation.calibration import reliability
    from sightline.evaluation.detection import right_boxes
    from sightline.reporting.plots import reliability_figure, save_figure

    confidence, right = right_boxes(frames, whole.iou)
    chosen = confidence >= whole.threshold
    save_figure(reliability_figure(reliability(confidence[chosen], right[chosen])), path)


@dataclass(frozen=True)
class _Shown:
    """What looks at the frames, and what of the boxes in them is neither right nor wrong."""

    detector: str
    options: DetectorOptions
    model: Path | None
    least_height_px: float
    others_false: bool

    def made(self, looking: DetectorOptions | None = None) -> tuple[Detector, float]:
        """The detector, made to tell of all that it sees, and the threshold that it has.

        Args:
            looking: How the scene says that frames are looked at.
        """
        from sightline.detection import OnnxDetector
        from sightline.detection.registry import takes_options
        from sightline.georeferencing.georeferencer import load_model
        from sightline.pipeline.sources import make_detector

        fitted = load_model(self.model) if self.model is not None else None
        options = self.options
        if looking is not None and takes_options(self.detector):
            options = options.over(looking)
        found = make_detector(self.detector, fitted, options)
        given = self.options.threshold
        usual = given if given is not None else 0.0
        if isinstance(found, OnnxDetector):
            usual, found.threshold = found.threshold, min(found.threshold, _LOWEST)
        return found, usual


def _holds_pictures(path: Path) -> bool:
    """Whether these are pictures, not a scene."""
    if path.suffix.lower() == ".json":
        return True
    return path.is_dir() and not (path / "scene.toml").is_file()


def _pictures(
    path: Path,
    labels: Path | None,
    named: tuple[str, ...] | None,
    result: tuple[Path | None, bool],
) -> LabelledPictures:
    """Labelled pictures, none of which the result would overwrite."""
    from sightline.scene.labelled_pictures import labelled_pictures

    drawn = labelled_pictures(path, labels, named)
    keep_apart([result[0]], drawn.files)
    keep_others([(result[0], "result")], overwrite=result[1])
    if drawn.tally.left_out:
        warn(f"{drawn.where}: left out: {drawn.tally.reasons()}")
    for sentence in drawn.tally.notes:
        warn(f"{drawn.where}: {sentence}")
    return drawn


def _judge_pictures(
    drawn: LabelledPictures,
    shown: _Shown,
    sought: tuple[str, ...] | None,
    grouped: bool,
    tell: Progress,
) -> tuple[dict[str, list[JudgedFrame]], float]:
    """Judged pictures by group, and the detector's threshold."""
    from sightline.scene.labelled_pictures import chosen_targets, detect_pictures

    found, usual = shown.made()
    judged = detect_pictures(
        drawn,
        found,
        chosen_targets(drawn, found, sought),
        least_height_px=shown.least_height_px,
        others_false=shown.others_false,
        progress=tell,
    )
    groups: dict[str, list[JudgedFrame]] = {}
    for picture, frame in zip(drawn.pictures, judged, strict=True):
        groups.setdefault(picture.prefix if grouped else "", []).append(frame)
    return groups, usual


def _scene(path: Path, recordings: str | None, result: tuple[Path | None, bool]) -> Scene:
    """A scene, none of whose files the result would overwrite."""
    from sightline.scene import Scene

    loaded = Scene.load(path)
    keep_apart([result[0]], loaded.files)
    keep_others([(result[0], "result")], overwrite=result[1])
    return loaded if recordings is None else loaded.select(parse_names(recordings))


def _judge_scene(
    loaded: Scene, shown: _Shown, labels: Path | None, margin: list[str], tell: Progress
) -> tuple[dict[str, list[JudgedFrame]], float]:
    """Judged frames by recording, and the detector's threshold."""
    from sightline.formats.labels import parse_margins
    from sightline.scene.labelled_frames import detect_labelled, scene_labels

    margins = parse_margins(margin)
    known = {
        name: (one.without_others() if shown.others_false else one)
        .without_specks(shown.least_height_px)
        .widened(margins)
        for name, one in scene_labels(loaded, labels).items()
    }
    found, usual = shown.made(loaded.looking)
    return detect_labelled(loaded, known, found, tell), usual


_MEANS = ("map_50", "map_50_95", "average_precision", "recall", "precision", "false_per_frame")


def _mean(parts: Sequence[DetectionReport]) -> dict[str, float]:
    """Means over groups, however many pictures each has; groups without the figure left out."""
    out = {}
    for key in _MEANS:
        known = [value for part in parts if math.isfinite(value := getattr(part, key))]
        out[key] = sum(known) / len(known) if known else math.nan
    return out


def _describe_mean(parts: Sequence[DetectionReport]) -> str:
    from sightline.evaluation.comparison import number, percent

    mean = _mean(parts)
    return (
        f"mean of {len(parts)} groups: at IoU {parts[0].iou:g} AP "
        f"{number(mean['average_precision'])}, recall {percent(mean['recall'])}, "
        f"{number(mean['false_per_frame'])} false boxes a frame"
    )


def describe(report: DetectionReport, what: str) -> str:
    """Summarise a report in a line."""
    from sightline.evaluation.comparison import number, percent

    return (
        f"{what}: {report.drawn} boxes in {report.frames} frames, mAP@0.5 "
        f"{number(report.map_50)}, mAP.5:.95 {number(report.map_50_95)}; at IoU "
        f"{report.iou:g} AP {number(report.average_precision)}, recall {percent(report.recall)}, "
        f"precision {percent(report.precision)}, {number(report.false_per_frame)} false boxes a "
        f"frame; recall {percent(report.recall_at_allowed)} at {report.allowed_per_frame:g} false "
        "boxes a frame"
    )
