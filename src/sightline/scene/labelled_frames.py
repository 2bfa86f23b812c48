"""Labelled frames of a scene, with the detections in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from sightline.detection import Detector, OnnxDetector
from sightline.errors import InputError
from sightline.evaluation.detection import JudgedFrame
from sightline.formats.labels import Labels, read_label_folder
from sightline.scene import Recording, Scene
from sightline.types import Boxes
from sightline.video.mask import Mask


def scene_labels(scene: Scene, labels: str | Path | None = None) -> dict[str, Labels]:
    """Labels of each recording that has frames.

    Args:
        scene: The scene.
        labels: A folder of tables; see `sightline.formats.labels`. Absent: the scene's own boxes,
            all of the target; where several people drew it in a frame, the mean of theirs.

    Raises:
        InputError: No recording has both pictures and labels.
    """
    out: dict[str, Labels] = {}
    for recording in scene.recordings:
        if recording.source is None:
            continue
        known = read_label_folder(labels, recording.name) if labels else _own_labels(recording)
        if known is not None:
            out[recording.name] = known
    if not out:
        what = f"labels in {labels}" if labels else "boxes"
        raise InputError(
            f"{scene.path}: no recording has both pictures and {what}, so no detector can be "
            "measured"
        )
    return out


def _own_labels(recording: Recording) -> Labels | None:
    if recording.boxes_path is None:
        return None
    boxes = recording.boxes()
    frames = np.unique(boxes.frame)
    mean = [boxes.xyxy_px[boxes.frame == frame].mean(axis=0) for frame in frames]
    of_target = Boxes.of(np.array(mean).reshape(-1, 4), frame=frames)
    return Labels(of_target, np.ones(len(frames), dtype=bool), np.empty(0, dtype=np.int64))


def detect_labelled(
    scene: Scene,
    known: Mapping[str, Labels],
    detector: Detector,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, list[JudgedFrame]]:
    """Detections in the labelled frames.

    Args:
        scene: The scene.
        known: By recording; see `scene_labels`.
        detector: It is shown all frames where it learns from those before.
        progress: Told how far it is.

    Returns:
        By recording, the frames that have a picture.
    """
    out: dict[str, list[JudgedFrame]] = {}
    for number, (name, labels) in enumerate(known.items()):
        if progress:
            progress(f"recording {name}", number / len(known))
        detector.reset()
        wanted = set(labels.frames.tolist())
        mask = scene[name].mask()
        alone = isinstance(detector, OnnxDetector) and not detector.remembers
        judged = []
        for frame in scene[name].frames():
            if frame.index in wanted or not alone:
                boxes = detector.detect(frame)
                if frame.index in wanted:
                    judged.append(_judged(name, frame.index, labels, boxes, mask))
        if judged:
            out[name] = judged
    return out


def _judged(
    recording: str, index: int, labels: Labels, boxes: Boxes, mask: Mask | None
) -> JudgedFrame:
    own = labels.boxes.frame == index
    target = labels.target[own]
    if mask is not None:
        # What nobody may look at is neither missed nor found.
        target = target & ~mask.hides(labels.boxes[own])
        boxes = boxes[~mask.hides(boxes)]
    return JudgedFrame(
        name=f"{recording}/{index}",
        truth_xyxy_px=labels.boxes.xyxy_px[own],
        ignored=~target,
        found_xyxy_px=boxes.xyxy_px,
        confidence=boxes.confidence,
    )
