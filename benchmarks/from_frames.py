"""From frames and a log alone: the boat's position in recordings that nothing has seen.

    python benchmarks/from_frames.py [SCENE [MAP.png]]

The map leaves out recordings in which nothing was placed.

No drawn box is used to learn. Each recording is searched by a detector that was not trained on it:
the shipped one, or for the recordings that it learned from `detectors/fold2.onnx`, which learned
from others. The camera is learned from the logged boat that is recognised in the other recordings.
For each recording left out:

- `placed`: the camera places what is tracked in it. Scored in those frames in which somebody drew
  the boat and the log has a fix: how many of them have a position, and how far it is from the log.
  Not in those that both detectors learned from.
- `drawn`: the hand-drawn boxes of the recording, as single boxes of annotators of whom the model
  knows nothing.
- `by eye`: the boxes of `tracks-at-sea/boxes`, which end where the hull meets the water, by the
  camera itself.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from _recordings import challenge_scene

from sightline.detection import LowerEdge
from sightline.errors import FitError
from sightline.evaluation.report import pair_target
from sightline.formats.labels import read_label_folder
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.evaluate import place_boxes
from sightline.pipeline.fit_unlabelled import fit_scene
from sightline.pipeline.run import track_recording
from sightline.pipeline.track import TrackSettings
from sightline.reporting.plots import MapPanel, map_figure, save_figure
from sightline.scene import Recording, Scene
from sightline.scene.detections import SceneDetections
from sightline.synchronisation import synchronise
from sightline.types import Boxes, FloatArray

SHIPPED_LEARNED_FROM = ("06", "07", "09", "15", "18", "10", "11", "19")
FOLD2 = Path(__file__).parent / "detectors" / "fold2.onnx"
FOLD2_LEARNED_FROM = ("08", "13", "17", "21", "10", "11", "19", "20")
LABELS = Path(__file__).parent / "tracks-at-sea"
LEAST_HEIGHT_PX = 6.0
"""Lower boxes are specks, of which nobody knows where they end."""


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

    @property
    def lower_edges(self) -> Mapping[str, LowerEdge | None]:
        """See `SceneDetections`."""
        return {**super().lower_edges, **self._other.lower_edges}

    def times_utc_s(self, recording: Recording) -> FloatArray:
        """See `SceneDetections`."""
        if recording.name in SHIPPED_LEARNED_FROM:
            return self._other.times_utc_s(recording)
        return super().times_utc_s(recording)


def errors_of_labels(recording: Recording, model: Georeferencer) -> FloatArray:
    """How far off the camera puts the lower edges of the boxes drawn by eye, metres."""
    labels = read_label_folder(LABELS, recording.name)
    if labels is None or model.camera is None:
        return np.empty(0)
    labels = labels.without_specks(LEAST_HEIGHT_PX)
    boxes = labels.boxes[labels.target]
    place = synchronise(recording.fixes(), recording.clock().time_utc_s(boxes.frame), model.plane)
    x1, _, x2, y2 = boxes.xyxy_px[place.matched].T
    east_m, north_m = model.camera.locate(np.stack([0.5 * (x1 + x2), y2], axis=1))
    return np.hypot(east_m - place.east_m[place.matched], north_m - place.north_m[place.matched])


def rms(values: list[float] | FloatArray) -> float:
    """Root mean square, NaN of nothing."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return float(np.sqrt(np.mean(known**2))) if known.size else np.nan


def main() -> None:
    drawn = Scene.load(challenge_scene(*sys.argv[1:2]))
    bare = replace(
        drawn,
        recordings=tuple(
            replace(one, boxes_path=None, detections_path=None) for one in drawn.recordings
        ),
    )
    seen = OutOfFold(bare)
    assert drawn.plane is not None, "the challenge tells where its camera stands"
    placed: list[float] = []
    by_hand: list[float] = []
    by_eye: list[float] = []
    panels: list[MapPanel] = []
    asked = 0
    print("recording  frames  placed  RMSE m   drawn  RMSE m  by eye  RMSE m   fit s")
    for recording in drawn.recordings:
        if recording.source is None:
            continue
        fixes, times = recording.fixes(), seen.times_utc_s(recording)
        if not synchronise(fixes, times, drawn.plane).matched.any():
            continue
        began = time.perf_counter()
        try:
            model = fit_scene(bare.without([recording.name]), seen=seen)
        except FitError as error:
            print(f"{recording.name:9s} {error}")
            continue
        took_s = time.perf_counter() - began
        hand = np.empty(0)
        if recording.boxes_path is not None:
            (one,) = place_boxes(drawn.select([recording.name]), lambda _, m=model: m)
            hand = one.single().error_m
        eye = errors_of_labels(recording, model)
        by_hand += hand.tolist()
        by_eye += eye.tolist()
        frames, own = 0, []
        learned = (SHIPPED_LEARNED_FROM, FOLD2_LEARNED_FROM)
        if recording.boxes_path is not None and not all(recording.name in one for one in learned):
            boxes = recording.boxes()
            pictures = {frame.index for frame in recording.frames()}
            known = np.array(sorted(set(boxes.frame.tolist()) & pictures))
            times = recording.clock().time_utc_s(known)
            times = times[synchronise(fixes, times, drawn.plane).matched]
            tracks = track_recording(bare[recording.name], model, seen, TrackSettings())
            pairs, _ = pair_target(tracks, fixes)
            if len(pairs):
                panels.append(MapPanel(f"recording {recording.name}", pairs, smooth=True))
            own = [
                float(pairs.error_m[np.argmin(np.abs(pairs.time_utc_s - when))])
                for when in times
                if np.abs(pairs.time_utc_s - when).min(initial=np.inf) < 0.05
            ]
            frames = times.size
        asked += frames
        placed += own
        print(
            f"{recording.name:9s}{frames:8d}{len(own):8d}{rms(own):8.1f}{hand.size:8d}"
            f"{rms(hand):8.1f}{eye.size:8d}{rms(eye):8.1f}{took_s:8.1f}",
            flush=True,
        )
    print(
        f"all      {asked:8d}{len(placed):8d}{rms(placed):8.1f}{len(by_hand):8d}{rms(by_hand):8.1f}"
        f"{len(by_eye):8d}{rms(by_eye):8.1f}"
    )
    print(
        f"placed {100 * len(placed) / asked:.0f} % of the frames; medians: placed "
        f"{np.nanmedian(placed):.1f} m, drawn {np.nanmedian(by_hand):.1f} m, by eye "
        f"{np.nanmedian(by_eye):.1f} m; of the boxes {np.isnan(by_hand).sum()} drawn and "
        f"{np.isnan(by_eye).sum()} by eye have no place"
    )
    if len(sys.argv) > 2:
        save_figure(map_figure(panels), sys.argv[2])


if __name__ == "__main__":
    main()
