"""Whether boxes proposed from the log help a detector: trainings with and without them.

    python benchmarks/detectors/labels.py -o DIR [--arms hand,same --seeds 0,1]

What it came to stands in ``LABELS.md``.

The same network from random weights, the same number of batches; only the boxes differ. Trainings
that the folder has results of are not done again. Needs the extra ``train``; results are kept in
``DIR/results.json`` and printed.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measure import DATA, DRAWN, TEST

from sightline import fit
from sightline.atomic import atomic_path
from sightline.detection import DetectorOptions, OnnxDetector
from sightline.evaluation.detection import JudgedFrame, pooled, score_detections
from sightline.formats.labels import Labels as Known
from sightline.formats.labels import Margin, read_label_folder, write_labels
from sightline.labelling import learn_size, propose
from sightline.overlap import iou
from sightline.scene import Scene
from sightline.scene.labelled_frames import detect_labelled, scene_labels
from sightline.training.data import Labels
from sightline.training.loop import TrainingSettings
from sightline.training.recipe import Recipe, train_detector
from sightline.types import Boxes

TRAIN = ("06", "07", "09", "15", "18")
MORE = ("10", "11")
"""Recordings with a log, and two frames with a box that somebody drew."""
FEW = "07"
"""The recording whose boxes are all there are in the arms ``few``."""

SURE = 0.5
LEAST_HEIGHT_PX = 6.0
MARGINS = {
    # The proposed boxes are as tight as those drawn by eye, so they have the same margin.
    "log": Margin(2.5, 0.16),
    "sightline": Margin(2.5, 0.16),
    "truth": Margin(2.5, 0.16),
    "voc": Margin(-2.0),
    "manual": Margin(1.0),
}
ARMS = {
    "hand": "drawn by hand",
    "same": "and proposed in their other frames",
    "same-sure": f"and proposed in their other frames, confidence {SURE:g} or more",
    "more-sure": f"and proposed in {' and '.join(MORE)} as well, confidence {SURE:g} or more",
    "few": f"drawn by hand in {FEW} alone",
    "few-sure": f"and proposed from those in 07, 09, 15, 10 and 11, confidence {SURE:g} or more",
}
TABLES = {"same": "same", "same-sure": "sure", "more-sure": "sure", "few-sure": "few-sure"}


def proposed(scene: Scene, folder: Path) -> dict[str, dict[str, tuple[int, int]]]:
    """Tables of proposed boxes, in the folders ``same``, ``sure`` and ``few-sure``.

    Returns:
        How many there are by folder and recording, and how many of them are right.
    """
    counts: dict[str, dict[str, tuple[int, int]]] = {}
    few = _drawn_in_few_alone(scene)
    for known, kinds in (
        (scene.without(TEST), {"same": 0.0, "sure": SURE}),
        (few.without(TEST), {"few-sure": SURE}),
    ):
        model = fit(known, "camera")
        size = learn_size(known, model)
        for name in (*TRAIN, *MORE):
            recording = known[name]
            boxes = propose(recording, model, size).boxes()
            drawn = recording.boxes().frame if recording.boxes_path is not None else np.empty(0)
            for kind, least in kinds.items():
                rows = ~np.isin(boxes.frame, drawn) & (boxes.confidence >= least)
                counts.setdefault(kind, {})[name] = int(rows.sum()), _right(boxes[rows], name)
                if rows.any():
                    (folder / kind).mkdir(parents=True, exist_ok=True)
                    write_labels(Known.of_target(boxes[rows]), folder / kind / f"{name}.csv")
    return counts


def _right(boxes: Boxes, name: str) -> int:
    """How many overlap the box drawn by eye in their frame by a half, both with their margin."""
    drawn = read_label_folder(DRAWN, name)
    assert drawn is not None
    right = 0
    for frame, box in zip(boxes.frame, boxes.xyxy_px, strict=True):
        truth = drawn.boxes.xyxy_px[drawn.target & (drawn.boxes.frame == frame)]
        overlap = iou(MARGINS["log"].widened(box), MARGINS["sightline"].widened(truth))
        right += bool((overlap >= 0.5).any())
    return right


def _drawn_in_few_alone(scene: Scene) -> Scene:
    recordings = (r if r.name == FEW else replace(r, boxes_path=None) for r in scene.recordings)
    return replace(scene, recordings=tuple(recordings))


def trained(scene: Scene, arm: str, seed: int, steps: int, proposals: Path, folder: Path) -> Any:
    """Train an arm."""
    table = TABLES.get(arm)
    if arm.startswith("few"):
        scene = _drawn_in_few_alone(scene)
    recipe = Recipe(
        architecture="harbour",
        train=(*TRAIN, *MORE) if arm in ("more-sure", "few-sure") else TRAIN,
        labels=Labels(folders=(proposals / table,) if table else (), margins=MARGINS),
        synthetic=48,
        training=TrainingSettings(
            steps=steps, validate_every=steps, seed=seed, threads=1, precision="bfloat16"
        ),
    )
    return train_detector(scene, recipe, folder)


def judged(scene: Scene, path: Path) -> dict[str, Any]:
    """Average precision and recall by the boxes drawn by eye, and by the annotator ``voc``."""
    options = DetectorOptions(provider="cpu", threshold=0.005, threads=1, classes=("boat",))
    test = scene.select(TEST)
    drawn = {
        name: one.without_specks(LEAST_HEIGHT_PX).widened(MARGINS)
        for name, one in scene_labels(test, DRAWN).items()
    }
    each = detect_labelled(test, drawn, OnnxDetector(path, options=options))
    by_voc = [
        _with_truth(frame, box)
        for name, frames in each.items()
        for frame in frames
        if (box := _voc_box(test[name].boxes(), int(frame.name.split("/")[1]))) is not None
    ]
    result: dict[str, Any] = {}
    for what, frames in (("eye", pooled(each)), ("voc", by_voc)):
        report = score_detections(frames)
        result[what] = {
            "boxes": report.drawn,
            "map_50": report.map_50,
            "map_50_95": report.map_50_95,
            "recall_30": report.recall_at_allowed,
        }
    return result


def _voc_box(boxes: Boxes, frame: int) -> np.ndarray | None:
    rows = np.flatnonzero((boxes.frame == frame) & (boxes.source == "voc"))
    if not rows.size:
        return None
    corners = boxes.xyxy_px[rows]
    return MARGINS["voc"].widened(corners[(corners[:, 2:] - corners[:, :2]).prod(axis=1).argmax()])


def _with_truth(frame: JudgedFrame, box: np.ndarray) -> JudgedFrame:
    """The frame with this box of the logged boat instead of the one drawn by eye."""
    others = frame.truth_xyxy_px[frame.ignored]
    return replace(
        frame,
        truth_xyxy_px=np.concatenate([box[None], others]),
        ignored=np.r_[False, np.ones(len(others), dtype=bool)],
    )


def main() -> None:
    """Train what is not trained yet, measure, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--arms", default=",".join(ARMS))
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument("--steps", type=int, default=700)
    given = parser.parse_args()
    scene = Scene.load(DATA / "tracks-at-sea" / "scene.toml")
    path = given.output / "results.json"
    results = json.loads(path.read_text()) if path.exists() else {"steps": given.steps, "arms": {}}
    if "proposed" not in results:
        results["proposed"] = proposed(scene, given.output / "proposals")
        print(json.dumps(results["proposed"]), flush=True)
    for seed in given.seeds.split(","):
        for arm in filter(None, given.arms.split(",")):
            rows = results["arms"].setdefault(arm, {})
            if seed in rows:
                continue
            folder = given.output / f"{arm}-{seed}"
            made = trained(
                scene, arm, int(seed), results["steps"], given.output / "proposals", folder
            )
            data = made.data["train"]
            real = {name: one for name, one in data.items() if name != "synthetic"}
            rows[seed] = {
                "pictures": sum(one["pictures"] for one in real.values()),
                "boxes": sum(one["boxes"] for one in real.values()),
                "minutes": made.training.learned_s / 60.0,
                **judged(scene, made.path),
            }
            with atomic_path(path) as temporary:
                temporary.write_text(json.dumps(results, indent=1) + "\n")
            print(arm, seed, json.dumps(rows[seed]), flush=True)
    print(
        "| boxes of the training | frames | seeds | by eye: mAP @ 0.5 | .5:.95 | recall "
        "| voc: mAP @ 0.5 | .5:.95 | recall |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for arm, rows in results["arms"].items():
        if not rows:
            continue
        parts = [
            ARMS[arm],
            str(next(iter(rows.values()))["pictures"]),
            str(len(rows)),
            *(
                _spread(row[what][key] for row in rows.values())
                for what in ("eye", "voc")
                for key in ("map_50", "map_50_95", "recall_30")
            ),
        ]
        print("| " + " | ".join(parts) + " |")


def _spread(values: Iterable[float]) -> str:
    """The mean, and the least and the largest."""
    known = list(values)
    return f"{statistics.mean(known):.2f} ({min(known):.2f} to {max(known):.2f})"


if __name__ == "__main__":
    main()
