"""A general detector tuned to one camera by what a log teaches of it, and judged by the rest.

YOLOX-nano begins with the weights that the detector in hand has. The last part of the log, whole
recordings where there are several, is kept for judging: what was found there, before and after,
against the boxes that the log proposed in it.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import torch

from sightline.detection import Detector, DetectorOptions, OnnxDetector
from sightline.detection.metadata import LowerEdge
from sightline.errors import InputError
from sightline.evaluation.calibration import calibrated, fit_calibration
from sightline.evaluation.detection import (
    DetectionReport,
    JudgedFrame,
    right_boxes,
    score_detections,
)
from sightline.formats.labels import Margin
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.labelling.lessons import Lesson, TeacherSettings, learn_lessons
from sightline.overlap import iou
from sightline.pipeline.sources import make_detector
from sightline.progress import Progress
from sightline.scene import Scene
from sightline.tally import Tally
from sightline.training.augmentation import Augmentation, Batches, BatchSettings
from sightline.training.data import (
    Picture,
    backgrounds,
    sprites,
    vanishing_row_px,
)
from sightline.training.export import export_onnx
from sightline.training.loop import TrainingSettings, train
from sightline.training.yolox import YoloxDetector, load_onnx_weights
from sightline.types import Boxes, Frame

NAME = "yolox-nano"
"""The network that is tuned."""

MINUTES, STEPS = 10.0, 1500
"""What tuning may take, of time and of batches; whichever is nearer to its end."""

MARGIN = Margin(2.5, 0.16)
"""Added to boxes along what stands out: as the detector that ships was taught."""

LEAST_GAIN = 0.02
"""Average precision on some dozens of boxes differs by as much without a reason."""

_THRESHOLD, _LOWEST = 0.03, 0.001
"""Least score of what teaches, and of what is judged."""
_HELD_OUT = 0.25
_GUARD_S = 5.0
"""Between what is learned from and what is judged by, in one recording."""
_FEWEST_BOXES = 8
_TEACHING_SHARE = 0.35
"""Of the time that collecting lessons may take, before what is left is divided."""
_RESERVE, _RESERVE_SHARE = 2.0, 0.05
"""For judging and writing the one after: times that judging the detector before took, and a share
of all the time."""
_OVERLAP, _JUDGED_OVERLAP = 0.3, 0.5
"""From where on boxes are of one thing, and from where on one counts as found: COCO's measure."""
_SIZE_PX, _BATCH, _RATE, _WARMUP, _MEAN_DECAY = (320, 192), 8, 5e-4, 40, 0.99
_SCALES = (0.2, 1.5)
"""A detector looks at the horizon as it is, and at all that is nearer scaled down."""
_LEAST_SPREAD_PX = 0.5
_MOST_CHECKED = 4
_TOLERANCE = 1e-3
"""Sides are exponentials, which in single precision lose a digit that scores keep."""


@dataclass(frozen=True)
class AdaptSettings:
    """How a detector is tuned to a camera.

    Attributes:
        minutes: That all of it may take, by the clock.
        steps: Batches that it learns from at most.
        label: Class of the boxes; one of COCO's begins with what is known of it.
        margin: By which proposed boxes are widened before they are taught.
        teacher: How the log teaches.
        seed: Of whatever is random.
        threads: Of the CPU; 0: as many as there are.
        options: How the detector before is run.
    """

    minutes: float = MINUTES
    steps: int = STEPS
    label: str = "boat"
    margin: Margin = MARGIN
    teacher: TeacherSettings = field(default_factory=TeacherSettings)
    seed: int = 0
    threads: int = 0
    options: DetectorOptions = field(default_factory=DetectorOptions)

    def __post_init__(self) -> None:
        if not 0.0 < self.minutes < float("inf"):
            raise InputError(
                f"tuning cannot take {self.minutes:g} minutes; give a positive number, 10 are usual"
            )
        if self.steps < 1:
            raise InputError(f"{self.steps} batches teach nothing; give 1 or more")


