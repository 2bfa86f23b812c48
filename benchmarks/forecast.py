"""How far forecasts are off on real recordings, beside constant velocity from the log itself.

    python benchmarks/forecast.py [SCENE] [--model camera+gpr] [--learned]

Each recording is placed by a model that never saw it, and each forecast is made by the boxes up to
its moment alone. The boxes of the *AI Tracks at Sea* recordings are some four seconds apart.

Below it stands what the same forecasts are worth that start from the log's own places at the times
of the boxes: how far the target's manoeuvres alone put them off.

With ``--learned`` the settings of the motion are not those that ship, but the likeliest of the rest
of the log, without the minutes about the recording; that takes some minutes.
"""

from __future__ import annotations

import argparse

import numpy as np
from _motion import likeliest
from _recordings import challenge_scene

from sightline.evaluation.forecast import ForecastError, forecast_errors
from sightline.georeferencing.models import DEFAULT_MODEL
from sightline.pipeline.evaluate import (
    LocatedRecording,
    leave_one_out,
    place_boxes,
    score,
    with_forecasts,
)
from sightline.scene import Scene
from sightline.synchronisation import synchronise
from sightline.trajectory.forecast import MotionModel, MotionState, follow
from sightline.types import Fixes, Positions

LOG_SIGMA_M = 1.0
AROUND_S = 60.0
"""So long before and after a recording its log is left out of what the settings are learned of."""

COLUMNS = ("n", "rmse", "median", "p90", "95 %", "compared", "rmse", "log's")


def line(name: str, ahead: str, error: ForecastError) -> str:
    beside = error.beside_log
    return (
        f"{name:>6s}{ahead:>5s} s{error.n:8d}{error.rmse:9.2f}{error.median:9.2f}{error.p90:9.2f}"
        f"{error.coverage_p95:9.2f}{beside.n:10d}{beside.rmse:9.2f}{beside.log_rmse:9.2f}"
    )


def head() -> None:
    widths = (8, 9, 9, 9, 9, 10, 9, 9)
    print(" " * 13 + "".join(f"{c:>{w}s}" for c, w in zip(COLUMNS, widths, strict=True)))


def from_log(one: LocatedRecording) -> MotionState | None:
    """The states of the target at its boxes, by the log instead of the boxes."""
    times, plane = np.unique(one.boxes.time_utc_s), one.model.plane
    log = synchronise(one.fixes, times, plane)
    rows = log.matched
    if rows.sum() < 2:
        return None
    exact = LOG_SIGMA_M**2 * np.tile(np.eye(2), (int(rows.sum()), 1, 1))
    inside = np.zeros(int(rows.sum()), dtype=bool)
    places = Positions(log.east_m[rows], log.north_m[rows], exact, inside, plane)
    return follow(times[rows], places)


def learned(one: LocatedRecording) -> MotionModel:
    """The settings that the rest of the log makes likeliest."""
    times = one.boxes.time_utc_s
    return likeliest(
        one.fixes, one.model.plane, without=(times.min() - AROUND_S, times.max() + AROUND_S)
    )


def pooled(name: str, targets: list[tuple[MotionState, Fixes]]) -> None:
    for ahead, error in forecast_errors(targets).items():
        print(line(name, ahead, error))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--learned", action="store_true")
    chosen = parser.parse_args()
    scene = Scene.load(challenge_scene(chosen.scene))
    models = leave_one_out(scene, chosen.model)
    placed = place_boxes(scene.select(models), models.__getitem__)
    if chosen.learned:
        head()
        motions = [learned(one) for one in placed]
        for one, motion in zip(placed, motions, strict=True):
            print(f"{one.recording:>6s}  {motion}")
        targets = []
        for one, motion in zip(placed, motions, strict=True):
            places = one.conditions.locate(one.boxes, one.model)
            targets.append((follow(one.boxes.time_utc_s, places, motion), one.fixes))
        pooled("all", targets)
        return
    report = with_forecasts(score(placed), placed)
    head()
    for name, part in {"all": report, **report.recordings}.items():
        for ahead, error in (part.forecast or {}).items():
            print(line(name, ahead, error))
    pooled("by log", [(s, one.fixes) for one in placed if (s := from_log(one)) is not None])


if __name__ == "__main__":
    main()
