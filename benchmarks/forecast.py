"""How far forecasts are off on real recordings, beside constant velocity from the log itself.

    python benchmarks/forecast.py [SCENE] [--model camera+gpr]

Each recording is placed by a model that never saw it, and each forecast is made by the boxes up to
its moment alone. The boxes of the *AI Tracks at Sea* recordings are some four seconds apart.
"""

from __future__ import annotations

import argparse

from _recordings import challenge_scene

from sightline.evaluation.forecast import ForecastError
from sightline.inference.georeferencer import DEFAULT_MODEL
from sightline.pipeline import leave_one_out, place_boxes, score, with_forecasts
from sightline.scene import Scene

COLUMNS = ("n", "rmse", "median", "p90", "95 %", "compared", "rmse", "log's")


def line(name: str, ahead: str, error: ForecastError) -> str:
    beside = error.beside_log
    return (
        f"{name:>6s}{ahead:>5s} s{error.n:8d}{error.rmse:9.2f}{error.median:9.2f}{error.p90:9.2f}"
        f"{error.coverage_p95:9.2f}{beside.n:10d}{beside.rmse:9.2f}{beside.log_rmse:9.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", nargs="?")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    chosen = parser.parse_args()
    scene = Scene.load(challenge_scene(chosen.scene))
    models = leave_one_out(scene, chosen.model)
    placed = place_boxes(scene.select(models), models.__getitem__)
    report = with_forecasts(score(placed), placed)
    widths = (8, 9, 9, 9, 9, 10, 9, 9)
    print(" " * 13 + "".join(f"{c:>{w}s}" for c, w in zip(COLUMNS, widths, strict=True)))
    for name, part in {"all": report, **report.recordings}.items():
        for ahead, error in (part.forecast or {}).items():
            print(line(name, ahead, error))


if __name__ == "__main__":
    main()
