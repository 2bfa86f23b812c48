"""Detectors beside each other, as in the paper: its Table 1 and its Figure 2.

What is measured is kept at once: `COMPARISON`, `TABLE` and `FIGURE` in the folder are whole at any
time, and beside each training lies `MEASURED`, so that a comparison that was stopped goes on with
what is missing.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure

from sightline import _optional
from sightline.atomic import atomic_path
from sightline.detection import _onnxruntime
from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.errors import InputError, SightlineError, unknown_name
from sightline.evaluation.comparison import number
from sightline.evaluation.detection import DetectionReport, pooled, score_detections
from sightline.evaluation.report import write_json
from sightline.formats.labels import Labels
from sightline.scene import Recording, Scene
from sightline.scene.labelled_frames import detect_labelled, scene_labels
from sightline.training.architecture import ARCHITECTURES, build
from sightline.training.augmentation import Augmentation
from sightline.training.loop import find_device, versions
from sightline.training.recipe import Recipe, train_detector
from sightline.video import frames

Tell = Callable[[str, float], None]

COMPARISON = "comparison.json"
TABLE = "comparison.md"
FIGURE = "augmentation.png"
MEASURED = "measured.json"

VARIANTS: Mapping[str, tuple[bool, bool]] = {
    "YOLO + added": (True, True),
    "YOLO only": (True, False),
    "added only": (False, True),
    "none": (False, False),
}
"""Of the paper's Figure 2: whether YOLOv4's own augmentation, and whether the added ones."""

_LOWEST = 0.001
"""Least confidence of boxes that average precision is made of."""
_TIMED_FRAMES = 10
_STUDIED = "yolov4"


@dataclass(frozen=True)
class ComparedDetector:
    """A row of the paper's Table 1.

    Attributes:
        name: The architecture.
        parameters: How many there are.
        file_bytes: Of the ONNX file.
        training_s: How long it learned, over all sittings; validations do not count.
        steps: Batches that it learned from.
        frame_ms: Median time for a frame of the test recordings, all views of it.
        report: How well it does on the test recordings.
    """

    name: str
    parameters: int
    file_bytes: int
    training_s: float
    steps: int
    frame_ms: float
    report: DetectionReport

    def to_dict(self) -> dict[str, Any]:
        """The row as JSON has it."""
        return {**asdict(self), "report": self.report.to_dict()}

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> ComparedDetector:
        """The row from what `to_dict` gave; null is NaN."""
        report = {name: _number(value) for name, value in content["report"].items()}
        row = {name: _number(value) for name, value in content.items()}
        return cls(**{**row, "report": DetectionReport(**report)})


class ComparisonError(SightlineError):
    """Some of the detectors could not be compared; the others were."""


@dataclass(frozen=True)
class DetectorComparison:
    """What came out.

    Attributes:
        rows: A detector each.
        histories: Of YOLOv4, by `VARIANTS`: a row a validation, with ``step``, ``score`` (mAP at
            0.5 IoU) and ``giou_loss``; empty where that was not asked for.
        hardware: What it ran on.
        split: Recordings by ``train``, ``validation`` and ``test``.
        settings: What all trainings had in common: ``steps`` at most, ``minutes`` at most (0: no
            limit), ``batch``, ``size_px`` of a crop, ``scales``, ``rate``, ``seed``, ``threads``,
            and ``options`` of the architectures.
        failed: Why others have no row, by name; by folder where it is one of `VARIANTS`.
    """

    rows: tuple[ComparedDetector, ...]
    histories: Mapping[str, Sequence[Mapping[str, float]]]
    hardware: Mapping[str, Any]
    split: Mapping[str, Sequence[str]]
    settings: Mapping[str, Any]
    failed: Mapping[str, str] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        return {
            "detectors": {row.name: row.to_dict() for row in self.rows},
            "failed": dict(self.failed),
            "augmentation": {
                name: [dict(row) for row in history] for name, history in self.histories.items()
            },
            "hardware": dict(self.hardware),
            "split": {part: list(names) for part, names in self.split.items()},
            "settings": dict(self.settings),
        }


@dataclass(frozen=True)
class ComparisonSettings:
    """Which detectors are compared.

    Attributes:
        architectures: Which.
        options: Of each architecture.
        augmentations: Whether YOLOv4 is also trained without either augmentation and without
            both, as in Figure 2. For that the recipe must have validation recordings.
    """

    architectures: Sequence[str] = ARCHITECTURES
    options: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    augmentations: bool = True


def compare_detectors(
    scene: Scene,
    recipe: Recipe,
    test: Sequence[str],
    folder: Path,
    settings: ComparisonSettings | None = None,
    *,
    labels: Path | None = None,
    progress: Tell | None = None,
) -> DetectorComparison:
    """Train detectors alike, and measure them on recordings that none has seen.

    Every detector learns with the paper's five augmentations, YOLOv4 with its own (mosaic) besides,
    as in the paper's Table 1; ``harbour`` with all that it was made with. One that fails is told
    of, and the others are compared. A folder in which some are trained or measured already, with
    the same recipe and data, is gone on with.

    Args:
        scene: Camera and recordings.
        recipe: What all have in common; its architecture, augmentation and options are replaced.
        test: Names of the recordings to measure on.
        folder: Where each training gets a folder, and `write_comparison` its files after each.
        settings: Which detectors are compared; absent: all.
        labels: A folder with drawn boxes for the test; absent: the scene's own.
        progress: Told what is done, and the share.

    Raises:
        InputError: A name or an option is unknown, a recording is in two parts of the split, or
            something is missing that a training needs.
        Exception: None could be compared: why the first could not.
    """
    tell = progress if progress is not None else _silent
    settings = settings or ComparisonSettings()
    given = dict(settings.options)
    # Before hours of training, whose results could not be measured.
    _optional.module("pycocotools", "train")
    known = _checked(scene, recipe, test, settings, labels)
    jobs = _jobs(recipe, settings)
    data = _fingerprint(scene, (*recipe.train, *recipe.validation, *test), recipe, labels)
    rows: list[ComparedDetector] = []
    failed: dict[str, str] = {}
    histories: dict[str, Sequence[Mapping[str, float]]] = {}

    def so_far() -> DetectorComparison:
        return DetectorComparison(
            rows=tuple(rows),
            histories=dict(histories),
            hardware=hardware(recipe.training.device),
            split={"train": recipe.train, "validation": recipe.validation, "test": tuple(test)},
            settings=_settings(recipe, given),
            failed=dict(failed),
        )

    errors: list[Exception] = []
    for done, job in enumerate(jobs):
        where = folder / job.where
        identity = _identity(job.recipe, data, test)
        kept = _kept(where, job.recipe.architecture, identity, job.row)
        try:
            if kept is None:
                kept = _measured(scene, known, test, job, where, tell, done / len(jobs), len(jobs))
                write_json(where / MEASURED, {"identity": identity, **kept})
        # Whatever one of them dies of must not cost the others their hours.
        except Exception as error:
            errors.append(error)
            failed[job.where] = " ".join(str(error).split()) or type(error).__name__
        else:
            if job.row:
                rows.append(ComparedDetector.from_dict(kept["row"]))
            if job.variant is not None:
                histories[job.variant] = kept["history"]
        if folder.exists():
            write_comparison(so_far(), folder)
    if errors and not rows and not histories:
        raise errors[0]
    return so_far()


def write_comparison(comparison: DetectorComparison, folder: Path) -> None:
    """Write all that is known: `COMPARISON`, `TABLE` and, where it was asked for, `FIGURE`.

    Raises:
        InputError: A file cannot be written.
    """
    write_json(folder / COMPARISON, comparison.to_dict())
    with atomic_path(folder / TABLE) as temporary:
        temporary.write_text(comparison_table(comparison), encoding="utf-8")
    if comparison.histories:
        with atomic_path(folder / FIGURE) as temporary:
            augmentation_figure(comparison).savefig(temporary, dpi=150)


HEADINGS = ("detector", "training", "batches", "a frame", "parameters", "mAP @ 0.5", "mAP .5:.95")


def comparison_cells(comparison: DetectorComparison) -> list[tuple[str, ...]]:
    """The paper's Table 1: a row for each of the rows, below `HEADINGS`."""
    return [
        (
            row.name,
            f"{row.training_s / 60.0:.1f} min",
            str(row.steps),
            f"{row.frame_ms:.0f} ms",
            f"{row.parameters / 1e6:.1f} M",
            number(row.report.map_50),
            number(row.report.map_50_95),
        )
        for row in comparison.rows
    ]


