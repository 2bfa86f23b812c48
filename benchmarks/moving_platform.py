"""How well a camera on a vessel under way is found, and places, tracks and forecasts by it.

    python benchmarks/moving_platform.py [--seeds 10] [--first-seed 0] [--rate-hz 12]

Each seed is another harbour, camera and vessel (`sightline.simulation`, ``moving=True``): three
recordings of a minute and a half from a small vessel that passes slowly, pitching, rolling and
heaving in a swell, with a receiver that is off by 1.5 m and a compass that is off by 0.7 degrees
for minutes and by 0.3 degrees anew each second. Everything is compared with the truth itself, not
with a log.

Single boxes, tracks and forecasts are those of models that never saw the recording. A forecast is
made by the boxes and the vessel's own log up to its moment; beside it stands what constant velocity
would have come to, from the true way of the target in the quarter of a second before.

The simulated targets turn faster and more often than the vessels that the settings of the motion
are for. So there are two tables of forecasts: by the settings that ship, and by `SIMULATED`. For
comparison each stands beside forecasts by the true places of the target at the times of the boxes,
each off by a metre: what its manoeuvres alone come to, whatever the camera stands on.

Tracking is of all boats at once, by their boxes as a detector sees them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from _support.tracking import score_tracking

from sightline.evaluation.forecast import ForecastPairs, pair_forecasts
from sightline.evaluation.metrics import ScoredPairs, absolute_error, coverage, pair_track
from sightline.formats import read_boxes
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.georeferencing.models import DEFAULT_MODEL
from sightline.pipeline.camera_state import recording_history
from sightline.pipeline.evaluate import LocatedRecording, leave_one_out, place_boxes
from sightline.pipeline.fit import fit
from sightline.pipeline.sources import moments
from sightline.pipeline.track import positions_on_earth
from sightline.scene import Recording, Scene
from sightline.simulation import Simulation, SimulationSettings, simulate
from sightline.simulation.harbour import ReceiverNoise
from sightline.tracking import ImageTracker, Tracker, WorldTracker
from sightline.trajectory.forecast import HORIZONS_S, MotionModel, MotionState, follow
from sightline.types import NO_TRACK, Boxes, Positions

EXACT = ReceiverNoise(std_m=0.0, interval_s=0.25, interval_jitter=0.0, dropouts_per_minute=0.0)
PLACE_SIGMA_M = 1.0
SIMULATED = MotionModel(
    turn_rate_radps=0.28,
    hard_share=0.0,
    mode_s=5.3,
    straight_share=0.5,
    straight_s=140.0,
    turning_s=560.0,
    straight_m2ps3=0.02,
    turning_m2ps3=0.0025,
)
"""How simulated targets move: by the exact logs of harbours 100 to 115 (`_motion.likeliest`)."""
MOTIONS = {"settings that ship": MotionModel(), "simulated motion": SIMULATED}
DURATION_S = 90.0
TRACKING = ("hota", "deta", "assa", "idf1", "tracks")


@dataclass
class Found:
    """What the seeds came to so far.

    Attributes:
        single: Single boxes.
        tracks: Smoothed tracks.
        forecasts: By the motion, and what they are made from, and seconds ahead.
        trackers: By name, rows of `TRACKING`.
    """

    single: list[ScoredPairs] = field(default_factory=list)
    tracks: list[ScoredPairs] = field(default_factory=list)
    forecasts: dict[tuple[str, str], dict[float, list[ForecastPairs]]] = field(default_factory=dict)
    trackers: dict[str, list[list[float]]] = field(default_factory=dict)


def camera_line(seed: int, model: Georeferencer, simulation: Simulation) -> str:
    truth = json.loads((simulation.scene.parent / "truth.json").read_text(encoding="utf-8"))
    camera, true = model.camera, truth["camera"]
    assert camera is not None, "the model has a camera"
    heading = (true["heading_deg"] - truth["platform"]["heading_deg"]) % 360.0
    off = (camera.heading_deg - heading + 180.0) % 360.0 - 180.0
    noise = model.regressor.fit_.noise  # type: ignore[union-attr]
    platform = simulation.harbour.platform
    assert platform is not None, "the camera moves"
    heave_m = float(np.std(platform.heave_m(np.arange(0.0, simulation.harbour.duration_s, 0.1))))
    return (
        f"seed {seed:3d}  height {camera.height_m:5.2f} of {true['height_m']:5.2f} m, "
        f"focal length {camera.focal_px:5.0f} of {true['focal_length_px']:5.0f} px, "
        f"pitch {camera.pitch_deg:5.2f} of {true['pitch_deg']:5.2f}, heading off {off:5.2f} "
        f"degrees, heave {noise.heave_m:4.2f} of {heave_m:4.2f} m"
    )


def tracked(model: Georeferencer, recording: Recording, folder: Path, found: Found) -> None:
    """Both trackers on the boxes of all boats."""
    history, clock = recording_history(recording, model), recording.clock()
    platform = recording.platform()
    assert platform is not None, "every recording has a platform"

    def levelled(name: str) -> Boxes:
        boxes = read_boxes(folder / name / f"{recording.name}.csv", skip_empty=True)
        timed = boxes.with_columns(time_utc_s=clock.time_utc_s(boxes.frame))
        return model.place(history.observed(timed))

    truth, seen = levelled("truth-boxes"), levelled("detections")
    seen = seen.with_columns(track_id=np.full(len(seen), NO_TRACK))
    trackers: dict[str, Tracker] = {"image": ImageTracker()}
    trackers["earth"] = WorldTracker(
        partial(positions_on_earth, platform=platform, until_then=True),
        platform=platform,
    )
    for name, tracker in trackers.items():
        boxes = Boxes.concatenate([tracker.update(one) for one in moments([seen])])
        score = score_tracking(truth, boxes)
        row = [float(getattr(score, column)) for column in TRACKING]
        found.trackers.setdefault(name, []).append(row)


def from_truth(one: LocatedRecording, simulation: Simulation, motion: MotionModel) -> MotionState:
    """The states of the target at its boxes, by where it truly was."""
    times = np.unique(one.boxes.time_utc_s)
    truth = simulation.harbour.truth(times)
    off_m = PLACE_SIGMA_M * np.random.default_rng(simulation.harbour.seed).normal(
        size=(2, len(times))
    )
    covariance = np.tile(PLACE_SIGMA_M**2 * np.eye(2), (times.size, 1, 1))
    inside = np.zeros(times.size, dtype=bool)
    places = Positions(
        truth.east_m + off_m[0], truth.north_m + off_m[1], covariance, inside, one.model.plane
    )
    own = simulation.harbour.platform
    assert own is not None, "the camera moves"
    return follow(
        times, places, motion, camera_position_m=own.at(times - simulation.harbour.start_utc_s)
    )


def harbour(simulation: Simulation, seed: int, name: str, found: Found) -> None:
    folder = simulation.scene.parent
    scene = Scene.load(simulation.scene)
    model = fit(scene, name)
    print(camera_line(seed, model, simulation), flush=True)
    exact = simulation.harbour.fixes(EXACT)
    models = leave_one_out(scene, name)
    for one in place_boxes(scene, models.__getitem__):
        one = replace(one, fixes=exact)
        found.single.append(one.single())
        track = one.track("rts")
        if track is not None:
            found.tracks.append(pair_track(track, exact, platform=one.platform))
        for motion_name, motion in MOTIONS.items():
            by = {"boxes": one.states(motion), "true places": from_truth(one, simulation, motion)}
            for source, states in by.items():
                ahead = found.forecasts.setdefault((motion_name, source), {})
                for horizon_s in HORIZONS_S if states is not None else ():
                    pairs = pair_forecasts(states, exact, horizon_s)
                    ahead.setdefault(horizon_s, []).append(pairs)
    for recording in scene.recordings:
        tracked(models[recording.name], recording, folder, found)


def table(found: Found) -> None:
    head = f"{'n':>7s}{'RMSE':>9s}{'median':>9s}{'95 %':>7s}"
    print(f"\n{'':16s}{head}")
    for name, parts in (("single boxes", found.single), ("tracks", found.tracks)):
        pairs = ScoredPairs.concatenate(parts)
        error = absolute_error(pairs)
        print(
            f"{name:16s}{error.n:7d}{error.rmse:9.2f}{error.median:9.2f}{coverage(pairs).p95:7.2f}"
        )
    for (motion, source), by_ahead in found.forecasts.items():
        print(f"\nforecasts by {source}, {motion}\n{'':16s}{head}   constant velocity")
        for ahead, forecasts in by_ahead.items():
            pairs = ScoredPairs.concatenate(part.pairs for part in forecasts)
            error = absolute_error(pairs)
            beside = np.concatenate([part.log_error_m for part in forecasts])
            constant = float(np.sqrt(np.nanmean(beside**2)))
            print(
                f"{f'{ahead:g} s ahead':16s}{error.n:7d}{error.rmse:9.2f}{error.median:9.2f}"
                f"{coverage(pairs).p95:7.2f}{constant:20.2f}"
            )
    print(f"\n{'tracking in the':16s}" + "".join(f"{column:>9s}" for column in TRACKING))
    for name, rows in found.trackers.items():
        print(f"{name:16s}" + "".join(f"{value:9.3f}" for value in np.mean(rows, axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--rate-hz", type=float, default=12.0)
    parser.add_argument("--model", default=DEFAULT_MODEL)
    chosen = parser.parse_args()
    found = Found()
    for seed in range(chosen.first_seed, chosen.first_seed + chosen.seeds):
        with tempfile.TemporaryDirectory() as folder:
            simulation = simulate(
                folder,
                SimulationSettings(
                    seed=seed,
                    video=False,
                    moving=True,
                    duration_s=DURATION_S,
                    rate_hz=chosen.rate_hz,
                ),
            )
            harbour(simulation, seed, chosen.model, found)
    table(found)


if __name__ == "__main__":
    main()
