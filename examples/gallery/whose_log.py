"""Which of all vessels in view kept the log, and where the others are, without drawn boxes."""

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import sightline
from sightline.simulation import SimulationSettings, simulate

SEED = 2
LOG, ESTIMATE, OTHERS, INK = "#d55e00", "#0072b2", "#9a9a9a", "#333333"


def main(folder: Path, recordings: int = 3) -> None:
    with tempfile.TemporaryDirectory() as made:
        simulated = simulate(
            made,
            SimulationSettings(
                seed=SEED, recordings=recordings, duration_s=90.0, video=False, clock="exact"
            ),
        )
        scene = sightline.Scene.load(simulated.scene)
        # Nobody has drawn anything: a detector's boxes of all vessels are left, and one log.
        detected = tuple(replace(one, boxes_path=None) for one in scene.recordings)
        scene = replace(scene, recordings=detected)
        model = sightline.fit(scene)
        for statement in model.report.statements:
            print(statement)
        shown = scene.recordings[-1]
        seen = shown.detections()
        tracks = sightline.track(seen, model)
        report = sightline.evaluate(tracks, fixes=shown.fixes_path)
    (target,) = (t for t in tracks if t.track_id in report.tracks.used)
    print(f"{len(tracks)} tracks; the log is that of track {target.track_id}")
    print(f"{report.ape.rmse:.1f} m RMSE against it, {report.coverage.p95:.0%} within the ellipses")

    harbour = simulated.harbour
    span = np.linspace(seen.time_utc_s[0], seen.time_utc_s[-1], 300)
    figure = Figure(figsize=(10.5, 5.2), layout="constrained")
    image, chart = figure.subplots(1, 2, width_ratios=(1.3, 0.8))
    foot = np.stack([seen.xyxy_px[:, [0, 2]].mean(axis=1), seen.xyxy_px[:, 3]], axis=1)
    image.scatter(*foot.T, s=3, color=OTHERS, label="foot point of a detected box")
    image.set(xlabel="x, px", ylabel="y, px", title="What the detector saw", xlim=(0, 1280))
    image.set_ylim(foot[:, 1].max() + 10.0, foot[:, 1].min() - 10.0)
    for track in tracks:
        mine = track is target
        chart.plot(
            track.east_m,
            track.north_m,
            color=ESTIMATE if mine else OTHERS,
            lw=2.0 if mine else 1.2,
            zorder=3 if mine else 2,
            label="track of the vessel recognised" if mine else None,
        )
    chart.plot([], [], color=OTHERS, label="tracks of the others")
    log = harbour.truth(span)
    chart.plot(
        log.east_m, log.north_m, color=LOG, lw=5, alpha=0.45, label="the boat that kept the log"
    )
    chart.plot(0.0, 0.0, marker="^", ms=9, color=INK, ls="", label="camera")
    chart.set(aspect="equal", xlabel="east, m", ylabel="north, m", title="On the water")
    figure.legend(loc="outside lower center", ncols=3)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "whose-log.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