@dataclass(frozen=True)
class Adaptation:
    """What tuning a detector to a camera came to.

    Attributes:
        before: The detector in hand, on what was held out.
        after: The tuned one, likewise.
        learned_from: What it learned from, in words.
        judged_by: What was held out, in words.
        boxes: Proposed boxes that it learned from, and that it was judged by.
        steps: Batches that it learned from.
        elapsed_s: Of the whole, by the clock.
        gained: Whether the tuned one finds enough more to take the place of the other.
        export_difference: Of the file from the network; NaN where there is none.
    """

    before: DetectionReport
    after: DetectionReport
    learned_from: str
    judged_by: str
    boxes: tuple[int, int]
    steps: int
    elapsed_s: float
    gained: bool
    export_difference: float

    @property
    def gain(self) -> float:
        """Average precision after, less that before."""
        return self.after.average_precision - self.before.average_precision

    def to_dict(self) -> dict[str, object]:
        """As JSON has it."""
        return {
            "gained": self.gained,
            "gain": self.gain,
            "before": self.before.to_dict(),
            "after": self.after.to_dict(),
            "learned_from": self.learned_from,
            "judged_by": self.judged_by,
            "boxes": list(self.boxes),
            "steps": self.steps,
            "elapsed_s": self.elapsed_s,
            "export_difference": self.export_difference,
        }


def adapt(
    scene: Scene,
    model: Georeferencer,
    detector: str,
    path: Path,
    settings: AdaptSettings | None = None,
    *,
    tally: Tally | None = None,
    progress: Progress | None = None,
    clock: Callable[[], float] = time.monotonic,
) -> Adaptation:
    """Tune a detector to the camera of a scene, and write it where it finds more than before.

    Args:
        scene: Its recordings have pictures and a log.
        model: Of its camera.
        detector: ``"harbour"``, or an ONNX file of YOLOX-nano.
        path: The ONNX file that is written; where nothing is gained it stays as it is.
        settings: How.
        tally: Counts frames and boxes, and what is left out.
        progress: Told what is done, and the share.
        clock: Seconds.

    Raises:
        InputError: The detector is of another network, the model of another camera, the log is
            nowhere in view or too seldom, or the extra ``train`` is not installed.
        ExportError: The file does not agree with the network.
    """
    settings = settings or AdaptSettings()
    tell = progress if progress is not None else _silent
    begun_s = clock()
    if settings.threads:
        torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    network = start_of(detector, settings.label)
    options = _options_of(detector, settings)
    lessons = learn_lessons(
        scene,
        model,
        make_detector(detector, model, replace(options, threshold=_THRESHOLD)),
        replace(settings.teacher, margin=settings.margin),
        tally=tally,
        progress=lambda what, share: tell(what, _TEACHING_SHARE * share),
    )
    taught, held_out = split(lessons)
    judging_s = clock()
    usual = _usual_threshold(detector, options)
    judged = make_detector(detector, model, replace(options, threshold=_LOWEST))
    before = judge(found_in(judged, held_out), held_out, settings.margin, usual)
    judging_s = clock() - judging_s
    rows = horizon(model)
    batches = _batches(taught, settings, rows)
    ends_s = begun_s + (1.0 - _RESERVE_SHARE) * 60.0 * settings.minutes - _RESERVE * judging_s
    left_s = ends_s - clock()
    if left_s <= 0.0:
        raise InputError(
            f"looking at the recordings took the {settings.minutes:g} minutes that tuning may "
            "take; give more, or fewer recordings"
        )
    steps = _learn(network, batches, settings, left_s, tell)
    tell("judging", float("nan"))
    about: dict[str, object] = {"score_threshold": usual, "adapted": _described(taught)}
    with tempfile.TemporaryDirectory() as folder:
        draft = Path(folder) / f"{path.stem}.onnx"
        _export(network, draft, taught, about)
        looking = replace(_looking(options), threshold=_LOWEST)
        tuned = OnnxDetector(draft, options=looking, horizon_px=rows)
        after, measured = _measured(found_in(tuned, held_out), held_out, settings.margin, usual)
    gained = after.average_precision - before.average_precision >= LEAST_GAIN
    difference = _export(network, path, taught, about | measured) if gained else float("nan")
    return Adaptation(
        before=before,
        after=after,
        learned_from=_described(taught),
        judged_by=_described(held_out),
        boxes=(_boxes(taught), _boxes(held_out)),
        steps=steps,
        elapsed_s=clock() - begun_s,
        gained=gained,
        export_difference=difference,
    )


