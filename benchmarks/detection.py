"""How fast detectors are on two cores, how much of a frame they look at, and what they find.

    python benchmarks/detection.py [--detector NAME|FILE.onnx ...] [--seconds 10] [--json FILE]

Speed: a simulated harbour of 1280 x 720 px as an mp4. *Decoding* reads all frames and does nothing
with them; *detector alone* looks at frames that lie in memory; *end to end* is what `detect` does,
from the mp4 to a table of boxes. The *rest* is the time that neither of the first two takes; below
zero where decoding goes on while the detector works.

Recall: `FastestDet.onnx`, a general detector of COCO, on the frames of "AI Tracks at Sea" with a
drawn box, on whole frames scaled to its 352 px, on tiles of the strip around the horizon, and on
tiles of all of the frame; with its boxes of boats, of the usual confidence. Left out where there is
no real data.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from sightline import formats, video
from sightline.detection import (
    DETECTORS,
    VIEWS,
    Detector,
    DetectorOptions,
    OnnxDetector,
    TilingSettings,
    detect,
    detector_by_name,
)
from sightline.detection.onnx import DEFAULT_THRESHOLD
from sightline.errors import InputError
from sightline.evaluation.detection import pooled, score_detections
from sightline.scene import Scene
from sightline.scene.labelled_frames import detect_labelled, scene_labels
from sightline.simulation import Harbour, HarbourSettings, Renderer
from sightline.types import Frame
from sightline.video import write_video

DATA = Path(os.environ.get("SIGHTLINE_DATA", Path(__file__).parents[2] / "shared" / "data"))
WEIGHTS = DATA / "weights" / "FastestDet.onnx"
FRAME_PX = (1280, 720)
RATE_HZ = 25.0
RUNS = 3
LEAST_CONFIDENCE = 0.01


def pictures(seconds: float) -> Iterator[Frame]:
    """A harbour of which two seconds are painted and shown again and again."""
    harbour = Harbour.random(3, HarbourSettings(duration_s=10.0))
    renderer = Renderer(harbour)
    painted = [renderer.image(harbour.start_utc_s + i / RATE_HZ) for i in range(int(2 * RATE_HZ))]
    for index in range(int(seconds * RATE_HZ)):
        yield Frame(index, harbour.start_utc_s + index / RATE_HZ, painted[index % len(painted)])


def rate_hz(frames: int, work: Iterator[float]) -> float:
    """Frames a second: the median of some runs."""
    return frames / statistics.median(work)


def decoding(path: Path) -> float:
    """Seconds that reading takes."""
    began = time.perf_counter()
    for _ in video.frames(path):
        pass
    return time.perf_counter() - began


def detecting(frames: list[Frame], detector: Detector) -> float:
    """Seconds that finding takes, with frames that lie in memory."""
    detector.reset()
    began = time.perf_counter()
    for frame in frames:
        detector.detect(frame)
    return time.perf_counter() - began


def end_to_end(path: Path, detector: Detector, table: Path) -> float:
    """Seconds from the file of the video to the table of boxes."""
    detector.reset()
    began = time.perf_counter()
    with formats.box_writer(table) as writer:
        for boxes in detect(video.frames(path), detector):
            writer.add(boxes)
    return time.perf_counter() - began


def searched_share(detector: Detector, frame: Frame) -> float:
    """Pixels that a detector looks at, by those of the frame; NaN where it has no views."""
    if not isinstance(detector, OnnxDetector):
        return float("nan")
    views = detector.views(frame)
    return sum(view.searched_px for view in views) / (FRAME_PX[0] * FRAME_PX[1])


def speeds(names: list[str], seconds: float, console: Console) -> dict[str, dict[str, float]]:
    """Rates of each detector that there is."""
    out: dict[str, dict[str, float]] = {}
    with TemporaryDirectory() as folder:
        path, table = Path(folder) / "harbour.mp4", Path(folder) / "boxes.csv"
        write_video(path, pictures(seconds))
        frames = [
            Frame(frame.index, frame.time_utc_s, frame.image_bgr)
            for frame, _ in zip(video.frames(path), range(int(4 * RATE_HZ)), strict=False)
        ]
        count = sum(1 for _ in video.frames(path))
        decode_hz = rate_hz(count, (decoding(path) for _ in range(RUNS)))
        for name in names:
            try:
                detector = detector_by_name(name)
            except InputError as error:
                console.print(f"{name}: left out, {error}", highlight=False)
                continue
            # The first frames find the horizon, and fill memory.
            detecting(frames[:10], detector)
            alone_hz = rate_hz(len(frames), (detecting(frames, detector) for _ in range(RUNS)))
            whole_hz = rate_hz(count, (end_to_end(path, detector, table) for _ in range(RUNS)))
            rest = 1.0 - whole_hz * (1.0 / decode_hz + 1.0 / alone_hz)
            out[Path(name).name] = {
                "decode_hz": decode_hz,
                "detector_hz": alone_hz,
                "end_to_end_hz": whole_hz,
                "rest_share": rest,
                "searched_share": searched_share(detector, frames[0]),
            }
    return out


def recalls() -> dict[str, dict[str, float]]:
    """What a general detector finds of the drawn boats, by the views that it looks at."""
    scene = Scene.load(DATA / "tracks-at-sea" / "scene.toml")
    known = scene_labels(scene)
    out: dict[str, dict[str, float]] = {}
    for kind in reversed(VIEWS):
        options = DetectorOptions(
            classes=("boat",), threshold=LEAST_CONFIDENCE, views=TilingSettings(kind=kind)
        )
        detector = OnnxDetector(WEIGHTS, options=options)
        began = time.perf_counter()
        frames = pooled(detect_labelled(scene, known, detector))
        taken_s = time.perf_counter() - began
        low, high = (
            score_detections(frames, least_iou=least, threshold=DEFAULT_THRESHOLD)
            for least in (0.3, 0.5)
        )
        blank = Frame(0, np.nan, np.zeros((*FRAME_PX[::-1], 3), np.uint8))
        if kind != "strip":
            share = searched_share(detector, blank)
        else:
            share = searched_share(detector, next(iter(scene["08"].frames())))
        out[kind] = {
            "boxes": low.drawn,
            "recall_30": low.recall,
            "recall_50": high.recall,
            "false_per_frame": low.false_per_frame,
            "recall_30_at_one_false": low.recall_at_allowed,
            "map_50": low.map_50,
            "foot_px": low.foot_px,
            "searched_share": share,
            "seconds_per_frame": taken_s / len(frames),
        }
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--detector", action="append", help="name or ONNX file; several times")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of the video")
    parser.add_argument("--json", type=Path, help="write the figures")
    chosen = parser.parse_args()
    console = Console(width=120)
    names = chosen.detector or [*DETECTORS, *([str(WEIGHTS)] if WEIGHTS.is_file() else [])]
    machine = f"{os.cpu_count()} cores, {platform.machine()}, {platform.system()}"
    speed = speeds(names, chosen.seconds, console)
    table = Table(title=f"frames a second at 1280 x 720 ({machine})", title_justify="left")
    for column in ("detector", "decoding", "detector alone", "end to end", "rest", "pixels"):
        table.add_column(column, justify="left" if column == "detector" else "right")
    for name, row in speed.items():
        share = row["searched_share"]
        table.add_row(
            name,
            f"{row['decode_hz']:.0f}",
            f"{row['detector_hz']:.1f}",
            f"{row['end_to_end_hz']:.1f}",
            f"{100 * row['rest_share']:.0f} %",
            f"{100 * share:.0f} %" if np.isfinite(share) else "–",
        )
    console.print(table)
    result: dict[str, object] = {"machine": machine, "opencv": cv2.__version__, "speed": speed}
    if WEIGHTS.is_file():
        found = recalls()
        result["recall"] = found
        table = Table(
            title="FastestDet on real frames: recall, and false boxes a frame", title_justify="left"
        )
        heads = ("IoU 0.3", "IoU 0.5", "false", "IoU 0.3 at 1 false", "lower edge", "pixels")
        for column in ("views", *heads):
            table.add_column(column, justify="left" if column == "views" else "right")
        for kind, row in found.items():
            table.add_row(
                kind,
                f"{row['recall_30']:.2f}",
                f"{row['recall_50']:.2f}",
                f"{row['false_per_frame']:.1f}",
                f"{row['recall_30_at_one_false']:.2f}",
                f"{row['foot_px']:+.1f} px",
                f"{100 * row['searched_share']:.0f} %",
            )
        console.print(table)
    if chosen.json:
        chosen.json.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
