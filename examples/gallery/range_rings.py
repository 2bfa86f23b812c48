"""From the log of one boat and boxes of it to a camera with range rings."""

import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

import sightline
from sightline.simulation import SimulatedCamera, SimulationSettings, simulate
from sightline.types import ellipses

SEED = 5
LOG, ESTIMATE, RING = "#d55e00", "#0072b2", "#333333"
RINGS_M = (50.0, 75.0, 100.0, 150.0, 250.0)
CAMERA = SimulatedCamera(
    height_m=9.0,
    pitch_deg=4.0,
    roll_deg=1.5,
    heading_deg=20.0,
    focal_length_px=950.0,
    k1=-0.2,
    k2=0.03,
)


def main(folder: Path) -> None:
    with tempfile.TemporaryDirectory() as made:
        simulated = simulate(
            made,
            SimulationSettings(seed=SEED, recordings=3, video=False, clock="exact", camera=CAMERA),
        )
        scene = sightline.Scene.load(simulated.scene)
        model = sightline.fit(scene, model="camera")
        boxes = [recording.boxes() for recording in scene.recordings]
    drawn = sightline.Boxes.concatenate(boxes)
    where = model.locate(drawn.xyxy_px, drawn.source)
    truth = simulated.harbour.truth(drawn.time_utc_s)
    error_m = np.hypot(where.east_m - truth.east_m, where.north_m - truth.north_m)
    camera = model.camera
    print(f"{len(drawn)} boxes, height {camera.height_m:.2f} m (true {CAMERA.height_m:.2f} m)")
    print(f"{np.sqrt(np.nanmean(error_m**2)):.2f} m RMSE against the true positions")

    figure = Figure(figsize=(10.5, 5.0), layout="constrained")
    image, chart = figure.subplots(1, 2, width_ratios=(1.5, 1.0))

    # How the fitted camera sees circles around itself on the water, and where they truly are.
    bearing = np.radians(np.linspace(-36.0, 36.0, 400) + camera.heading_deg)
    for range_m in RINGS_M:
        east, north = range_m * np.sin(bearing), range_m * np.cos(bearing)
        true = CAMERA.project(np.stack([east, north, np.zeros_like(east)], axis=-1))
        image.plot(*true.T, color=LOG, lw=3.5, alpha=0.35)
        ring = camera.project(camera.east_m + east, camera.north_m + north)
        image.plot(*ring.T, color=RING, lw=1.0)
        y = np.interp(1280.0, *ring[np.isfinite(ring[:, 0])].T)
        image.annotate(f"{range_m:.0f} m", (1290.0, y), va="center", annotation_clip=False)
    foot = np.stack([drawn.xyxy_px[:, [0, 2]].mean(axis=1), drawn.xyxy_px[:, 3]], axis=1)
    image.scatter(*foot.T, s=9, color=ESTIMATE, zorder=3)
    image.plot([], [], color=LOG, lw=3.5, alpha=0.35, label="range ring of the true camera")
    image.plot([], [], color=RING, lw=1.0, label="range ring of the fitted camera")
    image.scatter([], [], s=9, color=ESTIMATE, label="foot point of a drawn box")
    image.set(xlim=(0, 1280), ylim=(540, 290), xlabel="x, px", ylabel="y, px")
    image.set_title("In the image")

    ellipse = ellipses(where.covariance_m2, probability=0.95)
    chart.add_collection(
        EllipseCollection(
            2.0 * ellipse.semi_major_m,
            2.0 * ellipse.semi_minor_m,
            90.0 - ellipse.bearing_deg,
            units="xy",
            offsets=np.stack([where.east_m, where.north_m], axis=1),
            offset_transform=chart.transData,
            facecolor=ESTIMATE,
            edgecolor="none",
            alpha=0.12,
        )
    )
    for n, own in enumerate(boxes):
        path = simulated.harbour.truth(np.linspace(own.time_utc_s[0], own.time_utc_s[-1], 200))
        chart.plot(path.east_m, path.north_m, color=LOG, lw=2, label="true path" if not n else None)
    chart.scatter(
        where.east_m, where.north_m, s=6, color=ESTIMATE, label="box, with its 95 % ellipse"
    )
    chart.plot(0.0, 0.0, marker="^", ms=9, color=RING, ls="", label="camera")
    for range_m in RINGS_M:
        east, north = range_m * np.sin(bearing), range_m * np.cos(bearing)
        chart.plot(east, north, color=RING, lw=0.5)
        chart.annotate(f"{range_m:.0f} m", (east[0], north[0]), ha="right", va="top")
    chart.set(aspect="equal", xlim=(-110, 175), ylim=(-10, 265))
    chart.set(xlabel="east, m", ylabel="north, m", title="On the water")
    figure.legend(loc="outside lower center", ncols=3)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "range-rings.png", dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "example-results"))
