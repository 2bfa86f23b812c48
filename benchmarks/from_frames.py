"""From frames and a log alone: the boat's position in recordings that nothing has seen.

    python benchmarks/from_frames.py [SCENE [MAP.png]]

No drawn box is used. Each recording is searched by a detector that was not trained on it: the
shipped one, or for the recordings that it learned from `detectors/fold2.onnx`, which learned from
others. The camera is learned from the logged boat that is recognised in the other recordings,
and places what is tracked in this one. It is scored in those frames in which somebody drew the boat
and the log has a fix: how many of them have a position, and how far it is from the log.
"""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from _recordings import challenge_scene

from sightline.association.teach import fit_scene
from sightline.detection import SceneDetections
from sightline.errors import FitError
from sightline.evaluation.plots import MapPanel, map_figure, save_figure
from sightline.evaluation.report import pair_target
from sightline.pipeline.tracking import TrackSettings
from sightline.pipeline.whole import track_recording
from sightline.scene import Recording, Scene
from sightline.synchronisation import synchronise
from sightline.types import Boxes, FloatArray

SHIPPED_LEARNED_FROM = ("06", "07", "09", "15", "18", "10", "11", "19")
FOLD2 = Path(__file__).parent / "detectors" / "fold2.onnx"
FOLD2_LEARNED_FROM = ("08", "13", "17", "21", "10", "11", "19", "20")


class OutOfFold(SceneDetections):
    """What is found in each recording by a detector that did not learn from it."""

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self._other = SceneDetections(scene, str(FOLD2))

    def boxes(self, recording: Recording) -> Boxes:
        """See `SceneDetections`."""
        if recording.name in SHIPPED_LEARNED_FROM:
            return self._other.boxes(recording)
        return super().boxes(recording)

    def times_utc_s(self, recording: Recording) -> FloatArray:
        """See `SceneDetections`."""
        if recording.name in SHIPPED_LEARNED_FROM:
            return self._other.times_utc_s(recording)
        return super().times_utc_s(recording)


def main() -> None:
    drawn = Scene.load(challenge_scene(*sys.argv[1:2]))
    bare = replace(
        drawn,
        recordings=tuple(
            replace(one, boxes_path=None, detections_path=None) for one in drawn.recordings
        ),
    )
    seen = OutOfFold(bare)
    errors: list[float] = []
    panels: list[MapPanel] = []
    asked = 0
    print("recording  frames  placed  RMSE m  fit s")
    for recording in drawn.recordings:
        if recording.boxes_path is None or recording.source is None:
            continue
        if recording.name in SHIPPED_LEARNED_FROM and recording.name in FOLD2_LEARNED_FROM:
            continue
        boxes, fixes = recording.boxes(), recording.fixes()
        pictures = {frame.index for frame in recording.frames()}
        frames = np.array(sorted(set(boxes.frame.tolist()) & pictures))
        times = recording.clock().time_utc_s(frames)
        assert drawn.plane is not None, "the challenge tells where its camera stands"
        times = times[synchronise(fixes, times, drawn.plane).matched]
        if not times.size:
            continue
        asked += times.size
        began = time.perf_counter()
        try:
            model = fit_scene(bare.without([recording.name]), seen=seen)
        except FitError as error:
            print(f"{recording.name:9s}{times.size:8d}       0   {error}")
            continue
        took_s = time.perf_counter() - began
        tracks = track_recording(bare[recording.name], model, seen, TrackSettings())
        pairs, _ = pair_target(tracks, fixes)
        panels.append(MapPanel(f"recording {recording.name}", pairs, smooth=True))
        own = [
            float(pairs.error_m[np.argmin(np.abs(pairs.time_utc_s - when))])
            for when in times
            if np.abs(pairs.time_utc_s - when).min(initial=np.inf) < 0.05
        ]
        errors += own
        rmse = np.sqrt(np.mean(np.square(own))) if own else np.nan
        print(f"{recording.name:9s}{times.size:8d}{len(own):8d}{rmse:8.1f}{took_s:7.1f}")
    share = len(errors) / asked
    rmse, median = np.sqrt(np.mean(np.square(errors))), np.median(errors)
    print(
        f"all      {asked:8d}{len(errors):8d}{rmse:8.1f}   "
        f"({100 * share:.0f} %, median {median:.1f} m)"
    )
    if len(sys.argv) > 2:
        save_figure(map_figure(panels), sys.argv[2])


if __name__ == "__main__":
    main()
