"""Detectors by one measure, on recordings that none of them learned from: rows of ``table.json``.

    python benchmarks/detectors/measure.py harbour
    python benchmarks/detectors/measure.py FastestDet=../shared/data/weights/FastestDet.onnx \
        --classes boat --views whole
    python benchmarks/detectors/measure.py --comparison DIR

Rows of detectors that are named are measured anew, the others stay. With ``--comparison`` the
detectors are those that ``sightline detector compare -o DIR`` trained, and their rows tell of the
training as well. The time of a frame is the processor's, with one thread, so that other programs do
not count; at a least confidence of 0.001, which average precision asks for. With the threshold that
a detector is used with there are fewer boxes to choose from, and a frame takes less.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sightline.atomic import atomic_path
from sightline.detection import DetectorOptions, OnnxDetector, TilingSettings, detector_by_name
from sightline.evaluation.detection import pooled, score_detections
from sightline.formats.labels import Margin
from sightline.scene import Scene
from sightline.scene.labelled_frames import detect_labelled, scene_labels
from sightline.types import Boxes, Frame

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("SIGHTLINE_DATA", HERE.parents[1] / ".." / "shared" / "data"))
DRAWN = HERE.parent / "tracks-at-sea"
TABLE = HERE / "table.json"
TEST = ("08", "13", "17", "21")

HABITS: dict[str, tuple[dict[str, Margin], float]] = {
    "drawn": ({}, 0.0),
    "margin": ({"sightline": Margin(2.5, 0.16)}, 6.0),
}
"""The boxes as they were drawn, all of them; and with the margin that ``harbour`` was taught,
without those less than 6 px high, which are neither to be found nor wrong to find."""


class Timed:
    """A detector, noting what it finds and what that takes."""

    def __init__(self, detector: OnnxDetector) -> None:
        self._detector = detector
        self.found: list[Boxes] = []
        self.took_s: list[float] = []

    def reset(self) -> None:
        """See `Detector`."""
        self._detector.reset()

    def detect(self, frame: Frame) -> Boxes:
        """See `Detector`."""
        begun = time.process_time()
        self.found.append(self._detector.detect(frame))
        self.took_s.append(time.process_time() - begun)
        return self.found[-1]


class Replayed:
    """What was found in the same frames before."""

    def __init__(self, found: list[Boxes]) -> None:
        self._next: Iterator[Boxes] = iter(found)

    def reset(self) -> None:
        """See `Detector`."""

    def detect(self, _frame: Frame) -> Boxes:
        """See `Detector`."""
        return next(self._next)


def detector_of(file: str, classes: str = "", views: str = "") -> Timed:
    """A detector on one thread, saying whatever it takes for a boat."""
    options = DetectorOptions(
        provider="cpu",
        threshold=0.001,
        classes=tuple(classes.split(",")) if classes else None,
        views=TilingSettings(kind=views) if views else None,
        threads=1,
    )
    detector = detector_by_name(file, options=options)
    assert isinstance(detector, OnnxDetector)
    return Timed(detector)


def test_scene() -> Scene:
    """The recordings to measure on."""
    return Scene.load(DATA / "tracks-at-sea" / "scene.toml").select(TEST)


def frame_cpu_ms(timed: Timed) -> float:
    """Median time of a frame; the first frames of a recording are also searched for a horizon."""
    return round(1e3 * statistics.median(timed.took_s), 1)


def measure(timed: Timed) -> dict[str, Any]:
    """How well and how fast a detector finds the boat with the log."""
    scene = test_scene()
    drawn = scene_labels(scene, DRAWN)
    detect_labelled(scene, drawn, timed)
    row: dict[str, Any] = {"frame_cpu_ms": frame_cpu_ms(timed)}
    for bias, (margins, least_height_px) in HABITS.items():
        known = {
            name: one.without_specks(least_height_px).widened(margins)
            for name, one in drawn.items()
        }
        report = score_detections(pooled(detect_labelled(scene, known, Replayed(timed.found))))
        row[bias] = chosen(report.to_dict())
    return row


def chosen(report: dict[str, Any]) -> dict[str, Any]:
    """What the table tells of a report."""
    return {
        "boxes": report["drawn"],
        "frames": report["frames"],
        "map_50": round(report["map_50"], 4),
        "map_50_95": round(report["map_50_95"], 4),
        "recall_30": round(report["recall_at_allowed"], 4),
    }


def trained(folder: Path) -> dict[str, tuple[str, dict[str, Any]]]:
    """The files of a comparison, and what is known of their training."""
    content = json.loads((folder / "comparison.json").read_text())
    found = {}
    for name, row in content["detectors"].items():
        about = {
            "parameters": row["parameters"],
            "file_bytes": row["file_bytes"],
            "training_min": round(row["training_s"] / 60.0, 1),
            "batches": row["steps"],
            "settings": content["settings"],
            "hardware": content["hardware"],
            "split": content["split"],
        }
        cfg = content["settings"]["options"].get(name, {}).get("cfg", name)
        found[cfg] = (str(folder / name / f"{name}.onnx"), about)
    return found


def main() -> None:
    """Measure, keep, and print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("detectors", nargs="*", metavar="harbour|NAME=FILE.onnx")
    parser.add_argument("--comparison", type=Path, action="append", default=[], metavar="DIR")
    parser.add_argument("--classes", default="")
    parser.add_argument("--views", default="")
    given = parser.parse_args()
    jobs: dict[str, tuple[str, dict[str, Any]]] = {}
    for text in given.detectors:
        name, _, file = text.partition("=")
        jobs[name + (f", {given.views}" if given.views else "")] = (file or name, {})
    for folder in given.comparison:
        jobs |= trained(folder)
    table = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    for name, (file, about) in jobs.items():
        measured = measure(detector_of(file, given.classes, given.views))
        # Of another training nothing may stay.
        table[name] = (about or table.get(name, {})) | measured
        with atomic_path(TABLE) as temporary:
            temporary.write_text(json.dumps(table, indent=1) + "\n")
    print("| detector | parameters | training | batches | a frame | mAP @ 0.5 | .5:.95 | recall |")
    print("|---|---|---|---|---|---|---|---|")
    for name, row in table.items():
        parts = [
            name,
            f"{row['parameters'] / 1e6:.1f} M" if "parameters" in row else "",
            f"{row['training_min']:.1f} min" if "training_min" in row else "",
            str(row.get("batches", "")),
            f"{row['frame_cpu_ms']:.0f} ms",
            *(
                " / ".join(f"{row[bias][key]:.2f}" for bias in HABITS if bias in row)
                for key in ("map_50", "map_50_95", "recall_30")
            ),
        ]
        print("| " + " | ".join(parts) + " |")


if __name__ == "__main__":
    main()
