"""Where a fit holds: cameras that it was not made for, beside OpenCV's homography.

    python benchmarks/other_cameras.py [--folder CAMERAS] [--only made-road] [--speed]

For each split ``CAMERA/SPLIT`` of the folder a model is fitted to ``train.toml``, nothing set by
hand, and places each single box of ``test.toml``, whose logs are the truth. Where a split was made
several times, a figure is the mean over its seeds, with the worst behind it. Beside them stands the
homography of the feet (``cv2.findHomography``, by least squares and by RANSAC within three times
the median residual of that, whichever is better on the test): it knows nothing of cameras and
cannot say how sure it is.

The second table is of cameras that were made, whose height and focal length are known. The third
says how long fits to simulated targets take, 16 boxes a target, on one core and with as many
threads as BLAS would take. `make bench` runs all else on one core.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from _recordings import other_cameras
from _support.cameras import (
    SPEED_BOXES_EACH,
    Held,
    Score,
    Truth,
    camera_fit,
    held,
    passing_targets,
    score,
    splits,
    total,
)

from sightline.errors import SightlineError
from sightline.georeferencing.fit import FitSettings, fit
from sightline.georeferencing.models import DEFAULT_MODEL

MODELS = (DEFAULT_MODEL, "camera")
MADE = {
    "made-road": Truth(7.0, 2318.0),
    "made-indoor": Truth(2.8, 960.0),
    "made-cliff": Truth(60.0, 21988.0),
    "made-cliff-flat": Truth(60.0, 21988.0),
}
SPEED_TARGETS = (25, 100)
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def cell(
    scores: Sequence[Score], value: Callable[[Score], float], form: str, *, least: bool = False
) -> str:
    """The mean over seeds, with the worst where there are several."""
    values = np.array([value(one) for one in scores])
    if not np.isfinite(values).any():
        return "none"
    if values.size == 1:
        return f"{values[0]:{form}}"
    return f"{values.mean():{form}} ({values.min() if least else values.max():{form}})"


def metres(scores: Sequence[Score], value: Callable[[Score], float]) -> str:
    """As `cell`, with three digits."""
    large = np.mean([value(one) for one in scores]) >= 100.0
    return cell(scores, value, ".0f" if large else ".2f")


def row(name: str, model: str, scores: Sequence[Score]) -> str:
    cells = [
        name + (f", {len(scores)} seeds" if len(scores) > 1 else ""),
        str(sum(one.n for one in scores)),
        metres(scores, lambda one: one.homography_m),
        f"`{model}`",
        metres(scores, lambda one: one.rmse_m),
        metres(scores, lambda one: one.median_m),
        cell(scores, lambda one: one.covered, ".0%", least=True),
        cell(scores, lambda one: one.placed, ".0%", least=True),
        cell(scores, lambda one: one.fit_s, ".1f"),
    ]
    return f"| {' | '.join(cells)} |"


def places(folder: Path, only: Sequence[str]) -> dict[str, list[dict[str, Held]]]:
    """Print the table of all splits; by made camera and model, what was found of the camera."""
    print(
        "| split | boxes | homography | model | RMSE, m | median, m | in 95 % | placed | fit, s |"
    )
    print("|---|---:|---:|---|---:|---:|---:|---:|---:|")
    found: dict[str, list[dict[str, Held]]] = {}
    for name, folders in splits(folder).items():
        camera = name.split()[0]
        if only and camera not in only:
            continue
        scores: dict[str, list[Score]] = {}
        for one in folders:
            try:
                of_models = score(one, MODELS)
            except SightlineError as error:
                print(f"{one}: {error}", file=sys.stderr)
                continue
            for model, (own, fitted) in of_models.items():
                scores.setdefault(model, []).append(own)
                if camera in MADE and model == DEFAULT_MODEL:
                    found.setdefault(camera, []).append(held(camera_fit(fitted), MADE[camera]))
        for model, own_scores in scores.items():
            print(row(name, model, own_scores), flush=True)
    return found


def parameters(found: dict[str, list[dict[str, Held]]]) -> None:
    print("\nwithin three stated sigma of the truth / said to be not determined / neither\n")
    print("| camera | fits | height | focal length |\n|---|---:|---:|---:|")
    for camera, fits in found.items():
        both = total(fits)
        print(f"| {camera} | {len(fits)} | {both['height']} | {both['focal length']} |")


def speed(whose: str) -> None:
    """Print rows of how long fits take, in this process."""
    for targets in SPEED_TARGETS:
        inputs = passing_targets(targets, SPEED_BOXES_EACH * targets)
        for model in MODELS:
            begin = time.perf_counter()
            fit(inputs, FitSettings(model=model))
            fit_s = time.perf_counter() - begin
            boxes = len(inputs.correspondences)
            print(f"| {targets} | {boxes:,} | `{model}` | {whose} | {fit_s:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", help="the folder of the cameras")
    parser.add_argument("--only", nargs="*", default=(), help="cameras, by their folders' names")
    parser.add_argument("--speed", metavar="WHOSE", help="print rows of the third table alone")
    chosen = parser.parse_args()
    if chosen.speed:
        speed(chosen.speed)
        return
    parameters(places(other_cameras(chosen.folder), chosen.only))
    print("\n| targets | boxes | model | threads | fit, s |\n|---:|---:|---|---|---:|", flush=True)
    # How many threads BLAS takes is settled when it is loaded.
    free = {name: value for name, value in os.environ.items() if name not in THREADS}
    one = free | dict.fromkeys(THREADS, "1")
    for whose, environment in (("one", one), (f"BLAS's own, {os.cpu_count()} cores", free)):
        command = [sys.executable, __file__, "--speed", whose]
        subprocess.run(command, env=environment, check=True)


if __name__ == "__main__":
    main()