def comparison_table(comparison: DetectorComparison) -> str:
    """The same in Markdown, with what failed below."""
    lines = [HEADINGS, ("---",) * len(HEADINGS), *comparison_cells(comparison)]
    table = "".join("| " + " | ".join(cells) + " |\n" for cells in lines)
    return table + "".join(
        f"\n{name} could not be compared: {why}\n" for name, why in comparison.failed.items()
    )


def augmentation_figure(comparison: DetectorComparison) -> Figure:
    """The paper's Figure 2: YOLOv4 on the validation recordings over its training.

    Raises:
        InputError: The comparison was made without it.
    """
    if not comparison.histories:
        raise InputError("the comparison was made without YOLOv4's augmentations")
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, history in comparison.histories.items():
        steps = [row["step"] for row in history]
        left.plot(steps, [row["score"] for row in history], marker="o", ms=3, label=name)
        right.plot(steps, [row["giou_loss"] for row in history], marker="o", ms=3, label=name)
    left.set(xlabel="batches", ylabel="mAP @ 0.5 IoU", ylim=(0.0, 1.0))
    right.set(xlabel="batches", ylabel="GIoU loss", ylim=(0.0, 2.0))
    for axes in (left, right):
        axes.grid(alpha=0.3)
    left.legend(loc="best", fontsize="small")
    return figure


