"""From frames and a log alone: the boat's position in recordings that nothing has seen.

    python benchmarks/from_frames.py [SCENE [MAP.png]] [--detector FILE.onnx]

The map leaves out recordings in which nothing was placed.

No drawn box is used to fit a camera. Each recording is searched by a detector that was not trained
on it: the shipped one, or for the recordings that it learned from `detectors/fold2.onnx`, which
learned from others. But both learned from boxes that somebody drew in other recordings, of the same
boat in the same bay on the same day. ``--detector`` searches all recordings with another one, which
may never have seen the bay; of COCO's classes, boats. The camera is learned from the logged boat
that is recognised in the other recordings.

For each recording left out:

- `placed`: the camera places what is tracked in it. Scored in those frames in which somebody drew
  the boat and the log has a fix: how many of them have a position, and how far it is from the log.
  Not in those that both detectors learned from. Of all tracks in the recording it is the one
  nearest to the log that counts, with those that continue it (`evaluate_tracks`): so this says how
  well the boat is placed, and not whether the boat is told from others.
- `drawn`: the hand-drawn boxes of the recording, as single boxes of annotators of whom the model
  knows nothing.
- `by eye`: the boxes of `tracks-at-sea/boxes`, which end where the hull meets the water, by the
  camera itself.

Nothing that such a model learns from tells how people draw. That their boxes end a pixel and 0.15 m
below the water was set by hand, with these recordings in sight. The last table says what the drawn
boxes come to under other beliefs, by the same cameras.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from _recordings import challenge_scene

from sightline.camera.priors import CameraPrior
from sightline.detection import LowerEdge
from sightline.errors import FitError
from sightline.evaluation.report import pair_target
from sightline.formats.labels import read_label_folder
from sightline.georeferencing.camera_regressor import CameraRegressor
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
BELIEFS: dict[str, tuple[float, float]] = {
    "nothing": (0.0, 0.0),
    "half of what ships": (0.5, -0.075),
    "what ships": (1.0, -0.15),
    "twice what ships": (2.0, -0.3),
    "4 px": (4.0, 0.0),
}
"""How far below the water annotators are believed to draw: pixels, and metres of height."""
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


class General(SceneDetections):
    """The boats that a detector of many classes finds in each recording."""

    def boxes(self, recording: Recording) -> Boxes:
        """See `SceneDetections`."""
        found = super().boxes(recording)
        return found[found.label == "boat"]


def errors_of_drawn(
    drawn: Scene, name: str, model: Georeferencer, belief: tuple[float, float] | None = None
) -> FloatArray:
    """How far off a model puts a recording's drawn boxes, by its own or another belief."""
    if drawn[name].boxes_path is None:
        return np.empty(0)
    if belief is not None:
        # A copy, since what follows from a belief is kept once it is known.
        model = copy.deepcopy(model)
        assert isinstance(model.regressor, CameraRegressor), "it has a camera"
        prior = model.regressor.prior or CameraPrior()
        model.regressor.prior = replace(prior, unseen_px=belief[0], unseen_m=belief[1])
    (one,) = place_boxes(drawn.select([name]), lambda _: model)
    return one.single().error_m


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


def tell_beliefs(believed: Mapping[str, list[float]]) -> None:
    """How far off the drawn boxes are under each belief about annotators."""
    print("\ndrawn boxes, where annotators are believed to end below the water by")
    for belief, errors in believed.items():
        off_px, off_m = BELIEFS[belief]
        print(
            f"{off_px:4.1f} px and {abs(off_m):5.3f} m  {belief:20s}RMSE {rms(errors):5.1f} m, "
            f"median {np.nanmedian(errors):4.1f} m"
        )


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="?", help="the recordings of the challenge")
    parser.add_argument("map", nargs="?", help="a picture of where the boat was placed")
    parser.add_argument("--detector", help="an ONNX file that searches all recordings")
    return parser.parse_args()


def main() -> None:
    given = arguments()
    drawn = Scene.load(challenge_scene(given.scene))
    bare = replace(
        drawn,
        recordings=tuple(
            replace(one, boxes_path=None, detections_path=None) for one in drawn.recordings
        ),
    )
    seen = General(bare, given.detector) if given.detector else OutOfFold(bare)
    learned: tuple[tuple[str, ...], ...]
    learned = () if given.detector else (SHIPPED_LEARNED_FROM, FOLD2_LEARNED_FROM)
    assert drawn.plane is not None, "the challenge tells where its camera stands"
    placed: list[float] = []
    by_hand: list[float] = []
    believed: dict[str, list[float]] = {belief: [] for belief in BELIEFS}
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
        for belief, off in BELIEFS.items():
            believed[belief] += errors_of_drawn(drawn, recording.name, model, off).tolist()
        hand = errors_of_drawn(drawn, recording.name, model)
        eye = errors_of_labels(recording, model)
        by_hand += hand.tolist()
        by_eye += eye.tolist()
        frames, own = 0, []
        by_all = bool(learned) and all(recording.name in one for one in learned)
        if recording.boxes_path is not None and not by_all:
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
    tell_beliefs(believed)
    if given.map:
        save_figure(map_figure(panels), given.map)


if __name__ == "__main__":
    main()
