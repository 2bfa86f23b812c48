"""How well eight vessels are told apart, beside ByteTrack and SORT on the same boxes, and how fast.

    pip install --no-deps trackers==2.6.1 supervision pydeprecate defusedxml pyyaml requests tqdm
    pip install --no-deps trackeval==1.3.0 tabulate          # checks the figures, if it is there
    python benchmarks/tracking.py [--seeds 10] [--first-seed 0]

The world is `harbour_crowd`. The other trackers are those of the package `trackers`, told the
times of the frames, with their own settings and with ones that suit the scene (targets are kept
for four seconds, boxes may overlap less). `trackers` and `trackeval` want another build of OpenCV
than ours, which works as well: hence ``--no-deps``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from _support.tracking import score_tracking
from harbour_crowd import RATE_HZ, Crowd, crowd, learned

from sightline.geodesy import LocalPlane
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.overlap import iou
from sightline.tracking import ImageTracker, Tracker, WorldTracker
from sightline.types import Boxes, Positions

COLUMNS = ("hota", "deta", "assa", "idf1", "tracks")


def ours(tracker: Tracker, scene: Crowd) -> Boxes:
    frames = range(scene.time_utc_s.size)
    detections = scene.detections
    return Boxes.concatenate([tracker.update(detections[detections.frame == i]) for i in frames])


def theirs(make: Callable[[], Any], scene: Crowd) -> Boxes:
    import supervision

    tracker, out = make(), []
    detections = scene.detections
    for frame, time_s in enumerate((scene.time_utc_s - scene.time_utc_s[0]).tolist()):
        rows = np.flatnonzero(detections.frame == frame)
        given = supervision.Detections(
            xyxy=detections.xyxy_px[rows].astype(np.float32),
            confidence=detections.confidence[rows],
            class_id=np.zeros(rows.size, dtype=int),
            data={"row": rows},
        )
        found = tracker.update(
            given if rows.size else supervision.Detections.empty(), timestamp=time_s
        )
        if len(found):
            out.append(detections[found.data["row"]].with_columns(track_id=found.tracker_id))
    boxes = Boxes.concatenate(out)
    return boxes[boxes.track_id >= 0]


def others() -> dict[str, Callable[[], Any]]:
    try:
        import trackers
    except ImportError:
        print("the package trackers is not installed, so there is nothing to stand beside")
        return {}
    kept = {"frame_rate": RATE_HZ, "lost_track_buffer": 120}
    return {
        "SORT": lambda: trackers.SORTTracker(frame_rate=RATE_HZ),
        "SORT, 4 s": lambda: trackers.SORTTracker(**kept, minimum_iou_threshold=0.1),
        "ByteTrack": lambda: trackers.ByteTrackTracker(frame_rate=RATE_HZ),
        "ByteTrack, 4 s": lambda: trackers.ByteTrackTracker(**kept),
    }


def check(truth: Boxes, found: Boxes) -> float | None:
    """Largest difference from TrackEval's HOTA, DetA, AssA and IDF1; None without the package."""
    try:
        from trackeval.metrics import HOTA, Identity
    except ImportError:
        return None
    frames = np.unique(np.concatenate([truth.frame, found.frame]))
    sets = []
    for boxes in (truth, found):
        names, rank = np.unique(boxes.track_id, return_inverse=True)
        sets.append((names.size, [np.flatnonzero(boxes.frame == f) for f in frames], rank))
    (targets, own, true_rank), (tracks, their, found_rank) = sets
    data = {
        "num_gt_dets": len(truth),
        "num_tracker_dets": len(found),
        "num_gt_ids": targets,
        "num_tracker_ids": tracks,
        "gt_ids": [true_rank[rows] for rows in own],
        "tracker_ids": [found_rank[rows] for rows in their],
        "similarity_scores": [
            iou(truth.xyxy_px[a, None], found.xyxy_px[b]) for a, b in zip(own, their, strict=True)
        ],
        "num_timesteps": frames.size,
    }
    hota = HOTA().eval_sequence(data)
    identity = Identity({"PRINT_CONFIG": False}).eval_sequence(data)
    score = score_tracking(truth, found)
    return max(
        abs(float(np.mean(hota["HOTA"])) - score.hota),
        abs(float(np.mean(hota["DetA"])) - score.deta),
        abs(float(np.mean(hota["AssA"])) - score.assa),
        abs(float(identity["IDF1"]) - score.idf1),
    )