def hardware(device: str = "auto") -> dict[str, Any]:
    """What a comparison runs on, as it must be named beside its times.

    Args:
        device: That trainings were asked to use.
    """
    used = find_device(device)
    return {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "training_device": str(used),
        "gpu": torch.cuda.get_device_name(used) if used.type == "cuda" else None,
        "frames_on": "cpu",
        "onnxruntime": _onnxruntime.load().__version__,
        **versions(),
    }


def _cpu() -> str:
    """The processor's name; on Linux `platform` does not know it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


@dataclass(frozen=True)
class _Job:
    """A training, and what of it is wanted: the row, the history as one of `VARIANTS`, or both."""

    recipe: Recipe
    where: str
    row: bool
    variant: str | None = None


def _jobs(
    recipe: Recipe,
    settings: ComparisonSettings,
) -> list[_Job]:
    architectures, options = settings.architectures, settings.options
    scales = recipe.augmentation.scales

    def own(name: str, augmentation: Augmentation) -> Recipe:
        return replace(
            recipe, architecture=name, augmentation=augmentation, options=options.get(name, {})
        )

    both = next(iter(VARIANTS))
    jobs = [
        _Job(
            own(name, _usual(name, scales)),
            name,
            row=True,
            variant=both if settings.augmentations and name == _STUDIED else None,
        )
        for name in architectures
    ]
    if settings.augmentations:
        jobs += [
            _Job(
                own(_STUDIED, _augmentation(*parts, scales)),
                _STUDIED if variant == both else f"{_STUDIED}-{variant.replace(' ', '-')}",
                row=False,
                variant=variant,
            )
            for variant, parts in VARIANTS.items()
            if variant != both or _STUDIED not in architectures
        ]
    return jobs


def _checked(
    scene: Scene,
    recipe: Recipe,
    test: Sequence[str],
    settings: ComparisonSettings,
    labels: Path | None,
) -> dict[str, Labels]:
    """What is known of the recordings to test on; all that can be refused at once is."""
    for name in settings.architectures:
        if name not in ARCHITECTURES:
            raise unknown_name("architecture", name, ARCHITECTURES)
    for name in test:
        if name in (*recipe.train, *recipe.validation):
            raise InputError(
                f"recording {name!r} is both learned from and tested on; a recording can be in one "
                "part only"
            )
    if settings.augmentations and not recipe.validation:
        raise InputError(
            "how YOLOv4 improves over training needs recordings to look at: --validation NAME,..."
        )
    known = {name: one for name, one in scene_labels(scene, labels).items() if name in test}
    if set(known) != set(test) or not test:
        missing = ", ".join(sorted(set(test) - set(known))) or "none was named"
        raise InputError(
            f"no boxes in pictures to test on ({missing}); give recordings that have both: "
            "--test NAME,..."
        )
    find_device(recipe.training.device)
    studied = [_STUDIED] if settings.augmentations else []
    for name in dict.fromkeys((*settings.architectures, *studied)):
        # A wrong option is said before hours are spent on the others.
        build(name, recipe.labels.class_names, **settings.options.get(name, {}))
    return known


def _measured(
    scene: Scene,
    known: Mapping[str, Labels],
    test: Sequence[str],
    job: _Job,
    where: Path,
    tell: Tell,
    share: float,
    jobs: int,
) -> dict[str, Any]:
    """Train, and measure if there is to be a row."""
    made = train_detector(
        scene,
        job.recipe,
        where,
        progress=lambda what, part: tell(
            f"{job.where}: {what}", share + (part / jobs if math.isfinite(part) else 0.0)
        ),
    )
    content: dict[str, Any] = {"history": [dict(row) for row in made.training.history]}
    if job.row:
        tell(f"{job.where}: measuring", share + 1.0 / jobs)
        detector = OnnxDetector(made.path, options=_options())
        row = ComparedDetector(
            name=job.recipe.architecture,
            parameters=made.parameters,
            file_bytes=made.path.stat().st_size,
            training_s=made.training.learned_s,
            steps=made.training.steps,
            frame_ms=_frame_ms(scene, test[0], detector),
            report=score_detections(pooled(detect_labelled(scene, known, detector))),
        )
        content["row"] = row.to_dict()
    return content


def _kept(where: Path, architecture: str, identity: str, row: bool) -> dict[str, Any] | None:
    """What was measured of the same recipe and data before; None if it has to be done."""
    try:
        content = json.loads((where / MEASURED).read_text(encoding="utf-8"))
        if content["identity"] != identity or not (where / f"{architecture}.onnx").exists():
            return None
        if row:
            ComparedDetector.from_dict(content["row"])
        return {"history": list(content["history"]), **({"row": content["row"]} if row else {})}
    # A damaged one is none.
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _identity(recipe: Recipe, data: str, test: Sequence[str]) -> str:
    """A hash of what a row depends on; where and with how many threads it runs is left out."""
    content = asdict(recipe)
    # What is in these files is part of ``data``, wherever they lie.
    del content["labels"]["folders"], content["initial"]
    for free in ("device", "threads", "checkpoint_every"):
        del content["training"][free]
    content |= {"data": data, "test": list(test)}
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def _fingerprint(scene: Scene, names: Sequence[str], recipe: Recipe, labels: Path | None) -> str:
    """A hash of the boxes, and of the sizes of pictures, which are too many to be read for it."""
    found = hashlib.sha256()
    recordings = [one for one in scene.recordings if one.name in names]
    tables = [one.boxes_path for one in recordings if one.boxes_path is not None]
    for folder in dict.fromkeys((*recipe.labels.folders, *([labels] if labels else []))):
        tables += sorted(Path(folder).glob("*.csv"))
    for table in (*tables, *([recipe.initial] if recipe.initial else [])):
        if table.is_file():
            found.update(table.name.encode() + table.read_bytes())
    for recording in recordings:
        found.update(repr([recording.name, _sizes(recording)]).encode())
    return found.hexdigest()


def _sizes(recording: Recording) -> list[tuple[str, int]]:
    source = recording.source
    if source is None or not source.exists():
        return []
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    return [(file.name, file.stat().st_size) for file in files]


def _settings(recipe: Recipe, options: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "steps": recipe.training.steps,
        "minutes": recipe.training.minutes,
        "batch": recipe.batch,
        "size_px": list(recipe.size_px),
        "scales": list(recipe.augmentation.scales),
        "rate": recipe.training.rate,
        "seed": recipe.training.seed,
        "threads": recipe.training.threads,
        "options": {name: dict(values) for name, values in options.items()},
    }


def _number(value: Any) -> Any:
    return math.nan if value is None else value


def _usual(name: str, scales: tuple[float, float]) -> Augmentation:
    if name == "harbour":
        return Augmentation(scales=scales)
    return _augmentation(name == _STUDIED, True, scales)


def _augmentation(own: bool, added: bool, scales: tuple[float, float]) -> Augmentation:
    return Augmentation(
        rotation=added,
        brightness=added,
        exposure=added,
        blur=added,
        noise=added,
        mosaic=own,
        flip=False,
        color=False,
        compression=False,
        paste=False,
        wash=False,
        scales=scales,
    )


def _options() -> DetectorOptions:
    return DetectorOptions(provider="cpu", threshold=_LOWEST)


def _frame_ms(scene: Scene, name: str, detector: OnnxDetector) -> float:
    """Median time of the first frames of a recording, one at a time, the pictures being there."""
    (recording,) = (one for one in scene.recordings if one.name == name)
    assert recording.source is not None
    detector.reset()
    took = []
    for count, frame in enumerate(frames(recording.source)):
        if count > _TIMED_FRAMES:
            break
        begun = time.perf_counter()
        detector.detect(frame)
        # The first plans where to look, which is done once.
        if count:
            took.append(time.perf_counter() - begun)
    return 1e3 * statistics.median(took) if took else math.nan


def _silent(_what: str, _share: float) -> None:
    return
