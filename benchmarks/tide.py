"""What knowing the water level is worth, on synthetic harbours with a tide.

    python benchmarks/tide.py [--seeds 10] [--rise 2.0]

Each harbour has four recordings of a minute and a half, at levels spread evenly over the rise; its
camera stands 3.5 to 6 m above the middle of them. Models learn from three recordings and place the
boxes of the fourth, each in turn, so that half of the levels asked for lie beyond those learned.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from sightline.formats import write_boxes, write_fixes
from sightline.pipeline.evaluate import place_boxes
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.simulation import BoxNoise, Harbour, HarbourSettings, ReceiverNoise, SimulatedCamera
from sightline.types import FloatArray

RECORDINGS = 4
DURATION_S = 90.0


def camera_of(rng: np.random.Generator) -> SimulatedCamera:
    """A camera at its height above the middle of the tide."""
    return SimulatedCamera(
        height_m=float(rng.uniform(3.5, 6.0)),
        pitch_deg=float(rng.uniform(2.0, 6.0)),
        roll_deg=float(rng.normal(0.0, 0.5)),
        heading_deg=30.0,
        focal_length_px=float(rng.uniform(850.0, 1100.0)),
        k1=-0.1,
        k2=0.01,
    )


def write_scene(folder: Path, seed: int, rise_m: float) -> Scene:
    """A scene whose recordings say how high the water stood."""
    camera = camera_of(np.random.default_rng(seed))
    lines: list[str] = []
    for i, level_m in enumerate(np.linspace(-0.5, 0.5, RECORDINGS) * rise_m):
        low = replace(camera, height_m=camera.height_m - float(level_m))
        start_utc_s = 1_717_236_000.0 + 7200.0 * i
        number = RECORDINGS * seed + i
        harbour = Harbour.random(
            number,
            HarbourSettings(duration_s=DURATION_S, camera=low, start_utc_s=start_utc_s, gulls=0),
        )
        noise = BoxNoise(std_px=1.0, source="me")
        write_boxes(
            harbour.boxes(harbour.times(1.0), noise=noise, seed=number), folder / f"{i}.csv"
        )
        log = harbour.fixes(ReceiverNoise(std_m=1.5), seed=number)
        write_fixes(log, folder / f"{i}-log.csv")
        lines += ["[[recordings]]", f'name = "{i}"', f'boxes = "{i}.csv"']
        lines += [f'fixes = "{i}-log.csv"', f"water_level_m = {level_m}"]
    site = [
        "[camera]",
        f"latitude_deg = {harbour.plane.latitude_deg}",
        f"longitude_deg = {harbour.plane.longitude_deg}",
        "image_size_px = [1280, 720]",
    ]
    (folder / "scene.toml").write_text("\n".join(site + lines), encoding="utf-8")
    return Scene.load(folder / "scene.toml")


def untold(scene: Scene) -> Scene:
    """The same without the levels."""
    still = tuple(replace(recording, water_level_m=None) for recording in scene.recordings)
    return replace(scene, recordings=still)


def errors(scene: Scene, model: str) -> tuple[FloatArray, FloatArray]:
    """(N,) metres off, and (N,) squared in standard deviations, leaving one recording out."""
    off, squared = [], []
    for recording in scene.recordings:
        learned = fit(scene.without([recording.name]), model)
        (placed,) = place_boxes(scene.select([recording.name]), lambda _, m=learned: m)
        # The log is off as well, and what lasts of that is no error of a position.
        pairs = placed.single().with_log_error()
        error = np.stack(
            [pairs.east_m - pairs.true_east_m, pairs.north_m - pairs.true_north_m], axis=1
        )
        solved = np.linalg.solve(pairs.covariance_m2, error[:, :, None])[:, :, 0]
        off.append(np.hypot(*error.T))
        squared.append(np.sum(solved * error, axis=1))
    return np.concatenate(off), np.concatenate(squared)


def main(seeds: int, rise_m: float) -> None:
    """Print a table."""
    print(f"{seeds} harbours with a tide of {rise_m:g} m\n")
    print(f"{'':30s}{'n':>7s}{'RMSE, m':>10s}{'median, m':>11s}{'in 95 %':>9s}")
    for model in ("camera", "camera+gpr"):
        told, blind = [], []
        for seed in range(seeds):
            with tempfile.TemporaryDirectory() as folder:
                scene = write_scene(Path(folder), seed, rise_m)
                told.append(errors(scene, model))
                blind.append(errors(untold(scene), model))
        for name, parts in (("with levels", told), ("without", blind)):
            off, squared = (np.concatenate(column) for column in zip(*parts, strict=True))
            print(
                f"{f'{model}, {name}':30s}{off.size:7d}{np.sqrt(np.mean(off**2)):10.1f}"
                f"{np.median(off):11.1f}{np.mean(squared < 5.99):9.0%}"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rise", type=float, default=2.0)
    chosen = parser.parse_args()
    main(chosen.seeds, chosen.rise)
