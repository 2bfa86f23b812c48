"""Cameras of synthetic harbours: how near the truth they are found, and what their ellipses hold.

    python benchmarks/harbour_camera.py [--seeds 20] [--recordings 3] [--duration 60]

Harbours as `sightline simulate` writes them, without their videos: two boxes a second by hand, and
a log that is off by 1.5 m for some 20 s at a time. One table is of cameras fitted to all
recordings; the other of positions in the last recording, placed by models that learned from the
others.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np

from sightline.camera.parameters import LOG_FOCAL, LOG_HEIGHT, PITCH
from sightline.georeferencing.camera_regressor import CameraRegressor
from sightline.georeferencing.georeferencer import Georeferencer
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import SimulationSettings, simulate
from sightline.simulation.harbour import Harbour
from sightline.types import FloatArray

MODELS = ("camera", "camera+gpr")


def off(model: Georeferencer, harbour: Harbour) -> FloatArray:
    """(2, 3) errors of the height and the focal length as shares and of the pitch in degrees.

    Then the same over their stated standard deviations.
    """
    camera, true = model.camera, harbour.camera
    assert camera is not None
    assert isinstance(model.regressor, CameraRegressor)
    sigma = np.sqrt(np.diag(model.regressor.fit_.covariance))[[LOG_HEIGHT, LOG_FOCAL, PITCH]]
    error = np.array(
        [
            np.log(camera.height_m / true.height_m),
            np.log(camera.focal_px / true.focal_length_px),
            np.radians(camera.pitch_deg - true.pitch_deg),
        ]
    )
    shown = np.array([*np.expm1(error[:2]), np.degrees(error[2])])
    return np.stack([shown, error / sigma])


def squared(model: Georeferencer, scene: Scene, harbour: Harbour) -> FloatArray:
    """(N,) squared errors in standard deviations, infinite where there is no position."""
    boxes = scene.recordings[-1].boxes()
    found = model.locate(boxes.xyxy_px, boxes.source)
    truth = harbour.truth(boxes.time_utc_s)
    error = np.stack([found.east_m - truth.east_m, found.north_m - truth.north_m], axis=1)
    out = np.full(len(boxes), np.inf)
    known = found.known
    solved = np.linalg.solve(found.covariance_m2[known], error[known][:, :, None])[:, :, 0]
    out[known] = np.einsum("ni,ni->n", error[known], solved)
    return out


def main(seeds: int, recordings: int, duration_s: float) -> None:
    """Print both tables."""
    cameras, held = [], {model: [] for model in MODELS}
    seconds = 0.0
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as folder:
            made = simulate(
                Path(folder),
                SimulationSettings(
                    seed=seed, recordings=recordings, duration_s=duration_s, video=False
                ),
            )
            scene = Scene.load(made.scene)
            begin = time.perf_counter()
            whole = fit(scene, "camera")
            seconds += time.perf_counter() - begin
            cameras.append(off(whole, made.harbour))
            last = [scene.recordings[-1].name]
            for model in MODELS:
                learned = fit(scene.without(last), model)
                held[model].append(squared(learned, scene, made.harbour))
    errors = np.array(cameras)
    print(f"{seeds} harbours of {recordings} recordings of {duration_s:g} s")
    print(f"a fit takes {seconds / seeds:.2f} s\n")
    print(f"{'':14s}{'within':>10s}{'share':>8s}{'rms':>9s}{'worst':>9s}{'rms, sigmas':>13s}")
    for i, (name, limit) in enumerate((("height", 0.05), ("focal length", 0.05), ("pitch", 0.3))):
        own = errors[:, :, i]
        unit = " deg" if name == "pitch" else ""
        print(
            f"{name:14s}{f'{limit:g}{unit}':>10s}{np.mean(np.abs(own[:, 0]) < limit):8.0%}"
            f"{np.sqrt(np.mean(own[:, 0] ** 2)):9.3f}{np.abs(own[:, 0]).max():9.3f}"
            f"{np.sqrt(np.mean(own[:, 1] ** 2)):13.2f}"
        )
    print(f"\n{'the last recording':20s}{'in 50 %':>9s}{'in 95 %':>9s}{'least of a harbour':>20s}")
    for model, parts in held.items():
        everything = np.concatenate(parts)
        shares = [np.mean(one < 5.99) for one in parts]
        print(
            f"{model:20s}{np.mean(everything < 1.386):9.1%}{np.mean(everything < 5.99):9.1%}"
            f"{min(shares):20.0%}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--recordings", type=int, default=3)
    parser.add_argument("--duration", type=float, default=60.0)
    given = parser.parse_args()
    main(given.seeds, given.recordings, given.duration)