def start_of(detector: str, label: str) -> YoloxDetector:
    """The network that tuning begins with.

    Args:
        detector: ``"harbour"``, or an ONNX file of YOLOX-nano: published, of this project, or
            joined with another.
        label: Its only class.

    Raises:
        InputError: It is of another network, or missing.
    """
    made = YoloxDetector(NAME, (label,))
    if detector == "harbour":
        with as_file(files("sightline.detection") / "harbour" / "harbour.onnx") as packaged:
            load_onnx_weights(made.network, packaged, (label,))
    elif detector.lower().endswith(".onnx"):
        load_onnx_weights(made.network, detector, (label,))
    else:
        raise InputError(
            f"the detector {detector!r} is no network that can be tuned; give harbour, or an ONNX "
            "file of YOLOX-nano"
        )
    return made


def split(lessons: Sequence[Lesson]) -> tuple[list[Lesson], list[Lesson]]:
    """What is learned from, and what is kept for judging.

    Where several recordings show the target, whole recordings are kept: those that come nearest to
    a quarter of its boxes, of equals the last. Else it is the last quarter of the only one.

    Raises:
        InputError: There are too few boxes for both.
    """
    counts: dict[str, int] = {}
    for one in lessons:
        counts[one.recording] = counts.get(one.recording, 0) + len(one.target_xyxy_px)
    total = sum(counts.values())
    if total < 2 * _FEWEST_BOXES:
        raise InputError(
            f"the log shows its vessel in {total} frames, and {2 * _FEWEST_BOXES} or more are "
            "needed to learn from and to judge by; give more recordings"
        )
    showing = [name for name, count in counts.items() if count]
    if len(showing) > 1:
        wanted = _HELD_OUT * total
        kept = min(reversed(showing), key=lambda name: abs(counts[name] - wanted))
        if min(counts[kept], total - counts[kept]) >= _FEWEST_BOXES:
            return (
                [one for one in lessons if one.recording != kept],
                [one for one in lessons if one.recording == kept],
            )
    only = max(showing, key=lambda name: counts[name])
    own = [one for one in lessons if one.recording == only]
    shown = np.array([one.time_utc_s for one in own if len(one.target_xyxy_px)])
    begins_s = float(np.sort(shown)[-max(round(_HELD_OUT * shown.size), _FEWEST_BOXES)])
    return (
        [one for one in lessons if one.recording != only or one.time_utc_s < begins_s - _GUARD_S],
        [one for one in own if one.time_utc_s >= begins_s],
    )


def found_in(detector: Detector, lessons: Sequence[Lesson]) -> list[Boxes]:
    """What a detector finds in frames, each recording from its beginning.

    Args:
        detector: With a threshold as low as is to be judged.
        lessons: In the order of recordings and time.
    """
    found: list[Boxes] = []
    recording = ""
    for one in lessons:
        if one.recording != recording:
            detector.reset()
            recording = one.recording
        found.append(detector.detect(Frame(one.frame, one.time_utc_s, one.image_bgr)))
    return found