def locate(model: Georeferencer, boxes: Boxes) -> Positions:
    return model.locate(boxes.xyxy_px, boxes.source)


def quality(seeds: range) -> None:
    beside = others()
    rows: dict[str, list[list[float]]] = {}
    worst: float | None = None
    for seed in seeds:
        scene = crowd(seed)
        model = learned(scene, seed)
        found = {name: theirs(make, scene) for name, make in beside.items()}
        found["sightline, image"] = ours(ImageTracker(), scene)
        found["sightline, world"] = ours(WorldTracker(partial(locate, model)), scene)
        for name, boxes in found.items():
            score = score_tracking(scene.truth, boxes)
            rows.setdefault(name, []).append([float(getattr(score, c)) for c in COLUMNS])
        off = check(scene.truth, found["sightline, world"])
        worst = off if worst is None or off is None else max(worst, off)
    print(f"mean over {len(seeds)} harbours of eight vessels, seeds {seeds[0]} to {seeds[-1]}")
    print(f"{'':20s}" + "".join(f"{c:>9s}" for c in COLUMNS) + "   least HOTA   won in")
    world = np.array(rows["sightline, world"])
    for name, values in rows.items():
        table = np.array(values)
        won = int(((world[:, [0, 3]] > table[:, [0, 3]]).all(axis=1)).sum())
        line = f"{name:20s}" + "".join(f"{v:9.3f}" for v in table.mean(axis=0))
        against = "" if name == "sightline, world" else f"{won:6d} of {len(seeds)}"
        print(line + f"{table[:, 0].min():13.3f}{against}")
    print("won in: harbours in which the world plane has the higher HOTA and IDF1")
    if worst is not None:
        print(f"largest difference from TrackEval's figures: {worst:.1e}")


def _flat_sea(seen: Boxes) -> Positions:
    """A level camera at 30 m with a focal length of 1500 px, horizon at row 300."""
    boxes = seen.xyxy_px
    down = np.maximum(boxes[:, 3] - 300.0, 1.0)
    north = 30.0 * 1500.0 / down
    east = north * (0.5 * (boxes[:, 0] + boxes[:, 2]) - 1920.0) / 1500.0
    covariance = np.zeros((len(boxes), 2, 2))
    covariance[:, 1, 1] = (north / down) ** 2
    covariance[:, 0, 0] = (north / 1500.0) ** 2 + (east / down) ** 2
    covariance[:, 0, 1] = covariance[:, 1, 0] = east * north / down**2
    plane = LocalPlane(54.0, 10.0)
    return Positions(east, north, covariance, np.zeros(len(boxes), dtype=bool), plane)


def speed(targets: int = 300, frames: int = 300) -> None:
    rng = np.random.default_rng(0)
    centre = np.column_stack([rng.uniform(100, 3740, targets), rng.uniform(420, 2060, targets)])
    size = np.column_stack([rng.uniform(30, 70, targets), rng.uniform(20, 40, targets)])
    velocity = rng.normal(0.0, 8.0, (targets, 2))
    moments = []
    for i in range(frames):
        at = centre + 0.1 * i * velocity + rng.normal(0.0, 1.0, centre.shape)
        xyxy = np.hstack([at - size / 2, at + size / 2])
        moments.append(Boxes.of(xyxy, time_utc_s=0.1 * i, frame=i))
    for name, tracker in (
        ("image", ImageTracker()),
        ("world", WorldTracker(_flat_sea)),
    ):
        begin = time.process_time()
        for boxes in moments:
            tracker.update(boxes)
        taken = time.process_time() - begin
        print(
            f"{targets} targets a frame, {name}: {frames / taken:.0f} frames a second of one core"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    chosen = parser.parse_args()
    speed()
    quality(range(chosen.first_seed, chosen.first_seed + chosen.seeds))


if __name__ == "__main__":
    main()
