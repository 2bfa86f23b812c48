"""The models on the recordings of the AI Tracks at Sea challenge, where they learned and beyond.

    python benchmarks/tracks_at_sea.py [SCENE]

The first table leaves one recording out at a time, as `sightline compare` does. The second asks
for what no training box shows: every model learns from the recordings in which the boat came no
further than 130 m away, and places the boxes of the others.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from _recordings import challenge_scene

from sightline.evaluation.report import Report
from sightline.georeferencing.models import MODELS
from sightline.pipeline.evaluate import compare, place_boxes, score
from sightline.pipeline.fit import fit
from sightline.scene import Scene
from sightline.scene.correspondences import scene_correspondences

NEAR_M = 130.0


def line(model: str, report: Report) -> str:
    """A model's row."""
    ape, cover = report.ape, report.coverage
    return (
        f"{model:12s}{ape.n:5d}{ape.rmse:10.2f}{ape.median:10.2f}{100 * ape.per_range:10.1f}"
        f"{100 * cover.p95:10.1f}"
    )


def far_recordings(scene: Scene) -> list[str]:
    """The recordings in which the boat is mostly further away than `NEAR_M`."""
    assert scene.plane is not None, "the challenge tells where its camera stands"
    pairs = scene_correspondences(scene, scene.plane)
    distance = np.hypot(*pairs.east_north_m.T)
    return [
        str(name)
        for name in np.unique(pairs.recording)
        if np.median(distance[pairs.recording == name]) > NEAR_M
    ]


def main(path: Path) -> None:
    """Print both tables."""
    scene = Scene.load(path)
    head = (
        f"{'model':12s}{'n':>5s}{'RMSE, m':>10s}{'median, m':>10s}{'% range':>10s}{'in 95 %':>10s}"
    )
    print("leaving one recording out\n" + head)
    comparison, _ = compare(scene, MODELS)
    for model, report in comparison.models.items():
        print(line(model, report) + f"   smoothed RMSE {comparison.smoothed[model].ape.rmse:.2f}")
    far = far_recordings(scene)
    print(f"\nlearned up to {NEAR_M:g} m, asked beyond it (recordings {', '.join(far)})\n" + head)
    for model in MODELS:
        fitted = fit(scene.without(far), model)
        print(line(model, score(place_boxes(scene.select(far), lambda _, m=fitted: m))))


if __name__ == "__main__":
    main(challenge_scene(*sys.argv[1:2]))
