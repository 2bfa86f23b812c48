"""A smooth track of one boat: measured, interpolated over an occlusion, and forecast."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

import sightline
from sightline.pipeline.track import TrackSettings
from sightline.simulation import SimulationSettings, simulate
from sightline.types import ellipses

SEED = 8
TRUE, BOXES, INK = "#d55e00", "#9a9a9a", "#333333"
COLOURS = {"seen": "#0072b2", "hidden": "#009e73", "forecast": "#cc79a7"}
HIDDEN_S = (25.0, 37.0)
LAST_SEEN_S = 60.0
FORECAST_S = 20.0


def _hidden(after_s: np.ndarray) -> np.ndarray:
    return (after_s > HIDDEN_S[0]) & (after_s < HIDDEN_S[1])


def main(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as made:
        simulated = simulate(
            made,
            SimulationSettings(
                seed=SEED, recordings=3, duration_s=90.0, video=False, clock="exact"
            ),
        )
        scene = sightline.Scene.load(simulated.scene)
        model = sightline.fit(scene.without(["03"]), model="camera")
        seen = scene["03"].boxes()
    harbour, start_s = simulated.harbour, seen.time_utc_s[0]
    after_s = seen.time_utc_s - start_s
    seen = seen[~_hidden(after_s) & (after_s <= LAST_SEEN_S)]
    seen = seen.with_columns(track_id=np.ones(len(seen), dtype=np.int64))
    where = model.locate(seen.xyxy_px, seen.source)

    forecasts: list[sightline.Track] = []
    settings = TrackSettings(interval_s=0.5, forecast_s=FORECAST_S, forecast_interval_s=0.5)
    found = sightline.iter_tracks(seen, model, settings=settings, forecasts=forecasts.append)
    (track,), (forecast,) = list(found), forecasts
    parts = {
        "seen": track[~_hidden(track.time_utc_s - start_s)],
        "hidden": track[_hidden(track.time_utc_s - start_s)],
        "forecast": forecast,
    }

    figure = Figure(figsize=(10.0, 7.0), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=(1.0, 1.1))
    chart, off = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    path = harbour.truth(np.linspace(start_s, start_s + LAST_SEEN_S + FORECAST_S, 400))
    chart.plot(path.east_m, path.north_m, color=TRUE, lw=1.5, zorder=3, label="true path")
    chart.scatter(where.east_m, where.north_m, s=7, color=BOXES, zorder=2, label="single box")
    chart.plot(0.0, 0.0, marker="^", ms=9, color=INK, ls="")
    for name, part in parts.items():
        truth = harbour.truth(part.time_utc_s)
        error_m = np.hypot(part.east_m - truth.east_m, part.north_m - truth.north_m)
        ellipse = ellipses(part.covariance_m2, probability=0.95)
        print(f"{name}: {len(part)} points, {np.sqrt(np.mean(error_m**2)):.1f} m RMSE")
        shown = slice(None, None, 4)
        chart.add_collection(
            EllipseCollection(
                2.0 * ellipse.semi_major_m[shown],
                2.0 * ellipse.semi_minor_m[shown],
                90.0 - ellipse.bearing_deg[shown],
                units="xy",
                offsets=np.stack([part.east_m, part.north_m], axis=1)[shown],
                offset_transform=chart.transData,
                facecolor="none",
                edgecolor=COLOURS[name],
                alpha=0.5,
            )
        )
        chart.scatter(
            part.east_m,
            part.north_m,
            s=6,
            color=COLOURS[name],
            zorder=4,
            label=f"track, {name}" if name != "forecast" else name,
        )
        time_s = part.time_utc_s - start_s
        off.plot(time_s, ellipse.semi_major_m, ".", ms=4, color=COLOURS[name])
        off.plot(time_s, error_m, "x", ms=4, color=COLOURS[name])
    off.plot([], [], ".", color=INK, label="95 % ellipse, semi-major axis")
    off.plot([], [], "x", color=INK, label="true error")
    off.axvspan(*HIDDEN_S, color=BOXES, alpha=0.2, lw=0, label="hidden behind a pier")
    off.axvline(LAST_SEEN_S, color=INK, ls=":", label="last box")
    off.set_yscale("log")
    off.set_yticks([0.3, 1, 3, 10, 30], ["0.3", "1", "3", "10", "30"])
    off.set(xlabel="time, s", ylabel="metres", title="Error and ellipse over time")
    off.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)
    chart.set(aspect="equal", xlim=(-215, 10), ylim=(-40, 65))
    chart.set(xlabel="east, m", ylabel="north, m", title="On the water")
    chart.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=9)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "gaps-and-forecast.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