def judge(
    found: Sequence[Boxes], lessons: Sequence[Lesson], margin: Margin, threshold: float
) -> DetectionReport:
    """Compare what was found with what the log proposed.

    Some draw close and some with a margin: of both the better counts. Regions of which nothing is
    known count neither way.

    Args:
        found: In each frame.
        lessons: That the detector did not learn from.
        margin: Of who draws with one.
        threshold: From where on boxes count in recall and precision.
    """
    reports = [
        score_detections(
            _judged(found, lessons, wide), least_iou=_JUDGED_OVERLAP, threshold=threshold
        )
        for wide in (Margin(), margin)
    ]
    return max(reports, key=lambda report: report.average_precision)


def lower_edge(found: Sequence[Boxes], lessons: Sequence[Lesson], margin: Margin) -> LowerEdge:
    """Where the boxes of a tuned detector end below what stands out, which ends at the water.

    The margin that was taught, moved by the median of what was found besides.
    """
    off: list[float] = []
    for one, boxes in zip(lessons, found, strict=True):
        if not len(one.target_xyxy_px) or not len(boxes):
            continue
        wanted = margin.widened(one.target_xyxy_px[0])
        overlap = iou(wanted, boxes.xyxy_px)
        if overlap.max() >= _OVERLAP:
            off.append(float(boxes.xyxy_px[int(np.argmax(overlap)), 3] - wanted[3]))
    middle = float(np.median(off)) if off else 0.0
    apart = 1.4826 * float(np.median(np.abs(np.array(off) - middle))) if off else 0.0
    return LowerEdge(
        px=round(margin.px + middle, 3),
        share=margin.share,
        spread_px=round(max(apart, _LEAST_SPREAD_PX), 3),
    )


def _measured(
    found: Sequence[Boxes], lessons: Sequence[Lesson], margin: Margin, threshold: float
) -> tuple[DetectionReport, dict[str, object]]:
    """How good a tuned detector is, and what its file is to say of it."""
    about: dict[str, object] = {"lower_edge": lower_edge(found, lessons, margin).model_dump()}
    mapping = fit_calibration(*right_boxes(_judged(found, lessons, margin), _OVERLAP))
    if mapping is not None:
        about["calibration"] = mapping
        found = [
            boxes.with_columns(confidence=calibrated(boxes.confidence, mapping)) for boxes in found
        ]
    return judge(found, lessons, margin, threshold), about


def horizon(model: Georeferencer) -> tuple[float, float] | None:
    """Rows of the horizon at both edges of a model's pictures; None where it is not known."""
    if model.camera is None:
        return None
    left, right = (float(row) for row in model.camera.horizon_y_px([0.0, model.image_size_px[0]]))
    return (left, right) if np.isfinite([left, right]).all() else None


def _options_of(detector: str, settings: AdaptSettings) -> DetectorOptions:
    """How the detector before is run: of a file with COCO's classes, only one is looked for."""
    options = settings.options
    if options.classes is None and detector.lower().endswith(".onnx"):
        known = OnnxDetector(detector, options=options)
        if len(known.wanted) > 1 and settings.label in known.wanted and not known.lower_edge:
            options = replace(options, classes=(settings.label,))
    if settings.threads:
        options = replace(options, threads=settings.threads)
    return options


def _looking(options: DetectorOptions) -> DetectorOptions:
    """The same way of looking, for a detector with classes of its own."""
    return replace(options, classes=None, decoder=None)


def _usual_threshold(detector: str, options: DetectorOptions) -> float:
    made = make_detector(detector, None, options)
    assert isinstance(made, OnnxDetector)
    return made.threshold


def _judged(found: Sequence[Boxes], lessons: Sequence[Lesson], margin: Margin) -> list[JudgedFrame]:
    """Frames with what was found in them and counts."""
    out = []
    for one, boxes in zip(lessons, found, strict=True):
        truth, xyxy_px = margin.widened(one.target_xyxy_px), boxes.xyxy_px
        middle = 0.5 * (xyxy_px[:, None, :2] + xyxy_px[:, None, 2:])
        low, high = one.open_xyxy_px[:, :2], one.open_xyxy_px[:, 2:]
        inside = np.any(np.all((middle > low) & (middle < high), axis=2), axis=1)
        counts = np.any(iou(xyxy_px[:, None], truth) >= _OVERLAP, axis=1) | ~inside
        out.append(
            JudgedFrame(
                f"{one.recording}/{one.frame}",
                truth,
                np.zeros(len(truth), dtype=bool),
                xyxy_px[counts],
                boxes.confidence[counts],
            )
        )
    return out


