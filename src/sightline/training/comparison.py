"""Detectors beside each other, as in the paper: its Table 1 and its Figure 2."""

from __future__ import annotations

import math
import os
import platform
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import onnxruntime
import torch
from matplotlib.figure import Figure

from sightline.detection.onnx import DetectorOptions, OnnxDetector
from sightline.errors import InputError, unknown_name
from sightline.evaluation.detection import (
    DetectionReport,
    detect_labelled,
    pooled,
    scene_labels,
    score_detections,
)
from sightline.scene import Scene
from sightline.training.architecture import ARCHITECTURES
from sightline.training.augmentation import Augmentation
from sightline.training.loop import find_device, versions
from sightline.training.recipe import Recipe, TrainedDetector, train_detector
from sightline.video import frames

Tell = Callable[[str, float], None]

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
    """

    rows: tuple[ComparedDetector, ...]
    histories: Mapping[str, Sequence[Mapping[str, float]]]
    hardware: Mapping[str, Any]
    split: Mapping[str, Sequence[str]]
    settings: Mapping[str, Any]

    def to_dict(self) -> dict[str, Any]:
        """All of it as JSON has it."""
        return {
            "detectors": {row.name: row.to_dict() for row in self.rows},
            "augmentation": {
                name: [dict(row) for row in history] for name, history in self.histories.items()
            },
            "hardware": dict(self.hardware),
            "split": {part: list(names) for part, names in self.split.items()},
            "settings": dict(self.settings),
        }


def compare_detectors(
    scene: Scene,
    recipe: Recipe,
    test: Sequence[str],
    folder: Path,
    *,
    architectures: Sequence[str] = ARCHITECTURES,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    labels: Path | None = None,
    augmentations: bool = True,
    progress: Tell | None = None,
) -> DetectorComparison:
    """Train detectors alike, and measure them on recordings that none has seen.

    Every detector learns with the paper's five augmentations, YOLOv4 with its own (mosaic) besides,
    as in the paper's Table 1; ``harbour`` with all that it was made with. A folder in which some
    are trained already is gone on with.

    Args:
        scene: Camera and recordings.
        recipe: What all have in common; its architecture, augmentation and options are replaced.
        test: Names of the recordings to measure on.
        folder: Where each training gets a folder.
        architectures: Which.
        options: Of each architecture.
        labels: A folder with drawn boxes for the test; absent: the scene's own.
        augmentations: Whether YOLOv4 is also trained without either augmentation and without
            both, as in Figure 2. For that the recipe must have validation recordings.
        progress: Told what is done, and the share.

    Raises:
        InputError: A name is unknown, a recording is in two parts of the split, or something is
            missing that a training needs.
    """
    tell = progress if progress is not None else _silent
    for name in architectures:
        if name not in ARCHITECTURES:
            raise unknown_name("architecture", name, ARCHITECTURES)
    for name in test:
        if name in (*recipe.train, *recipe.validation):
            raise InputError(
                f"recording {name!r} is both learned from and tested on; a recording can be in one "
                "part only"
            )
    if augmentations and not recipe.validation:
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
    given = dict(options or {})
    studied = list(VARIANTS) if augmentations else []
    jobs = len(architectures) + len(studied)
    done = 0

    def learn(name: str, augmentation: Augmentation, where: str) -> TrainedDetector:
        nonlocal done
        own = replace(
            recipe, architecture=name, augmentation=augmentation, options=given.get(name, {})
        )
        share = done / jobs
        made = train_detector(
            scene,
            own,
            folder / where,
            progress=lambda what, part: tell(
                f"{where}: {what}", share + (part / jobs if math.isfinite(part) else 0.0)
            ),
        )
        done += 1
        return made

    rows = []
    scales = recipe.augmentation.scales
    for name in architectures:
        made = learn(name, _usual(name, scales), name)
        tell(f"{name}: measuring", done / jobs)
        detector = OnnxDetector(made.path, options=_options())
        report = score_detections(pooled(detect_labelled(scene, known, detector)))
        rows.append(
            ComparedDetector(
                name=name,
                parameters=made.parameters,
                file_bytes=made.path.stat().st_size,
                training_s=made.training.learned_s,
                steps=made.training.steps,
                frame_ms=_frame_ms(scene, test[0], detector),
                report=report,
            )
        )
    histories: dict[str, Sequence[Mapping[str, float]]] = {}
    for variant in studied:
        augmentation = _augmentation(*VARIANTS[variant], scales)
        # The first is the one of the table, and is not trained again.
        where = _STUDIED if variant == "YOLO + added" else f"{_STUDIED}-{variant.replace(' ', '-')}"
        histories[variant] = learn(_STUDIED, augmentation, where).training.history
    return DetectorComparison(
        rows=tuple(rows),
        histories=histories,
        hardware=hardware(recipe.training.device),
        split={"train": recipe.train, "validation": recipe.validation, "test": tuple(test)},
        settings={
            "steps": recipe.training.steps,
            "minutes": recipe.training.minutes,
            "batch": recipe.batch,
            "size_px": list(recipe.size_px),
            "scales": list(scales),
            "rate": recipe.training.rate,
            "seed": recipe.training.seed,
            "threads": recipe.training.threads,
            "options": {name: dict(values) for name, values in given.items()},
        },
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
        "onnxruntime": onnxruntime.__version__,
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
    for number, frame in enumerate(frames(recording.source)):
        if number > _TIMED_FRAMES:
            break
        begun = time.perf_counter()
        detector.detect(frame)
        # The first plans where to look, which is done once.
        if number:
            took.append(time.perf_counter() - begun)
    return 1e3 * statistics.median(took) if took else math.nan


def _silent(_what: str, _share: float) -> None:
    return
