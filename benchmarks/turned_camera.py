"""A camera that is turned by a degree in mid-recording: when it is noticed, and what it costs.

    python benchmarks/turned_camera.py [--seeds 20]

Simulated harbours, two recordings each, of pictures 640 px wide. The first teaches the model; in
the second the camera is turned by 1 degree about a random axis, with the correction, without it,
and, in the same world, not turned at all. Single boxes against the log, after the turn.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import sightline
from sightline import Georeferencer, Scene
from sightline.pipeline.camera_state import CameraMotionMonitor, recording_history
from sightline.pipeline.evaluate import place_boxes
from sightline.simulation import Knock, SimulationSettings, simulate
from sightline.simulation.harbour import START_UTC_S

DURATION_S, PAUSE_S = 50.0, 15.0
TURNED_S = START_UTC_S + DURATION_S + PAUSE_S + 20.0
AFTER_S = 2.0
"""From so long after the turn on; corrected boxes before the next look have no place."""


def world(folder: Path, seed: int, knock: Knock | None) -> Scene:
    made = simulate(
        folder,
        SimulationSettings(
            seed=seed,
            recordings=2,
            duration_s=DURATION_S,
            pause_s=PAUSE_S,
            rate_hz=2.0,
            image_size_px=(640, 360),
            clock="exact",
            knock=knock,
        ),
    )
    return Scene.load(made.scene)


def errors(scene: Scene, model: Georeferencer) -> np.ndarray:
    """Of single boxes after the turn, metres."""
    (placed,) = place_boxes(scene.select(["02"]), lambda _: model)
    pairs = placed.single()
    return pairs.error_m[pairs.time_utc_s > TURNED_S + AFTER_S]


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    rng = np.random.default_rng(0)
    late, off_deg, alarms = [], [], 0
    parts: dict[str, list[np.ndarray]] = {"undisturbed": [], "corrected": [], "uncorrected": []}
    for seed in range(seeds):
        axis = rng.normal(size=3)
        turn = axis / np.linalg.norm(axis)
        with tempfile.TemporaryDirectory() as folder:
            still = world(Path(folder) / "still", seed, None)
            knock = Knock(TURNED_S, *turn.tolist())
            turned = world(Path(folder) / "turned", seed, knock)
            model = sightline.fit(still.select(["01"]), "camera")
            alarms += recording_history(still["02"], model).rotation is not None
            own = errors(still, model)
            # The pictures of the two worlds are not drawn alike: each has its own view.
            model = sightline.fit(turned.select(["01"]), "camera")
            watch = CameraMotionMonitor(model)
            noticed = [turn for frame in turned["02"].frames() if (turn := watch.observe(frame))]
            late += [one.time_utc_s - TURNED_S for one in noticed]
            found = recording_history(turned["02"], model).rotation
            if found is not None:
                off_deg.append(np.abs(found.angles_deg[-1] - turn).max())
            unwatched = replace(turned, camera=replace(turned.camera, compensate_rotation=False))
            trio = (own, errors(turned, model), errors(unwatched, model))
        for name, values in zip(parts, trio, strict=True):
            parts[name].append(values)
        said = f"{late[-1]:.1f} s after" if noticed else "not noticed"
        print(
            f"seed {seed:2d}: {said}; RMSE after the turn, m:",
            *(f"{name} {rms(values):.1f}" for name, values in zip(parts, trio, strict=True)),
            flush=True,
        )
    print(f"\nturns told: {len(late)} of {seeds}, at most {max(late, default=np.nan):.1f} s late")
    print(f"angles off by at most {max(off_deg, default=np.nan):.2f} degrees")
    print(f"false alarms in undisturbed recordings: {alarms} of {seeds}")
    for name, several in parts.items():
        every = np.concatenate(several)
        print(
            f"{name:12s} n {every.size}  RMSE {rms(every):.1f} m  median {np.median(every):.1f} m"
        )


if __name__ == "__main__":
    main()