def _picture(lesson: Lesson, margin: Margin) -> Picture:
    """A lesson as the training has pictures: what it does not name is known to hold nothing."""
    height, width = lesson.image_bgr.shape[:2]
    target = margin.widened(lesson.target_xyxy_px)
    boxes = np.concatenate([target, lesson.open_xyxy_px]).clip(0.0, [width, height, width, height])
    ignore = np.arange(len(boxes)) >= len(target)
    kept = ((boxes[:, 2:] - boxes[:, :2]) > 1.0).all(axis=1)
    return Picture(
        recording=lesson.recording,
        frame=lesson.frame,
        image=np.ascontiguousarray(lesson.image_bgr[..., ::-1]),
        boxes_xyxy_px=boxes[kept].astype(np.float32),
        labels=np.zeros(int(kept.sum()), dtype=np.int64),
        ignore=ignore[kept],
        worth=np.ones(int(kept.sum()), dtype=np.float32),
    )


def _batches(
    taught: Sequence[Lesson], settings: AdaptSettings, rows: tuple[float, float] | None
) -> Batches:
    """Crops of what is learned from, with the target laid elsewhere on the water."""
    pictures = [_picture(one, settings.margin) for one in taught]
    vanishing_px = vanishing_row_px(pictures)
    if vanishing_px is None and rows is not None:
        vanishing_px = 0.5 * (rows[0] + rows[1])
    return Batches(
        pictures,
        backgrounds(pictures),
        sprites(pictures),
        Augmentation(scales=_SCALES, wash=False),
        BatchSettings(
            size_px=_SIZE_PX,
            batch=_BATCH,
            seed=settings.seed,
            vanishing_row_px=vanishing_px,
        ),
    )


def _learn(
    network: YoloxDetector,
    batches: Batches,
    settings: AdaptSettings,
    left_s: float,
    tell: Progress,
) -> int:
    """Teach a network, and return from how many batches it learned."""
    training = TrainingSettings(
        steps=settings.steps,
        minutes=left_s / 60.0,
        rate=_RATE,
        warmup=_WARMUP,
        mean_decay=_MEAN_DECAY,
        # Nothing is chosen on the way: the last weights count.
        validate_every=settings.steps,
        checkpoint_every=settings.steps,
        seed=settings.seed,
        device="cpu",
        threads=settings.threads,
    )
    with tempfile.TemporaryDirectory() as folder:
        result = train(
            network,
            batches,
            (),
            training,
            Path(folder),
            {},
            progress=lambda what, share: tell(
                what, _TEACHING_SHARE + (1.0 - _TEACHING_SHARE) * share
            ),
        )
    return result.steps


def _export(
    network: YoloxDetector,
    path: Path,
    taught: Sequence[Lesson],
    about: Mapping[str, object],
) -> float:
    shown = taught[:: max(1, len(taught) // _MOST_CHECKED)][:_MOST_CHECKED]
    return export_onnx(
        network,
        path,
        size_px=_SIZE_PX,
        about=about,
        pictures=[np.ascontiguousarray(one.image_bgr[..., ::-1]) for one in shown],
        tolerance=_TOLERANCE,
    )


def _boxes(lessons: Sequence[Lesson]) -> int:
    return sum(len(one.target_xyxy_px) for one in lessons)


def _described(lessons: Sequence[Lesson]) -> str:
    names = list(dict.fromkeys(one.recording for one in lessons))
    noun = "recording" if len(names) == 1 else "recordings"
    return f"{_boxes(lessons)} boxes in {len(lessons)} frames of {noun} {', '.join(names)}"


def _silent(_what: str, _share: float) -> None:
    return
