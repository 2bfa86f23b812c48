"""How far to trust a position: ellipses against range, and how often they hold the truth."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

import sightline
from sightline.simulation import SimulatedCamera, SimulationSettings, simulate
from sightline.types import ellipses

ALONG, ACROSS, INK = "#0072b2", "#e69f00", "#333333"
CAMERA = SimulatedCamera(
    height_m=5.0, pitch_deg=2.0, roll_deg=0.5, heading_deg=20.0, focal_length_px=900.0, k1=-0.1
)


def place(seed: int) -> tuple[sightline.Positions, np.ndarray]:
    """The boxes of a recording, located by a model of the two others, and their errors."""
    with tempfile.TemporaryDirectory() as made:
        simulated = simulate(
            made, SimulationSettings(seed=seed, video=False, clock="exact", camera=CAMERA)
        )
        scene = sightline.Scene.load(simulated.scene)
        model = sightline.fit(scene.without(["03"]), model="camera")
        boxes = scene["03"].boxes()
    where = model.locate(boxes.xyxy_px, boxes.source)
    boxes, where = boxes[where.known], where[where.known]
    truth = simulated.harbour.truth(boxes.time_utc_s)
    return where, np.stack([where.east_m - truth.east_m, where.north_m - truth.north_m], axis=1)


def main(folder: Path, harbours: int = 24) -> None:
    range_m, major_m, minor_m, error_m, squared = [], [], [], [], []
    for seed in range(harbours):
        where, error = place(seed)
        range_m.append(where.range_m)
        error_m.append(np.hypot(*error.T))
        ellipse = ellipses(where.covariance_m2, probability=0.95)
        major_m.append(ellipse.semi_major_m)
        minor_m.append(ellipse.semi_minor_m)
        # Squared Mahalanobis distance: chi-squared with two degrees of freedom if all is right.
        solved = np.linalg.solve(where.covariance_m2, error[:, :, None])[:, :, 0]
        squared.append(np.sum(error * solved, axis=1))
    reach, major, minor, off = map(np.concatenate, (range_m, major_m, minor_m, error_m))
    stated = np.linspace(0.02, 0.98, 49)
    held = np.array([[np.mean(one <= -2.0 * np.log1p(-p)) for p in stated] for one in squared])
    at_95 = np.mean(np.concatenate(squared) <= -2.0 * np.log(0.05))
    print(f"{off.size} boxes in {harbours} harbours, {np.sqrt(np.mean(off**2)):.1f} m RMSE")
    print(f"95 % ellipses hold {at_95:.0%} of the true positions")

    figure = Figure(figsize=(10.5, 4.8), layout="constrained")
    size, share = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    size.scatter(reach, off, s=5, color="#9a9a9a", alpha=0.5, label="error of a box")
    edges = np.geomspace(40.0, 250.0, 11)
    bins = np.digitize(reach, edges)
    kept = [i for i in range(1, edges.size) if np.sum(bins == i) >= 20]
    middle = [np.median(reach[bins == i]) for i in kept]
    for values, colour, label in (
        (major, ALONG, "semi-major axis of the 95 % ellipse (along the line of sight)"),
        (minor, ACROSS, "semi-minor axis of the 95 % ellipse (across it)"),
    ):
        size.plot(
            middle, [np.median(values[bins == i]) for i in kept], color=colour, lw=2.5, label=label
        )
    pixel = np.array([40.0, 250.0])
    size.plot(pixel, pixel**2 / (5.0 * 900.0), color=INK, ls=":", label="one pixel: r² / (h f)")
    size.set(xscale="log", yscale="log", xlim=(40, 250), ylim=(0.1, 100), xlabel="range, m")
    size.set(ylabel="metres", title="Errors and ellipses against range")
    size.set_xticks([50, 100, 200], ["50", "100", "200"], minor=False)
    size.set_xticks([], minor=True)
    size.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    size.legend(loc="upper left", fontsize=8)

    share.plot([0, 1], [0, 1], color=INK, ls=":", label="ideal")
    share.fill_between(
        stated,
        *np.percentile(held, [10, 90], axis=0),
        color=ALONG,
        alpha=0.15,
        lw=0,
        label="10 to 90 % of the harbours",
    )
    share.plot(stated, held.mean(axis=0), color=ALONG, lw=2.5, label="mean of all harbours")
    share.set(aspect="equal", xlim=(0, 1), ylim=(0, 1), title="Coverage of the ellipses")
    share.set(xlabel="probability that the ellipse states", ylabel="share of true positions in it")
    share.xaxis.set_major_formatter(PercentFormatter(1.0))
    share.yaxis.set_major_formatter(PercentFormatter(1.0))
    share.legend(loc="upper left", fontsize=8)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "trust.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
